//! What is described of each address. A new route's description goes here, or beside its handler.

use serde_json::{Value, json};

use super::{
    OPENAPI, Operation,
    parameters::{BBOX, CRS, FORM, LIMIT, Parameter, path_id, revision, whole_number},
    schemas::{bytes, named, text},
};
use crate::serve::{
    ogc::collection::Collection,
    sessions::{GEOJSON, PROTOBUF},
    tiles::VECTOR_TILE,
};
use crate::{export::Format, fuse::events::EVENT_KINDS};

const FEATURES: &str = "OGC API - Features";
const CELLS: &str = "Cells of the shared map";
const TILES: &str = "Tiles";
const DRIVES: &str = "Drives";
const OPERATION: &str = "Operation";
const JSON: &str = "application/json";
const HTML: &str = "text/html";

const CELL_ID: Parameter = path_id("id", "Name of a cell: 14-x-y.");
const SESSION_ID: Parameter = path_id("id", "Name of a drive's session.");
const FEATURE_ID: Parameter = path_id("id", "Id of a feature.");
const SINCE: Parameter = whole_number("since", "The version that the reader has; without it, 0: nothing.");
const REVISION: Parameter =
    revision("revision", "The map as it was at this revision, or nearly so; without it, as it is now.");
const SINCE_REVISION: Parameter =
    revision("since", "Events that a later revision of the map told, or withdrew; without it, all that are kept.");
const AFTER_EVENT: Parameter =
    whole_number("after", "The number of the event after which the page begins: from the link `next`.");
/// Parameters of the changes of the map.
const CHANGES: [Parameter; 4] = [
    Parameter::new(
        "since",
        "The id of the last event that the reader has, or a revision of the map.",
        || json!({ "type": "string", "format": "lanemap-event" }),
    ),
    BBOX,
    Parameter::new(
        "cell",
        "Names of the cells that are followed, separated by commas; not beside bbox.",
        || json!({ "type": "string", "format": "lanemap-cells" }),
    ),
    Parameter::new(
        "content",
        "Whether the lines that differ come with the events.",
        || json!({ "type": "string", "format": "lanemap-content" }),
    ),
];
const AFTER_CELL: Parameter = Parameter::new(
    "after",
    "The cell after which the page begins: from the link `next`.",
    || json!({ "type": "string", "format": "lanemap-cell" }),
);
const AFTER_SESSION: Parameter = Parameter::new(
    "after",
    "The session after which the page begins: from the link `next`.",
    || json!({ "type": "string", "format": "lanemap-session" }),
);

/// A document that has a page for people.
fn document(id: &str, summary: &str, schema: Value) -> Operation {
    Operation::new(id, FEATURES, summary).takes([FORM]).answers(JSON, schema).answers(HTML, text())
}

pub(in crate::serve) fn landing() -> Operation {
    document("landing", "Where everything begins.", named("LandingPage")).for_all()
}

pub(in crate::serve) fn conformance() -> Operation {
    document("conformance", "The standards that the interface conforms to.", named("Conformance")).for_all()
}

pub(in crate::serve) fn api() -> Operation {
    let operation = Operation::new("api", FEATURES, "This description.").takes([FORM]).for_all();
    operation.answers(OPENAPI, json!({ "type": "object" })).answers(HTML, text())
}

pub(in crate::serve) fn collections() -> Operation {
    document("collections", "The collections of features.", named("Collections"))
}

pub(in crate::serve) fn collection(collection: &Collection) -> Operation {
    let summary = format!("What is told of the collection {}.", collection.id);
    document(&format!("{}.collection", collection.id), &summary, named("Collection"))
}

pub(in crate::serve) fn items(collection: &Collection) -> Operation {
    let pages = if collection.of_map.is_some() {
        " The link `next` leads to the next page of the same state of the map, as long as that is kept."
    } else {
        " The link `next` leads to the next page."
    };
    let [_, page] = collection.schemas;
    let operation =
        Operation::new(format!("{}.items", collection.id), FEATURES, format!("A page of {}.", collection.id));
    let operation = operation.describes(format!("{}{pages}", collection.description)).takes(collection.parameters());
    let operation = operation.answers(GEOJSON, named(page));
    if collection.of_map.is_none() {
        return operation;
    }
    operation.refuses(410, "The state of the map of which the page is, is not kept.")
}

pub(in crate::serve) fn item(collection: &Collection) -> Operation {
    let [feature, _] = collection.schemas;
    let operation = Operation::new(format!("{}.item", collection.id), FEATURES, format!("One of {}.", collection.id));
    operation.at(FEATURE_ID).answers(GEOJSON, named(feature))
}

