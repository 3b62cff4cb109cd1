//! The shapes of answers, as JSON Schema in OpenAPI 3.0's dialect.

use serde_json::{Value, json};

use crate::fuse::events::EVENT_KINDS;

/// A schema that has a name in the document.
pub(in crate::serve) fn named(name: &str) -> Value {
    json!({ "$ref": format!("#/components/schemas/{name}") })
}

/// Bytes, e.g. a protobuf message.
pub(in crate::serve) fn bytes() -> Value {
    json!({ "type": "string", "format": "binary" })
}

/// Text for people.
pub(in crate::serve) fn text() -> Value {
    json!({ "type": "string" })
}

/// An object whose members are required.
pub(in crate::serve) fn object(required: Value, optional: Value) -> Value {
    let (Value::Object(mut members), Value::Object(optional)) = (required, optional) else { return json!({}) };
    let names: Vec<String> = members.keys().cloned().collect();
    members.extend(optional);
    json!({ "type": "object", "required": names, "properties": members })
}

/// Many of one shape.
pub(in crate::serve) fn list(items: &Value) -> Value {
    json!({ "type": "array", "items": items })
}

/// A GeoJSON feature collection of a geometry and properties, a page of many.
pub(in crate::serve) fn feature_collection(feature: &Value, optional: Value) -> Value {
    let members = json!({
        "type": { "type": "string", "enum": ["FeatureCollection"] },
        "features": list(feature),
    });
    object(members, optional)
}

/// What the pages of the collections have beside their features.
pub(in crate::serve) fn page_members() -> Value {
    json!({
        "links": links(),
        "numberMatched": { "type": "integer", "minimum": 0 },
        "numberReturned": { "type": "integer", "minimum": 0 },
        "timeStamp": { "type": "string", "format": "date-time" },
    })
}

/// A GeoJSON feature.
pub(in crate::serve) fn feature(geometry: &Value, properties: &Value) -> Value {
    let members = json!({
        "type": { "type": "string", "enum": ["Feature"] },
        "id": { "type": "string" },
        "geometry": geometry,
        "properties": properties,
    });
    object(members, json!({ "links": links() }))
}

pub(in crate::serve) fn links() -> Value {
    list(&named("Link"))
}

fn number() -> Value {
    json!({ "type": "number" })
}

fn count() -> Value {
    json!({ "type": "integer", "minimum": 0 })
}

fn time() -> Value {
    json!({ "type": "string", "format": "date-time" })
}

fn probability() -> Value {
    json!({ "type": "number", "minimum": 0, "maximum": 1 })
}

fn geometry(kind: &str, coordinates: &Value) -> Value {
    object(json!({ "type": { "type": "string", "enum": [kind] }, "coordinates": coordinates }), json!({}))
}

fn coordinate() -> Value {
    json!({ "type": "array", "items": number(), "minItems": 2, "maxItems": 3 })
}

fn line() -> Value {
    json!({ "type": "array", "items": coordinate(), "minItems": 2 })
}

fn lines() -> Value {
    json!({ "oneOf": [geometry("LineString", &line()), geometry("MultiLineString", &list(&line()))] })
}

fn box_of(numbers: u8) -> Value {
    json!({ "type": "array", "items": number(), "minItems": numbers, "maxItems": numbers })
}

fn lane() -> Value {
    let properties = json!({
        "lane": text(), "cell": text(), "part": count(), "version": count(), "category": text(), "category_code": count(),
        "category_posterior": list(&probability()), "drives": count(), "observations": count(), "existence": probability(),
        "lateral_sigma_m": number(), "height_sigma_m": number(), "first_seen": time(), "last_seen": time(),
        "confirmed": time(),
    });
    feature(&lines(), &object(properties, json!({ "comes_from": text(), "continues_in": text() })))
}

fn control_point() -> Value {
    let properties = json!({
        "lane": text(), "cell": text(), "part": count(), "index": count(), "version": count(), "category": text(),
        "drives": count(), "existence": probability(), "lateral_sigma_m": number(), "height_sigma_m": number(),
        "confirmed": time(),
    });
    feature(&geometry("Point", &coordinate()), &object(properties, json!({})))
}

