//! In which form an answer is wanted: the parameter `f`, else the header `Accept` (RFC 9110, 12.5.1).

use axum::http::{HeaderMap, header};

use super::{problem::Problem, query::Parameters};

/// Forms of an answer for programs and for people.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Form {
    Json,
    Html,
}

/// The form that a request wants, of an answer whose JSON has these media types.
pub(super) fn wanted(parameters: &Parameters, headers: &HeaderMap, json: &[&str]) -> Result<Form, Problem> {
    let named = parameters.get("f", |text| match text {
        "json" => Ok(Form::Json),
        "html" => Ok(Form::Html),
        _ => Err("it must be json or html".to_owned()),
    })?;
    if let Some(form) = named {
        return Ok(form);
    }
    let as_json = json.iter().map(|kind| liking(headers, kind)).fold(0, u32::max);
    match (as_json, liking(headers, "text/html")) {
        (0, 0) => Err(not_acceptable(json[0])),
        (json, html) => Ok(if html > json { Form::Html } else { Form::Json }),
    }
}

/// Refuses a request that does not take GeoJSON.
pub(super) fn accepts_geojson(headers: &HeaderMap) -> Result<(), Problem> {
    let kinds = ["application/geo+json", "application/json"];
    if kinds.iter().any(|kind| liking(headers, kind) > 0) { Ok(()) } else { Err(not_acceptable(kinds[0])) }
}

fn not_acceptable(kind: &str) -> Problem {
    Problem::NotAcceptable { reason: format!("Accept declines {kind}") }
}

/// How much a media type is liked, in thousandths, by the most specific range that has it; without a header all are.
fn liking(headers: &HeaderMap, kind: &str) -> u32 {
    let values: Vec<&str> = headers.get_all(header::ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    let ranges = values.iter().flat_map(|value| value.split(',')).map(str::trim).filter(|range| !range.is_empty());
    let mut liking = (0, 0);
    let mut any = false;
    for range in ranges {
        any = true;
        let mut parts = range.split(';').map(str::trim);
        let name = parts.next().unwrap_or_default();
        let exactness = match name.split_once('/') {
            _ if name.eq_ignore_ascii_case(kind) => 3,
            Some(("*", "*")) => 1,
            Some((group, "*")) if kind.split_once('/').is_some_and(|(of, _)| of.eq_ignore_ascii_case(group)) => 2,
            _ => continue,
        };
        let quality = parts.find_map(|part| part.strip_prefix("q=").or_else(|| part.strip_prefix("Q=")));
        liking = liking.max((exactness, quality.map_or(1000, thousandths)));
    }
    if any { liking.1 } else { 1000 }
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in 0 ..= 1000")]
fn thousandths(quality: &str) -> u32 {
    quality
        .parse::<f64>()
        .ok()
        .filter(|quality| (0.0..=1.0).contains(quality))
        .map_or(1000, |q| (q * 1e3).round() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn form(query: &str, accept: &'static str) -> Result<Form, Problem> {
        let parameters = Parameters::read(&format!("/?{query}").parse().unwrap(), &["f"]).unwrap();
        let headers = HeaderMap::from_iter([(header::ACCEPT, header::HeaderValue::from_static(accept))]);
        wanted(&parameters, &headers, &["application/json"])
    }

    #[test]
    fn a_browser_gets_a_page_and_a_program_json() {
        let browser = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8";
        assert_eq!(form("", browser), Ok(Form::Html));
        assert_eq!(form("f=json", browser), Ok(Form::Json));
        for program in ["*/*", "application/json", "application/*, text/html;q=0.5", ""] {
            assert_eq!(form("", program), Ok(Form::Json), "{program}");
        }
        assert!(matches!(form("", "image/png"), Err(Problem::NotAcceptable { .. })));
        assert!(matches!(form("", "application/json;q=0, text/csv"), Err(Problem::NotAcceptable { .. })));
        assert_eq!(form("", "application/json;q=0, */*"), Ok(Form::Html));
    }

    #[test]
    fn geojson_is_refused_only_to_who_declines_it() {
        let accepts = |accept: &'static str| {
            let headers = HeaderMap::from_iter([(header::ACCEPT, header::HeaderValue::from_static(accept))]);
            accepts_geojson(&headers).is_ok()
        };
        assert!(accepts("application/geo+json") && accepts("text/html,*/*;q=0.8") && accepts("application/json"));
        assert!(!accepts("text/html") && !accepts("*/*;q=0"));
    }
}
