//! `/styles/lanes.json`: a MapLibre style that draws the vector tiles as paint on the road: white and yellow, dashed, solid
//! and double, and curbs. It asks for nothing but the tiles: no glyphs, no sprites.

use axum::{
    Json,
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_tiles::DASHES_FROM;
use serde_json::{Value, json};

use super::{entity_tag::EntityTag, link_base::LinkBase, problem::Problem, query::Parameters, tiles};

/// Path of the style.
pub(super) const PATH: &str = "/styles/lanes.json";

/// Asphalt, paint and stone.
const ROAD: &str = "#33373d";
const WHITE: &str = "#f4f4f0";
const YELLOW: &str = "#f5c518";
const CURB: &str = "#9a948a";
const UNKNOWN: &str = "#7fa3b5";

/// Codes of the categories that are yellow.
const YELLOW_CODES: std::ops::RangeInclusive<u8> = 7..=12;
/// A dash and the gap after it from afar, in widths of the line.
const DASHES: [f64; 2] = [2.0, 4.0];

/// One stroke of paint.
struct Stroke {
    name: &'static str,
    /// Categories that are drawn so, by their codes.
    codes: &'static [u8],
    dashed: bool,
    /// Where it lies, in widths of a line to the right of the middle.
    aside: f64,
}

const fn stroke(name: &'static str, codes: &'static [u8], dashed: bool, aside: f64) -> Stroke {
    Stroke { name, codes, dashed, aside }
}

const STROKES: [Stroke; 10] = [
    stroke("solid", &[2, 8], false, 0.0),
    stroke("dashed", &[1, 7], true, 0.0),
    stroke("double-solid-left", &[4, 10], false, -1.0),
    stroke("double-solid-right", &[4, 10], false, 1.0),
    stroke("double-dashed-left", &[3, 9], true, -1.0),
    stroke("double-dashed-right", &[3, 9], true, 1.0),
    stroke("left-dashed", &[5, 11], true, -1.0),
    stroke("right-solid", &[5, 11], false, 1.0),
    stroke("left-solid", &[6, 12], false, -1.0),
    stroke("right-dashed", &[6, 12], true, 1.0),
];

/// `GET /styles/lanes.json`
pub(super) async fn style(base: LinkBase, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let style = of_tiles(&base.link(tiles::PATH));
    let tag = EntityTag::of((PATH, style.to_string()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(Json(style)))
}

/// The style of the tiles that a TileJSON describes.
fn of_tiles(tile_json: &str) -> Value {
    let yellow: Vec<u8> = YELLOW_CODES.collect();
    let paint_colour = json!(["match", ["get", "category_code"], yellow, YELLOW, WHITE]);
    let mut layers = vec![
        json!({"id": "road", "type": "background", "paint": {"background-color": ROAD}}),
        line("curb", &[20, 21], &json!(CURB), &json!({"line-width": width(2.0)})),
        line("unknown", &[0], &json!(UNKNOWN), &json!({"line-width": width(1.0), "line-dasharray": [2, 2]})),
    ];
    for Stroke { name, codes, dashed, aside } in STROKES {
        let mut shape = json!({"line-width": width(1.0)});
        if aside != 0.0 {
            shape["line-offset"] = width(aside);
        }
        if !dashed {
            layers.push(line(name, codes, &paint_colour, &shape));
            continue;
        }
        // A pattern begins anew in every tile: near the road, the tiles have the dashes themselves.
        let mut near = line(name, codes, &paint_colour, &shape);
        near["source-layer"] = json!("dashes");
        near["minzoom"] = json!(DASHES_FROM);
        shape["line-dasharray"] = json!(DASHES);
        let mut far = line(&format!("{name}-far"), codes, &paint_colour, &shape);
        far["maxzoom"] = json!(DASHES_FROM);
        layers.extend([far, near]);
    }
    json!({
        "version": 8,
        "name": "lanemap",
        "sources": {"lanes": {"type": "vector", "url": tile_json}},
        "layers": layers,
    })
}

/// A layer of lines of some categories; fainter where a line may not be there.
fn line(name: &str, codes: &[u8], colour: &Value, shape: &Value) -> Value {
    let existence = json!(["interpolate", ["linear"], ["get", "existence"], 0.3, 0.25, 0.9, 1]);
    let mut paint = json!({"line-color": colour, "line-opacity": existence});
    if let (Some(paint), Some(shape)) = (paint.as_object_mut(), shape.as_object()) {
        paint.extend(shape.clone());
    }
    json!({
        "id": name,
        "type": "line",
        "source": "lanes",
        "source-layer": "lanes",
        "filter": ["match", ["get", "category_code"], codes, true, false],
        "layout": {"line-join": "round"},
        "paint": paint,
    })
}

/// So many widths of a line of paint, pixels by zoom: 15 cm on the ground at middle latitudes from zoom 19 on, and never too
/// thin to see.
fn width(lines: f64) -> Value {
    let pixels = |pixels: f64| (pixels * lines * 100.0).round() / 100.0;
    json!([
        "interpolate",
        ["exponential", 2],
        ["zoom"],
        12,
        pixels(0.6),
        16,
        pixels(1.0),
        18,
        pixels(1.4),
        19,
        pixels(1.6),
        20,
        pixels(3.2),
        24,
        pixels(51.2)
    ])
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use lanemap_core::Category;

    use super::*;

    #[test]
    fn every_category_is_drawn() {
        let style = of_tiles("http://host/tiles/lanes");
        let drawn: BTreeSet<u64> = style["layers"]
            .as_array()
            .unwrap()
            .iter()
            .filter_map(|layer| layer["filter"][2].as_array())
            .flatten()
            .map(|code| code.as_u64().unwrap())
            .collect();
        assert_eq!(drawn, Category::ALL.map(|category| u64::from(category.openlane_code())).into());
    }
}
