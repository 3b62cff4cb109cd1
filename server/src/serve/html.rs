//! Documents as plain pages for people: no script, nothing from elsewhere.

use std::fmt::Write;

use serde_json::Value;

const STYLE: &str = "\
:root{color-scheme:light dark;--line:#8884;--soft:#8882}\
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}\
h1,h2,h3{line-height:1.2;margin:2rem 0 .5rem}code,pre{font-family:ui-monospace,monospace;font-size:.9em}\
dl{display:grid;grid-template-columns:minmax(6rem,max-content) 1fr;gap:.2rem 1rem;margin:.3rem 0}\
dt{font-weight:600}dd{margin:0;overflow-wrap:anywhere}ul,ol{padding-left:1.2rem;margin:.3rem 0}\
table{border-collapse:collapse;width:100%;margin:.5rem 0}th,td{text-align:left;vertical-align:top;padding:.3rem .6rem .3rem 0;\
border-bottom:1px solid var(--line)}section{border:1px solid var(--line);border-radius:.5rem;padding:0 1rem .6rem;margin:1rem 0}\
.path{background:var(--soft);padding:.1rem .4rem;border-radius:.3rem}pre{background:var(--soft);padding:.6rem;overflow:auto;\
border-radius:.3rem;max-height:30rem}";

/// A text as HTML has it.
pub(super) fn escaped(text: &str) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut escaped, letter| {
        match letter {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
        escaped
    })
}

/// A page around a body that is HTML already.
pub(super) fn page(title: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><title>{title}</title><style>{STYLE}</style></head>\
         <body><main><h1>{title}</h1>{body}</main></body></html>\n"
    )
}

/// A JSON document as a page; its links lead on.
pub(super) fn page_of(document: &Value) -> String {
    let mut body = String::new();
    value(document, &mut body);
    page(document["title"].as_str().unwrap_or("lanemap"), &body)
}

fn value(value_of: &Value, out: &mut String) {
    match value_of {
        Value::Object(members) if members.contains_key("href") => link(value_of, out),
        Value::Object(members) => {
            out.push_str("<dl>");
            for (name, member) in members {
                let _ = write!(out, "<dt>{}</dt><dd>", escaped(name));
                value(member, out);
                out.push_str("</dd>");
            }
            out.push_str("</dl>");
        }
        Value::Array(members) if members.iter().all(|member| member.is_number() || member.is_string()) => {
            let parts: Vec<String> = members.iter().map(plain).collect();
            out.push_str(&parts.join(", "));
        }
        Value::Array(members) => {
            out.push_str("<ul>");
            for member in members {
                out.push_str("<li>");
                value(member, out);
                out.push_str("</li>");
            }
            out.push_str("</ul>");
        }
        other => out.push_str(&plain(other)),
    }
}

fn link(link: &Value, out: &mut String) {
    let text = |name: &str| escaped(link[name].as_str().unwrap_or_default());
    let title = if link["title"].is_string() { text("title") } else { text("href") };
    let _ = write!(out, "<a href=\"{}\">{title}</a> <small>{} {}</small>", text("href"), text("rel"), text("type"));
}

fn plain(value: &Value) -> String {
    escaped(&value.as_str().map_or_else(|| value.to_string(), str::to_owned))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_of_a_document_is_no_markup() {
        let page =
            page_of(&serde_json::json!({ "title": "<b>", "links": [{ "href": "/x?\"><script>", "rel": "self" }] }));
        assert!(!page.contains("<script>") && !page.contains("<b>"), "{page}");
        assert!(page.contains("href=\"/x?&quot;&gt;&lt;script&gt;\""));
    }
}
