//! The description as a page for people.

use std::fmt::Write;

use serde_json::Value;

use crate::serve::{
    html::{escaped, page as html_page},
    link_base::LinkBase,
};

/// The page of a document.
pub(in crate::serve) fn page(document: &Value, base: &LinkBase) -> String {
    let mut body = String::new();
    let text = |value: &Value| escaped(value.as_str().unwrap_or_default());
    let _ = write!(body, "<p>{}</p>", text(&document["info"]["description"]));
    let _ = write!(
        body,
        "<p><a href=\"{}\">For programs: OpenAPI {}</a></p>",
        escaped(&base.link("/api")),
        text(&document["openapi"])
    );
    let paths = document["paths"].as_object().into_iter().flatten();
    let paths: Vec<(&String, &Value)> = paths.map(|(path, methods)| (path, &methods["get"])).collect();
    for tag in document["tags"].as_array().into_iter().flatten().map(|tag| &tag["name"]) {
        let _ = write!(body, "<h2>{}</h2>", text(tag));
        for (path, operation) in paths.iter().filter(|(_, operation)| operation["tags"][0] == *tag) {
            section(path, operation, &mut body);
        }
    }
    body.push_str("<h2>Shapes</h2>");
    for (name, schema) in document["components"]["schemas"].as_object().into_iter().flatten() {
        let pretty = serde_json::to_string_pretty(schema).unwrap_or_default();
        let name = escaped(name);
        let _ =
            write!(body, "<details id=\"{name}\"><summary>{name}</summary><pre>{}</pre></details>", escaped(&pretty));
    }
    html_page("lanemap: all addresses", &body)
}

fn section(path: &str, operation: &Value, out: &mut String) {
    let text = |value: &Value| escaped(value.as_str().unwrap_or_default());
    let _ = write!(
        out,
        "<section><h3><code class=\"path\">GET {}</code></h3><p>{}",
        escaped(path),
        text(&operation["summary"])
    );
    let _ = write!(out, " {}</p>", text(&operation["description"]));
    let parameters = operation["parameters"].as_array().map(Vec::as_slice).unwrap_or_default();
    if !parameters.is_empty() {
        out.push_str("<table><thead><tr><th>Parameter</th><th>Meaning</th><th>Values</th></tr></thead><tbody>");
        for parameter in parameters {
            let (name, meaning) = (text(&parameter["name"]), text(&parameter["description"]));
            let schema = escaped(&parameter["schema"].to_string());
            let _ =
                write!(out, "<tr><td><code>{name}</code></td><td>{meaning}</td><td><code>{schema}</code></td></tr>");
        }
        out.push_str("</tbody></table>");
    }
    out.push_str("<dl>");
    for (status, response) in operation["responses"].as_object().into_iter().flatten() {
        let kinds = response["content"].as_object().into_iter().flatten();
        let kinds: Vec<String> = kinds.map(|(kind, content)| form(kind, &content["schema"])).collect();
        let reference = text(&response["$ref"]);
        let description = text(&response["description"]);
        let what = if reference.is_empty() { description } else { "Not modified.".to_owned() };
        let _ = write!(out, "<dt>{}</dt><dd>{what} {}</dd>", escaped(status), kinds.join(", "));
    }
    out.push_str("</dl></section>");
}

fn form(kind: &str, schema: &Value) -> String {
    let kind = escaped(kind);
    let name = schema["$ref"].as_str().and_then(|reference| reference.rsplit('/').next()).map(escaped);
    name.map_or_else(
        || format!("<code>{kind}</code>"),
        |name| format!("<code>{kind}</code>: <a href=\"#{name}\">{name}</a>"),
    )
}