pub(in crate::serve) fn cells() -> Operation {
    let operation = Operation::new("listCells", CELLS, "The cells: version, quality, whether they are up to date.");
    operation.takes([LIMIT, AFTER_CELL]).answers(JSON, named("CellList"))
}

pub(in crate::serve) fn cell() -> Operation {
    Operation::new("cell", CELLS, "One cell.").at(CELL_ID).answers(JSON, named("ListedCell"))
}

pub(in crate::serve) fn cell_lanes_geojson() -> Operation {
    Operation::new("cellLanes", CELLS, "The lines of a cell.").at(CELL_ID).answers(GEOJSON, named("CellLanes"))
}

pub(in crate::serve) fn cell_lanes_protobuf() -> Operation {
    let operation = Operation::new("cellMap", CELLS, "The lines of a cell as splines: lanemap.v1.CellMap.");
    operation.at(CELL_ID).answers(PROTOBUF, bytes())
}

pub(in crate::serve) fn cell_changes_json() -> Operation {
    let operation = Operation::new("cellChanges", CELLS, "What changed in a cell since a version.");
    let operation = operation.at(CELL_ID).takes([SINCE]).answers(JSON, named("CellChanges"));
    operation.refuses(410, "The version is not kept: take the cell whole.")
}

pub(in crate::serve) fn cell_changes_protobuf() -> Operation {
    let operation = Operation::new("cellChangesAsSplines", CELLS, "The same as splines: lanemap.v1.CellChanges.");
    let operation = operation.at(CELL_ID).takes([SINCE]).answers(PROTOBUF, bytes());
    operation.refuses(410, "The version is not kept: take the cell whole.")
}

pub(in crate::serve) fn cell_events() -> Operation {
    let operation =
        Operation::new("cellEvents", CELLS, "What happened to the road of a cell, and to the names of its lines.");
    let operation = operation.describes(
        "The newest events are kept. The link `next` leads to the next page. An event that is believed no more is told again, \
         under its id, as withdrawn.",
    );
    operation.at(CELL_ID).takes([SINCE_REVISION, LIMIT, AFTER_EVENT]).answers(GEOJSON, named("CellEvents"))
}

pub(in crate::serve) fn map_events() -> Operation {
    let kind = Parameter::new(
        "kind",
        "Kinds of events; without it, all.",
        || json!({ "type": "array", "minItems": 1, "items": { "type": "string", "enum": EVENT_KINDS } }),
    );
    let operation = Operation::new("mapEvents", CELLS, "What happened in all cells, the newest first.");
    let operation = operation.describes("The member more says whether there are older ones.");
    operation.takes([SINCE_REVISION, BBOX, kind, LIMIT]).answers(GEOJSON, named("MapEvents"))
}

pub(in crate::serve) fn spline_tile() -> Operation {
    let operation =
        Operation::new("splineTile", CELLS, "The lines that touch a tile, as splines: lanemap.v1.SplineTile.");
    let [z, x, y] = tile_place();
    operation.at(z).at(x).at(y).answers(PROTOBUF, bytes()).may_be_empty()
}

pub(in crate::serve) fn tile_json() -> Operation {
    let operation = Operation::new("tileJson", TILES, "The vector tiles, described: TileJSON 3.0.");
    operation.answers(JSON, json!({ "type": "object", "required": ["tilejson", "tiles", "vector_layers"] }))
}

pub(in crate::serve) fn vector_tile() -> Operation {
    let [z, x, y] = tile_place();
    let operation = Operation::new("vectorTile", TILES, "The lines in a tile as a Mapbox vector tile.");
    let operation = operation.at(z).at(x).at(y).takes([REVISION]).answers(VECTOR_TILE, bytes()).may_be_empty();
    operation.refuses(410, "That state of the map is not kept.")
}

pub(in crate::serve) fn style() -> Operation {
    let operation = Operation::new("style", TILES, "A MapLibre style that draws the vector tiles as paint.");
    operation.answers(JSON, json!({ "type": "object", "required": ["version", "sources", "layers"] })).for_all()
}