fn cell() -> Value {
    let properties = json!({
        "cell": text(), "version": count(), "lanes": count(), "control_points": count(), "line_km": number(),
        "drives": count(), "state": { "type": "string", "enum": ["current", "dirty", "replaced"] },
    });
    let with_lines = json!({
        "existence": probability(), "lateral_sigma_m": number(), "height_sigma_m": number(), "first_seen": time(),
        "last_seen": time(),
    });
    feature(&geometry("Polygon", &list(&line())), &object(properties, with_lines))
}

fn drive_lane() -> Value {
    let properties = json!({
        "session": text(), "lane": count(), "category": text(), "category_code": count(), "existence": probability(),
        "sigma_m": number(), "observations": count(), "first_seen": time(), "last_seen": time(),
    });
    feature(&lines(), &object(properties, json!({})))
}

fn collection() -> Value {
    let extent = object(
        json!({}),
        json!({
            "spatial": object(json!({ "bbox": list(&box_of(4)), "crs": text() }), json!({})),
            "temporal": object(
                json!({
                    "interval": list(&json!({
                        "type": "array", "minItems": 2, "maxItems": 2,
                        "items": { "type": "string", "format": "date-time", "nullable": true },
                    })),
                    "trs": text(),
                }),
                json!({}),
            ),
        }),
    );
    let members = json!({
        "id": text(), "title": text(), "description": text(), "links": links(), "itemType": text(), "crs": list(&text()),
    });
    object(members, json!({ "extent": extent }))
}

fn listed_cell() -> Value {
    let members = json!({
        "id": text(), "version": count(), "dirty": { "type": "boolean" }, "drives": count(), "kept_apart": count(),
        "lanes": count(), "line_km": number(), "fused_at": time(), "fused_in_s": number(), "bbox": box_of(4),
        "links": links(),
    });
    object(members, json!({ "median_lateral_sigma_m": number() }))
}

fn listed_session() -> Value {
    let vehicle = object(json!({ "position": coordinate(), "heading_deg": number() }), json!({}));
    let members = json!({
        "id": text(), "state": { "type": "string", "enum": ["live", "idle", "closed"] }, "version": count(),
        "lanes": count(), "frames": count(), "georeferenced": { "type": "boolean" }, "placement": text(), "links": links(),
    });
    let states = json!({ "type": "string", "enum": ["aligned", "own_frame", "not_unique", "no_fit"] });
    let aligned = object(json!({ "state": states, "why": text() }), json!({ "sigma_m": number(), "way_m": number() }));
    let optional = json!({ "last_frame_at": time(), "bbox": box_of(4), "vehicle": vehicle, "aligned_to_map": aligned });
    object(members, optional)
}

fn differences() -> Value {
    let properties = json!({ "kind": text(), "cell": text(), "lane": text(), "category": text() });
    let stretch = object(
        json!({
            "type": { "type": "string", "enum": ["Feature"] }, "geometry": lines(),
            "properties": object(properties, json!({ "by_m": number() })),
        }),
        json!({}),
    );
    feature_collection(&stretch, json!({ "since": count(), "revision": count(), "numberReturned": count() }))
}

fn vehicles() -> Value {
    let motion = json!({ "heading_deg": number(), "at": time(), "frames": count(), "lanes": count() });
    let vehicle = feature(&geometry("Point", &coordinate()), &object(motion, json!({})));
    feature_collection(&vehicle, json!({ "live": count(), "drives": count(), "numberReturned": count() }))
}

fn trace() -> Value {
    let moments = json!({
        "session": text(), "version": count(), "times_ms": list(&json!({ "type": "integer" })),
        "headings_deg": list(&number()),
    });
    feature(&geometry("MultiPoint", &list(&coordinate())), &object(moments, json!({})))
}

