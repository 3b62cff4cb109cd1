//! Parameters of requests: their names, and what may be written for them.

use serde_json::{Value, json};

use crate::serve::{
    features::category_name,
    ogc::{DEFAULT_FEATURES, MOST_FEATURES},
};

/// A parameter of a request.
#[derive(Clone, Copy, Debug)]
pub(in crate::serve) struct Parameter {
    /// Its name in the path or in the query.
    pub(in crate::serve) name: &'static str,
    description: &'static str,
    schema: fn() -> Value,
}

impl Parameter {
    pub(in crate::serve) const fn new(name: &'static str, description: &'static str, schema: fn() -> Value) -> Self {
        Self { name, description, schema }
    }

    pub(super) fn described(&self, place: &str, required: bool) -> Value {
        let mut described = json!({
            "name": self.name,
            "in": place,
            "required": required,
            "description": self.description,
            "schema": (self.schema)(),
        });
        if place == "query" {
            described["style"] = "form".into();
            described["explode"] = false.into();
        }
        described
    }
}

fn text() -> Value {
    json!({ "type": "string" })
}

fn id() -> Value {
    json!({ "type": "string", "minLength": 1, "maxLength": 256 })
}

fn probability() -> Value {
    json!({ "type": "number", "minimum": 0, "maximum": 1 })
}

fn count() -> Value {
    json!({ "type": "integer", "format": "int32", "minimum": 0, "maximum": i32::MAX })
}

fn limit() -> Value {
    json!({ "type": "integer", "minimum": 1, "maximum": MOST_FEATURES, "default": DEFAULT_FEATURES })
}

fn bbox() -> Value {
    let numbers = |count: u8| json!({ "minItems": count, "maxItems": count });
    json!({ "type": "array", "oneOf": [numbers(4), numbers(6)], "items": { "type": "number" } })
}

fn crs84() -> Value {
    json!({ "type": "string", "enum": [crate::serve::ogc::CRS84], "default": crate::serve::ogc::CRS84 })
}

fn categories() -> Value {
    let names: Vec<&str> = lanemap_core::Category::ALL.into_iter().map(category_name).collect();
    json!({ "type": "string", "enum": names })
}

/// A part of the path that names a thing.
pub(in crate::serve) const fn path_id(name: &'static str, description: &'static str) -> Parameter {
    Parameter::new(name, description, id)
}

/// A whole number in the query, or in the path.
pub(in crate::serve) const fn whole_number(name: &'static str, description: &'static str) -> Parameter {
    Parameter::new(name, description, || json!({ "type": "integer", "minimum": 0 }))
}

/// A revision of the map.
pub(in crate::serve) const fn revision(name: &'static str, description: &'static str) -> Parameter {
    Parameter::new(name, description, || json!({ "type": "integer", "format": "int64", "minimum": 0 }))
}

/// One of two words in the query.
pub(in crate::serve) const FORM: Parameter = Parameter::new(
    "f",
    "Form of the answer; without it, the header Accept decides.",
    || json!({ "type": "string", "enum": ["json", "html"] }),
);
pub(in crate::serve) const LIMIT: Parameter =
    Parameter::new("limit", "Most entries of a page; more than the maximum counts as the maximum.", limit);
pub(in crate::serve) const BBOX: Parameter = Parameter::new(
    "bbox",
    "Features that share a point with the box west,south,east,north, degrees, or west,south,low,east,north,high with heights \
     above the ellipsoid, metres; west is greater than east where the box crosses the antimeridian. A line is in the heights \
     where the range of its own reaches into them; a feature without heights is in all.",
    bbox,
);
pub(in crate::serve) const BBOX_CRS: Parameter =
    Parameter::new("bbox-crs", "Coordinate reference system of bbox.", crs84);
pub(in crate::serve) const DATETIME: Parameter = Parameter::new(
    "datetime",
    "Features that were seen at a time or within an interval: the interval from first_seen to last_seen shares an instant \
     with it. RFC 3339: 2026-01-31T08:00:00Z, or start/end, where .. or nothing leaves an end open.",
    || json!({ "type": "string", "format": "rfc3339-instant-or-interval" }),
);
const PAGE: &str = "Where a page begins: from the link `next` of the page before, and from nowhere else.";
pub(in crate::serve) const MAP_CURSOR: Parameter =
    Parameter::new("cursor", PAGE, || json!({ "type": "string", "format": "lanemap-map-cursor" }));
pub(in crate::serve) const DRIVES_CURSOR: Parameter =
    Parameter::new("cursor", PAGE, || json!({ "type": "string", "format": "lanemap-drives-cursor" }));
pub(in crate::serve) const CRS: Parameter = Parameter::new(
    "crs",
    "wgs84: longitude and latitude, degrees; local: metres in the drive's own frame.",
    || json!({ "type": "string", "enum": ["wgs84", "local"], "default": "wgs84" }),
);
pub(in crate::serve) const CATEGORY: Parameter = Parameter::new("category", "Features of this category.", categories);
pub(in crate::serve) const CELL: Parameter =
    Parameter::new("cell", "Features of one cell: 14-x-y.", || json!({ "type": "string", "format": "lanemap-cell" }));
pub(in crate::serve) const LANE: Parameter = Parameter::new("lane", "Features of the line of this name.", text);
pub(in crate::serve) const SESSION: Parameter = Parameter::new("session", "Features of one drive.", text);
pub(in crate::serve) const DRIVES: Parameter = Parameter::new("drives", "Features that so many drives saw.", count);
pub(in crate::serve) const MIN_DRIVES: Parameter =
    Parameter::new("min_drives", "Features that at least so many drives saw.", count);
pub(in crate::serve) const MIN_EXISTENCE: Parameter =
    Parameter::new("min_existence", "Features that exist with at least this probability.", probability);
pub(in crate::serve) const MAX_LATERAL_SIGMA_M: Parameter = Parameter::new(
    "max_lateral_sigma_m",
    "Features whose standard deviation across the line is at most this, metres.",
    || json!({ "type": "number", "minimum": 0 }),
);
