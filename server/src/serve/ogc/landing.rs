//! The landing page, what the interface conforms to, and what is told of the collections.

use axum::{
    Json,
    extract::State,
    http::{HeaderMap, HeaderValue, Uri, header},
    response::{Html, IntoResponse, Response},
};
use lanemap_core::TimestampNs;
use serde_json::{Map, Value, json};

use super::{
    CRS84, CRS84H,
    collection::{COLLECTIONS, Collection, MapCollection},
    feature_cache::FeatureCache,
};
use crate::serve::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    extents::Extents,
    features::rfc3339,
    form::{self, Form},
    html, in_background,
    items::of_cell,
    line::rounded,
    link_base::LinkBase,
    openapi::{OPENAPI, page},
    problem::Problem,
    query::Parameters,
    sessions::{GEOJSON, identity},
};

/// What the interface conforms to.
const CONFORMS_TO: [&str; 6] = [
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/core",
    "http://www.opengis.net/spec/ogcapi-common-2/1.0/conf/collections",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/core",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/oas30",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/geojson",
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/json",
];
/// Most cells that are read to tell the extent of a collection; of more, their tiles are told.
const MOST_READ_CELLS: usize = 1024;
const JSON: &str = "application/json";

/// `GET /`
pub(in crate::serve) async fn landing(base: LinkBase, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let form = asked(&uri, &headers)?;
    let link = |rel: &str, kind: &str, title: &str, path: &str| json!({ "rel": rel, "type": kind, "title": title, "href": base.link(path) });
    let document = json!({
        "title": "lanemap",
        "description": "The lane map of a fleet, fused from all its drives and served while it grows.",
        "links": [
            link("self", JSON, "This page", "/?f=json"),
            link("alternate", "text/html", "This page for people", "/?f=html"),
            link("service-desc", OPENAPI, "Description of all addresses, OpenAPI 3.0", "/api"),
            link("service-doc", "text/html", "The same for people", "/api?f=html"),
            link("conformance", JSON, "Standards that this service conforms to", "/conformance"),
            link("http://www.opengis.net/def/rel/ogc/1.0/conformance", JSON, "The same", "/conformance"),
            link("data", JSON, "The collections of features", "/collections"),
            link("http://www.opengis.net/def/rel/ogc/1.0/data", JSON, "The same", "/collections"),
            link("related", JSON, "The cells of the shared map", "/cells"),
            link("related", JSON, "The drives", "/sessions"),
            link("preview", "text/html", "The map, drawn live", "/viewer"),
        ],
    });
    Ok(answer(form, document, &headers))
}

/// `GET /conformance`
pub(in crate::serve) async fn conformance(uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    Ok(answer(asked(&uri, &headers)?, json!({ "conformsTo": CONFORMS_TO }), &headers))
}

/// `GET /api`
pub(in crate::serve) async fn api(
    State(api): State<std::sync::Arc<crate::serve::openapi::Api>>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["f"])?;
    let kinds = [OPENAPI, "application/vnd.oai.openapi+json", "application/openapi+json", JSON];
    let form = form::wanted(&parameters, &headers, &kinds)?;
    let tag = EntityTag::of(("api", form, base.as_str()));
    if tag.is_held_by(&headers) {
        return Ok(varied(tag.not_modified()));
    }
    let document = api.document(&base);
    Ok(varied(match form {
        Form::Json => tag.on(([(header::CONTENT_TYPE, OPENAPI)], document.to_string())),
        Form::Html => tag.on(secured(Html(page::page(&document, &base)))),
    }))
}

/// `GET /collections`
pub(in crate::serve) async fn collections(
    State(state): State<ServeState>,
    State(extents): State<Extents>,
    State(cache): State<FeatureCache>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let form = asked(&uri, &headers)?;
    let told = Told { state, extents, cache, base };
    let document = in_background(move || {
        let base = &told.base;
        let collections =
            COLLECTIONS.iter().map(|collection| told.collection(collection)).collect::<Result<Vec<_>, _>>()?;
        Ok::<_, Problem>(json!({
            "links": [
                { "rel": "self", "type": JSON, "title": "This list", "href": base.link("/collections?f=json") },
                { "rel": "alternate", "type": "text/html", "title": "For people", "href": base.link("/collections?f=html") },
            ],
            "collections": collections,
        }))
    });
    Ok(answer(form, document.await??, &headers))
}

/// `GET /collections/{id}`
pub(in crate::serve) async fn collection(
    collection: Collection,
    State(state): State<ServeState>,
    State(extents): State<Extents>,
    State(cache): State<FeatureCache>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let form = asked(&uri, &headers)?;
    let told = Told { state, extents, cache, base };
    let document = in_background(move || told.collection(&collection)).await??;
    Ok(answer(form, document, &headers))
}