fn lane_history() -> Value {
    let entry = object(json!({ "version": count(), "at": time(), "features": list(&text()) }), json!({}));
    let kind = json!({ "type": "string", "enum": ["renamed", "merged", "split"] });
    let descent = |others: Value| {
        let members = json!({ "kind": kind, "version": count(), "at": time() });
        object(members, others)
    };
    let members = json!({
        "cell": text(), "lane": text(), "oldest_kept": count(), "newest": count(), "versions": list(&entry),
        "came_from": list(&descent(json!({ "lane": text() }))), "became": list(&descent(json!({ "lanes": list(&text()) }))),
        "events": list(&named("CellEvent")),
    });
    object(members, json!({}))
}

fn cell_event() -> Value {
    let kinds = json!({ "type": "string", "enum": EVENT_KINDS });
    let properties = json!({
        "kind": kinds, "cell": text(), "revision": count(), "version": count(), "told_at": time(),
        "withdrawn": { "type": "boolean" }, "lane": text(), "category": text(), "probability": probability(),
        "drives": count(),
    });
    let optional = json!({ "into": list(&text()), "moved_m": number(), "category_before": text(), "noticed": time() });
    let mut place = geometry("LineString", &line());
    place["nullable"] = json!(true);
    feature(&place, &object(properties, optional))
}

fn timeline() -> Value {
    let step = object(json!({ "revision": count(), "at": time(), "publications": count() }), json!({}));
    object(json!({ "oldest": count(), "newest": count(), "steps": list(&step) }), json!({}))
}

/// Everything that the description names.
pub(super) fn components() -> Value {
    let page = |name: &str| feature_collection(&named(name), page_members());
    let problem = object(
        json!({ "type": text(), "title": text(), "status": count(), "detail": text() }),
        json!({ "parameter": text(), "alternate": text() }),
    );
    json!({
        "schemas": {
            "Problem": problem,
            "Link": object(
                json!({ "href": text(), "rel": text() }),
                json!({ "type": text(), "title": text(), "hreflang": text(), "length": count() }),
            ),
            "LandingPage": object(json!({ "title": text(), "description": text(), "links": links() }), json!({})),
            "Conformance": object(json!({ "conformsTo": list(&text()) }), json!({})),
            "Collection": collection(),
            "Collections": object(json!({ "links": links(), "collections": list(&named("Collection")) }), json!({})),
            "Lane": lane(),
            "Lanes": page("Lane"),
            "ControlPoint": control_point(),
            "ControlPoints": page("ControlPoint"),
            "Cell": cell(),
            "Cells": page("Cell"),
            "DriveLane": drive_lane(),
            "DriveLanes": page("DriveLane"),
            "SessionLanes": feature_collection(&named("DriveLane"), json!({
                "session": text(), "version": count(), "frame": json!({ "type": "object" }),
            })),
            "CellLanes": feature_collection(&named("Lane"), json!({ "cell": text(), "version": count() })),
            "CellChanges": object(
                json!({
                    "cell": text(), "from_version": count(), "to_version": count(), "upserted": list(&named("Lane")),
                    "removed": list(&text()),
                }),
                json!({}),
            ),
            "CellEvent": cell_event(),
            "CellEvents": feature_collection(
                &named("CellEvent"),
                json!({ "cell": text(), "numberReturned": count(), "links": links() }),
            ),
            "MapEvents": feature_collection(
                &named("CellEvent"),
                json!({ "revision": count(), "numberReturned": count(), "more": { "type": "boolean" } }),
            ),
            "Differences": differences(),
            "LaneHistory": lane_history(),
            "Timeline": timeline(),
            "Trace": trace(),
            "Vehicles": vehicles(),
            "ListedCell": listed_cell(),
            "CellList": object(
                json!({
                    "total": count(), "settled": { "type": "boolean" }, "cells": list(&named("ListedCell")),
                    "links": links(),
                }),
                json!({ "revision": count() }),
            ),
            "ListedSession": listed_session(),
            "SessionList": object(
                json!({ "total": count(), "sessions": list(&named("ListedSession")), "links": links() }),
                json!({}),
            ),
        },
        "headers": {
            "ETag": { "description": "Strong entity tag (RFC 9110).", "schema": text() },
        },
        "responses": {
            "NotModified": { "description": "What the request's If-None-Match names is up to date." },
        },
        "securitySchemes": {
            "bearer": { "type": "http", "scheme": "bearer", "bearerFormat": "JWT" },
        },
    })
}
