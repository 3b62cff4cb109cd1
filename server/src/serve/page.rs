//! A page of a collection as it is written: what is told of it, then its features.

use axum::{http::header, response::Response};
use lanemap_core::TimestampNs;
use serde::Serialize;

use super::{
    entity_tag::EntityTag,
    features::rfc3339,
    link_base::{LinkBase, link_header},
    ogc::{collection::Collection, cursor::Cursor, item_query::ItemQuery},
    problem::Problem,
    sessions::{GEOJSON, Link},
};

/// Features on their way into a page.
#[derive(Debug, Default)]
pub(super) struct PageFeatures {
    /// Their texts, with commas between them.
    pub(super) text: Vec<u8>,
    pub(super) returned: usize,
    pub(super) coordinates: usize,
    /// Where the next page begins, where there is one.
    pub(super) next: Option<Cursor>,
    /// Features on all pages, where they were counted.
    pub(super) matched: Option<u64>,
}

/// What is told of a page.
#[derive(Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
struct Head<'a> {
    #[serde(rename = "numberMatched", skip_serializing_if = "Option::is_none")]
    number_matched: Option<u64>,
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    #[serde(rename = "timeStamp")]
    time_stamp: String,
    links: &'a [Link],
}

impl PageFeatures {
    /// Appends a feature, which `write` writes.
    pub(super) fn push(&mut self, coordinates: usize, write: impl FnOnce(&mut Vec<u8>)) {
        if self.returned > 0 {
            self.text.push(b',');
        }
        write(&mut self.text);
        self.returned += 1;
        self.coordinates += coordinates;
    }

    /// The answer that has them, made now.
    pub(super) fn answer(
        self,
        collection: &Collection,
        query: &ItemQuery,
        base: &LinkBase,
        tag: EntityTag,
    ) -> Result<Response, Problem> {
        let (tag, now_us) = tag.made_now();
        let items = collection.items_path();
        let link = |rel, path: &str| Link { rel, media_type: GEOJSON, href: base.link(path) };
        let mut links = vec![link("self", &format!("{items}{}", query.written_with(query.cursor.as_ref())))];
        if let Some(next) = &self.next {
            links.push(link("next", &format!("{items}{}", query.written_with(Some(next)))));
        }
        let of = base.link(&format!("/collections/{}", collection.id));
        links.push(Link { rel: "collection", media_type: "application/json", href: of });
        let head = Head {
            number_matched: self.matched,
            number_returned: self.returned,
            time_stamp: rfc3339(TimestampNs(i64::try_from(now_us.saturating_mul(1_000)).unwrap_or(i64::MAX))),
            links: &links,
        };
        let mut body = serde_json::to_vec(&head).map_err(|_| Problem::Internal)?;
        // The features follow within the object.
        body.pop();
        body.reserve_exact(self.text.len() + 32);
        body.extend(b",\"features\":[");
        body.extend(self.text);
        body.extend(b"]}");
        let mut response = tag.on(([(header::CONTENT_TYPE, GEOJSON)], body));
        if let Some((name, value)) = link_header(links.iter().map(|link| (link.rel, link.href.as_str()))) {
            response.headers_mut().insert(name, value);
        }
        Ok(response)
    }
}

/// One feature, as an answer: its text with links to itself and to its collection.
pub(super) fn single(
    collection: &Collection,
    id: &str,
    mut text: Vec<u8>,
    base: &LinkBase,
    tag: &EntityTag,
) -> Result<Response, Problem> {
    let (of, own) = (format!("/collections/{}", collection.id), format!("{}/{id}", collection.items_path()));
    let links = [
        Link { rel: "self", media_type: GEOJSON, href: base.link(&own) },
        Link { rel: "collection", media_type: "application/json", href: base.link(&of) },
    ];
    text.pop();
    text.extend(b",\"links\":");
    text.extend(serde_json::to_vec(&links).map_err(|_| Problem::Internal)?);
    text.push(b'}');
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], text)))
}
