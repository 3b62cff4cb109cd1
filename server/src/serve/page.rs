//! What the pages of all collections have in common: how they are asked for, and how one leads to the next.

use axum::http::Uri;
use serde::Serialize;

use super::{
    bounds::Bounds,
    problem::Problem,
    query::{Parameters, parse_limit},
    sessions::{GEOJSON, Link},
};

/// Lines of a page, where the query does not say.
pub(super) const DEFAULT_LIMIT: usize = 1_000;
/// Most lines of a page.
pub(super) const MOST_LINES: usize = 10_000;
/// Most coordinates of a page; the line that reaches it is the page's last.
pub(super) const MOST_COORDINATES: usize = 200_000;

/// What a page is asked for; `C` names the last line of the page before.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PageQuery<C> {
    pub(super) bounds: Option<Bounds>,
    pub(super) limit: usize,
    pub(super) after_exclusive: Option<C>,
}

/// One page.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
pub(super) struct Page<F> {
    #[serde(rename = "numberReturned")]
    pub(super) number_returned: usize,
    pub(super) links: Vec<Link>,
    pub(super) features: Vec<F>,
}

impl<C> PageQuery<C> {
    /// Reads a query; `parse_cursor` reads its `after`.
    pub(super) fn read(uri: &Uri, parse_cursor: impl FnOnce(&str) -> Result<C, String>) -> Result<Self, Problem> {
        let parameters = Parameters::read(uri, &["bbox", "limit", "after"])?;
        Ok(Self {
            bounds: parameters.get("bbox", Bounds::parse)?,
            limit: parameters.get("limit", |text| parse_limit(text, MOST_LINES))?.unwrap_or(DEFAULT_LIMIT),
            after_exclusive: parameters.get("after", parse_cursor)?,
        })
    }
}

/// Links from a page of a collection: to itself, and to the next, where there is more after the feature `last`.
pub(super) fn links(path: &str, asked: &str, last: Option<&str>) -> Vec<Link> {
    let link = |rel, query: &str| {
        let mark = if query.is_empty() { "" } else { "?" };
        Link { rel, media_type: GEOJSON, href: format!("{path}{mark}{query}") }
    };
    let next = last.map(|last| {
        let kept = asked.split('&').filter(|pair| !pair.is_empty() && !pair.starts_with("after="));
        let query: Vec<&str> = kept.collect();
        let after = format!("after={last}");
        link("next", &query.into_iter().chain([after.as_str()]).collect::<Vec<_>>().join("&"))
    });
    std::iter::once(link("self", asked)).chain(next).collect()
}
