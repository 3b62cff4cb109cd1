//! What a page of items is asked for.

use std::hash::{DefaultHasher, Hash, Hasher};

use axum::http::Uri;

use super::{
    CRS84, CRS84H, DEFAULT_FEATURES, MOST_FEATURES, collection::Collection, cursor::Cursor, datetime::Interval,
    filters::Filters,
};
use crate::serve::{
    bounds::Bounds,
    problem::{Problem, repeated},
    query::{Parameters, parse_limit},
};

/// A request for items, read.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::serve) struct ItemQuery {
    pub(in crate::serve) bounds: Option<Bounds>,
    pub(in crate::serve) interval: Option<Interval>,
    pub(in crate::serve) filters: Filters,
    pub(in crate::serve) limit: usize,
    pub(in crate::serve) cursor: Option<Cursor>,
    /// The query as it was written.
    pub(in crate::serve) written: String,
}

impl ItemQuery {
    /// Reads the query of a collection's items.
    pub(in crate::serve) fn read(uri: &Uri, collection: &Collection) -> Result<Self, Problem> {
        let known: Vec<&str> = collection.parameters().iter().map(|parameter| parameter.name).collect();
        let parameters = Parameters::read(uri, &known)?;
        parameters.get("bbox-crs", bbox_crs)?;
        Ok(Self {
            bounds: parameters.get("bbox", Bounds::parse)?,
            interval: parameters.get("datetime", Interval::parse)?,
            filters: Filters::read(&parameters, collection)?,
            limit: parameters.get("limit", |text| parse_limit(text, MOST_FEATURES))?.unwrap_or(DEFAULT_FEATURES),
            cursor: parameters.get("cursor", Cursor::parse)?,
            written: uri.query().unwrap_or_default().to_owned(),
        })
    }

    /// Whether every feature is wanted.
    pub(in crate::serve) fn is_of_all(&self) -> bool {
        self.bounds.is_none() && self.interval.is_none() && self.filters.is_empty()
    }

    /// Which features are wanted, hashed.
    pub(in crate::serve) fn question(&self, collection: &Collection) -> u64 {
        let mut hasher = DefaultHasher::new();
        collection.id.hash(&mut hasher);
        format!("{:?} {:?} {:?}", self.bounds, self.interval, self.filters).hash(&mut hasher);
        hasher.finish()
    }

    /// The same query for another page; `None`: the first.
    pub(in crate::serve) fn written_with(&self, cursor: Option<&Cursor>) -> String {
        let kept = self.written.split('&').filter(|pair| !pair.is_empty() && !pair.starts_with("cursor="));
        let cursor = cursor.map(|cursor| format!("cursor={}", cursor.text()));
        let pairs: Vec<&str> = kept.chain(cursor.as_deref()).collect();
        let mark = if pairs.is_empty() { "" } else { "?" };
        format!("{mark}{}", pairs.join("&"))
    }

    /// The refusal of a cursor of another collection.
    pub(in crate::serve) fn foreign_cursor(&self) -> Problem {
        let value = self.cursor.map(|cursor| cursor.text()).unwrap_or_default();
        let reason = "it is of another collection".to_owned();
        Problem::BadParameter { name: "cursor", value: repeated(&value), reason }
    }
}

fn bbox_crs(text: &str) -> Result<(), String> {
    if [CRS84, CRS84H].contains(&text) { Ok(()) } else { Err(format!("it must be {CRS84}")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::ogc::collection::LANES;

    fn read(query: &str) -> Result<ItemQuery, Problem> {
        ItemQuery::read(&format!("/collections/lanes/items?{query}").parse().unwrap(), &LANES)
    }

    #[test]
    fn what_cannot_be_read_is_refused_by_its_name() {
        for (query, parameter) in [
            ("limit=0", "limit"),
            ("limit=-1", "limit"),
            ("limit=1.0", "limit"),
            ("cursor=3", "cursor"),
            ("bbox-crs=EPSG:4326", "bbox-crs"),
            ("datetime=today", "datetime"),
            ("category=purple", "category"),
            ("drives=-1", "drives"),
            ("min_existence=1.1", "min_existence"),
            ("max_lateral_sigma_m=NaN", "max_lateral_sigma_m"),
            ("cell=14-x", "cell"),
        ] {
            let Err(Problem::BadParameter { name, .. }) = read(query) else { panic!("{query}") };
            assert_eq!(name, parameter);
        }
        assert!(matches!(read("session=1"), Err(Problem::UnknownParameter { .. })));
    }

    #[test]
    fn a_limit_beyond_the_most_is_the_most() {
        assert_eq!(read("limit=99999999999").unwrap().limit, MOST_FEATURES);
        assert_eq!(read("").unwrap().limit, DEFAULT_FEATURES);
    }

    #[test]
    fn the_next_page_is_asked_the_same_question() {
        let first = read("limit=7&bbox=1%2C2,3,4").unwrap();
        let cursor = Cursor::Drives(super::super::cursor::DriveCursor { walk: 3, session: [0; 8], lane: 1 });
        let next = read(first.written_with(Some(&cursor)).trim_start_matches('?')).unwrap();
        assert_eq!(next.cursor, Some(cursor));
        assert_eq!(next.question(&LANES), first.question(&LANES));
        assert_eq!(next.written_with(None), "?limit=7&bbox=1%2C2,3,4");
    }
}