pub(in crate::serve) fn export() -> Operation {
    let format = Parameter::new(
        "format",
        "The format; without it, that of the suffix of the name, else of Accept.",
        || json!({ "type": "string", "enum": Format::ALL.map(Format::name) }),
    );
    let traffic = Parameter::new(
        "traffic",
        "The side of the road on which vehicles drive.",
        || json!({ "type": "string", "enum": ["right", "left"], "default": "right" }),
    );
    let operation = Operation::new("export", CELLS, "A cell for other programs.");
    let operation = operation.describes("GeoJSON, FlatGeobuf, PMTiles, Lanelet2 or OpenDRIVE.");
    let operation = operation.at(CELL_ID).takes([format, traffic]);
    Format::ALL.into_iter().fold(operation, |operation, format| {
        let is_json = format == Format::GeoJson;
        operation.answers(format.media_type(), if is_json { json!({ "type": "object" }) } else { bytes() })
    })
}

pub(in crate::serve) fn lane_history() -> Operation {
    let operation =
        Operation::new("laneHistory", CELLS, "How a line came to be, over the versions of its cell that are kept.");
    let operation = operation.at(CELL_ID).at(path_id("lane", "Name of a line."));
    operation.answers(JSON, named("LaneHistory"))
}

pub(in crate::serve) fn differences() -> Operation {
    let since = revision("since", "The revision of the map with which it is compared; without it, 0: nothing.");
    let operation = Operation::new("differences", CELLS, "Where the map is another one than it was at a revision.");
    let operation = operation.takes([since, BBOX]).answers(GEOJSON, named("Differences"));
    operation.refuses(410, "That state of the map is not kept.")
}

pub(in crate::serve) fn timeline() -> Operation {
    let steps = Parameter::new(
        "steps",
        "Most steps into which time is cut; there is a most of that, too.",
        || json!({ "type": "integer", "minimum": 1 }),
    );
    let operation = Operation::new("timeline", CELLS, "When the map changed: revisions to go back to.");
    operation.takes([steps]).answers(JSON, named("Timeline"))
}

pub(in crate::serve) fn live_vehicles() -> Operation {
    let operation = Operation::new("liveVehicles", DRIVES, "Where the vehicles are that stream now.");
    operation.takes([BBOX, LIMIT]).answers(GEOJSON, named("Vehicles"))
}

pub(in crate::serve) fn session_trace() -> Operation {
    let operation = Operation::new("sessionTrace", DRIVES, "Where the vehicle of a drive was, and when.");
    let operation = operation.at(SESSION_ID).takes([CRS]).answers(GEOJSON, named("Trace"));
    operation.refuses(409, "The drive has no place on the earth: crs=local gives metres.")
}

pub(in crate::serve) fn changes() -> Operation {
    let operation =
        Operation::new("changes", CELLS, "What changes in the shared map, as it changes: server-sent events.");
    let operation = operation.describes(
        "Events start, cell and reset, each with an id; since, or the header Last-Event-ID, goes on after one. The answer \
         stays open.",
    );
    operation.takes(CHANGES).answers("text/event-stream", text()).of_now()
}

/// Zoom, column and row of a tile in the path.
pub(in crate::serve) fn tile_place() -> [Parameter; 3] {
    [whole_number("z", "Zoom."), whole_number("x", "Column, from the west."), whole_number("y", "Row, from the north.")]
}

pub(in crate::serve) fn sessions() -> Operation {
    let operation = Operation::new("listSessions", DRIVES, "The drives, the newest first: state, version, place.");
    operation.takes([LIMIT, AFTER_SESSION]).answers(JSON, named("SessionList"))
}

pub(in crate::serve) fn session_lanes_geojson() -> Operation {
    let operation = Operation::new("sessionLanes", DRIVES, "The lanes of one drive, as it alone saw them.");
    let operation = operation.at(SESSION_ID).takes([CRS]).answers(GEOJSON, named("SessionLanes"));
    operation.refuses(409, "The drive has no place on the earth: crs=local gives metres.")
}

pub(in crate::serve) fn session_lanes_protobuf() -> Operation {
    let operation = Operation::new("sessionMap", DRIVES, "The same as splines: lanemap.v1.LaneMap.");
    operation.at(SESSION_ID).answers(PROTOBUF, bytes())
}

pub(in crate::serve) fn health() -> Operation {
    Operation::new("health", OPERATION, "The process answers.").answers("text/plain", text()).of_now().for_all()
}

pub(in crate::serve) fn readiness() -> Operation {
    let operation = Operation::new("readiness", OPERATION, "The service takes traffic.").answers("text/plain", text());
    operation.of_now().for_all()
}

pub(in crate::serve) fn metrics() -> Operation {
    Operation::new("metrics", OPERATION, "Figures for Prometheus.").answers("text/plain", text()).of_now()
}