/// How far a collection reaches.
struct Reach {
    /// Boxes around its parts.
    boxes: Vec<Bounds>,
    /// First (where it is known) and last time at which anything of it was seen.
    seen: Option<(Option<TimestampNs>, TimestampNs)>,
}

/// From what a collection is told.
struct Told {
    state: ServeState,
    extents: Extents,
    cache: FeatureCache,
    base: LinkBase,
}

impl Told {
    fn collection(&self, collection: &Collection) -> Result<Value, Problem> {
        let path = format!("/collections/{}", collection.id);
        let link = |rel: &str, kind: &str, title: &str, path: &str| json!({ "rel": rel, "type": kind, "title": title, "href": self.base.link(path) });
        let mut document = json!({
            "id": collection.id,
            "title": collection.title,
            "description": collection.description,
            "itemType": "feature",
            "crs": if collection.has_heights { vec![CRS84, CRS84H] } else { vec![CRS84] },
            "links": [
                link("self", JSON, "This collection", &path),
                link("alternate", "text/html", "For people", &format!("{path}?f=html")),
                link("items", GEOJSON, collection.title, &collection.items_path()),
            ],
        });
        let Reach { boxes, seen } = match collection.of_map {
            Some(kind) => self.of_map(kind)?,
            None => self.of_drives(),
        };
        let mut extent = Map::new();
        if let Some(around) = Bounds::around_all(&boxes) {
            extent.insert(
                "spatial".into(),
                json!({ "bbox": [around.to_array().map(|degrees| rounded(degrees, 1e7))], "crs": CRS84 }),
            );
        }
        if let Some((first, last)) = seen {
            let trs = "http://www.opengis.net/def/uom/ISO-8601/0/Gregorian";
            let interval = [first.map(rfc3339), Some(rfc3339(last))];
            extent.insert("temporal".into(), json!({ "interval": [interval], "trs": trs }));
        }
        if !extent.is_empty() {
            document["extent"] = extent.into();
        }
        Ok(document)
    }

    /// The borders of the cells' lines, and first and last time at which any was seen.
    fn of_map(&self, kind: MapCollection) -> Result<Reach, Problem> {
        let mut boxes = Vec::new();
        let mut seen: Option<(TimestampNs, TimestampNs)> = None;
        let mut left = MOST_READ_CELLS;
        for (cell, record) in self.state.map.list().into_iter().filter(|(_, record)| record.version.0 > 0) {
            let mut told = self.cache.told_already(cell, record.version);
            if told.is_none() && left > 0 {
                left -= 1;
                told = self.cache.told(&self.state.map, cell, record.version)?;
            }
            boxes.extend(match (kind, &told) {
                (MapCollection::Cells, _) | (_, None) => Some(of_cell(cell)),
                (_, Some(told)) => told.bounds,
            });
            let of_cell = told.and_then(|told| told.seen);
            seen = match (seen, of_cell) {
                (Some((first, last)), Some((from, to))) => Some((first.min(from), last.max(to))),
                (one, other) => one.or(other),
            };
        }
        Ok(Reach { boxes, seen: seen.map(|(first, last)| (Some(first), last)) })
    }

    fn of_drives(&self) -> Reach {
        let sessions = self.state.sessions.list();
        let boxes = sessions.iter().filter_map(|session| self.extents.of(session)).collect();
        let driven = sessions.iter().filter(|session| session.georeference.is_some() && identity(session).1 > 0);
        Reach { boxes, seen: driven.map(|session| session.last_time).max().map(|last| (None, last)) }
    }
}

fn asked(uri: &Uri, headers: &HeaderMap) -> Result<Form, Problem> {
    form::wanted(&Parameters::read(uri, &["f"])?, headers, &[JSON])
}

/// A document in the form that was asked for. It is small, so that its tag is made of itself.
fn answer(form: Form, document: Value, headers: &HeaderMap) -> Response {
    let tag = EntityTag::of((form, document.to_string()));
    if tag.is_held_by(headers) {
        return varied(tag.not_modified());
    }
    varied(match form {
        Form::Json => tag.on(Json(document)),
        Form::Html => tag.on(secured(Html(html::page_of(&document)))),
    })
}

fn varied(mut response: Response) -> Response {
    response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    response
}

fn secured(page: Html<String>) -> Response {
    let policy =
        HeaderValue::from_static("default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'");
    ([(header::CONTENT_SECURITY_POLICY, policy)], page).into_response()
}
