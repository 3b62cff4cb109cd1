//! `/exports/{cell}`: a cell of the shared map in the formats of others ([`crate::export`]).
//!
//! The format is that of the address's suffix, else of `format`, else of the `Accept` header, else GeoJSON.

use axum::{
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, Uri, header},
    response::Response,
};
use lanemap_proto::v1;

use super::{
    ServeState,
    cells::published,
    entity_tag::EntityTag,
    in_background,
    problem::{Problem, repeated},
    query::Parameters,
};
use crate::export::{self, Format, LaneOptions, TrafficSide};

/// `GET /exports/{cell}`, also with a suffix, as in `/exports/14-8718-5685.osm`.
pub(super) async fn cell(
    State(state): State<ServeState>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["format", "traffic"])?;
    let asked = parameters
        .get("format", |text| Format::of_name(text).ok_or_else(|| format!("it must be one of {}", Format::names())))?;
    let traffic = parameters.get("traffic", parse_side)?.unwrap_or_default();
    let (id, suffix) = name.split_once('.').map_or((name.as_str(), None), |(id, suffix)| (id, Some(suffix)));
    let format = match (suffix, asked) {
        (Some(suffix), asked) => {
            let format = Format::of_suffix(suffix).ok_or_else(|| Problem::NoSuchPath { path: repeated(uri.path()) })?;
            if asked.is_some_and(|asked| asked != format) {
                let reason = format!("the address says .{suffix}");
                return Err(Problem::BadParameter {
                    name: "format",
                    value: asked.map_or("", Format::name).to_owned(),
                    reason,
                });
            }
            format
        }
        (None, Some(format)) => format,
        (None, None) => accepted(&headers)?,
    };
    let (cell, published) = published(&state.map, id).await?;
    let tag = EntityTag::of(("export", cell, published.map.version, format, traffic));
    if tag.is_held_by(&headers) {
        return Ok(varied(tag.not_modified()));
    }
    let file = format!("lanemap-{cell}-v{}.{}", published.map.version, format.suffix());
    let body = in_background(move || {
        let mut bytes = Vec::new();
        let cells = std::iter::once(Ok(v1::CellMap::clone(&published.map)));
        export::write(format, cells, LaneOptions { traffic }, &mut bytes).map(|_| bytes)
    });
    let body = body.await?.map_err(|error| {
        tracing::error!(%error, "an export could not be made");
        Problem::Internal
    })?;
    let mut response = tag.on(([(header::CONTENT_TYPE, format.media_type())], body));
    if let Ok(value) = HeaderValue::from_str(&format!("attachment; filename=\"{file}\"")) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, value);
    }
    Ok(varied(response))
}

fn parse_side(text: &str) -> Result<TrafficSide, String> {
    match text {
        "right" => Ok(TrafficSide::Right),
        "left" => Ok(TrafficSide::Left),
        _ => Err("it must be right or left".to_owned()),
    }
}

/// The answer depends on `Accept`, too.
fn varied(mut response: Response) -> Response {
    response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    response
}

/// The format that a request takes, of those with media types of their own; GeoJSON where it takes anything.
fn accepted(headers: &HeaderMap) -> Result<Format, Problem> {
    let values: Vec<&str> = headers.get_all(header::ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    if values.is_empty() {
        return Ok(Format::GeoJson);
    }
    let mut best: Option<(f64, Format)> = None;
    for range in values.iter().flat_map(|value| value.split(',')) {
        let mut parts = range.split(';').map(str::trim);
        let media_type = parts.next().unwrap_or_default();
        let weight = parts.find_map(|part| part.strip_prefix("q=")).map_or(Some(1.0), |weight| weight.parse().ok());
        let is_taken = |format: &Format| {
            let group = media_type.strip_suffix('*').filter(|group| group.ends_with('/'));
            media_type.eq_ignore_ascii_case(format.media_type())
                || group.is_some_and(|group| group == "*/" || format.media_type().starts_with(group))
                || (media_type.eq_ignore_ascii_case("application/json") && *format == Format::GeoJson)
        };
        let format = Format::ALL.into_iter().find(is_taken);
        if let (Some(format), Some(weight)) = (format, weight.filter(|weight: &f64| *weight > 0.0))
            && best.is_none_or(|(best, _)| weight > best)
        {
            best = Some((weight, format));
        }
    }
    let reason = || format!("there are {}", Format::ALL.map(Format::media_type).join(", "));
    best.map(|(_, format)| format).ok_or_else(|| Problem::NotAcceptable { reason: reason() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn accepting(accept: &str) -> Result<Format, Problem> {
        accepted(&HeaderMap::from_iter([(header::ACCEPT, HeaderValue::from_str(accept).unwrap())]))
    }

    #[test]
    fn the_format_is_the_one_that_the_request_likes_best() {
        assert_eq!(accepted(&HeaderMap::new()), Ok(Format::GeoJson));
        for (accept, format) in [
            ("*/*", Format::GeoJson),
            ("text/html, application/json;q=0.9, */*;q=0.1", Format::GeoJson),
            ("application/vnd.pmtiles", Format::PmTiles),
            ("application/geo+json;q=0.2, application/vnd.flatgeobuf;q=0.8", Format::FlatGeobuf),
        ] {
            assert_eq!(accepting(accept), Ok(format), "{accept}");
        }
        for accept in ["image/png", "application/geo+json;q=0"] {
            assert!(matches!(accepting(accept), Err(Problem::NotAcceptable { .. })), "{accept}");
        }
    }
}
