//! The collections, and what their features are filtered by.

use crate::serve::openapi::parameters::{
    BBOX, BBOX_CRS, CATEGORY, CELL, DATETIME, DRIVES, DRIVES_CURSOR, LANE, LIMIT, MAP_CURSOR, MAX_LATERAL_SIGMA_M,
    MIN_DRIVES, MIN_EXISTENCE, Parameter, SESSION,
};

/// A collection of the shared map, whose features lie in cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(in crate::serve) enum MapCollection {
    Lanes,
    ControlPoints,
    Cells,
}

/// What is told of a collection.
#[derive(Clone, Copy, Debug)]
pub(in crate::serve) struct Collection {
    pub(in crate::serve) id: &'static str,
    pub(in crate::serve) title: &'static str,
    pub(in crate::serve) description: &'static str,
    /// Names of the schemas of one feature and of a page.
    pub(in crate::serve) schemas: [&'static str; 2],
    /// What its features are filtered by, besides `bbox` and `datetime`.
    pub(in crate::serve) filters: &'static [Parameter],
    /// Whether coordinates have heights.
    pub(in crate::serve) has_heights: bool,
    /// `None`: the drives.
    pub(in crate::serve) of_map: Option<MapCollection>,
}

pub(in crate::serve) const LANES: Collection = Collection {
    id: "lanes",
    title: "Lanes",
    description: "The lines of the shared map, cut where cells end: category with its probabilities, standard deviations \
        against the map around them, how many drives and frames saw them, the probability that they are there, and when they \
        were seen first and last. A line keeps its name (`lane`) over cells and versions.",
    schemas: ["Lane", "Lanes"],
    filters: &[CATEGORY, CELL, LANE, DRIVES, MIN_DRIVES, MIN_EXISTENCE, MAX_LATERAL_SIGMA_M],
    has_heights: true,
    of_map: Some(MapCollection::Lanes),
};

const CONTROL_POINTS: Collection = Collection {
    id: "control_points",
    title: "Control points",
    description: "The control points of the lines' Catmull-Rom splines, about 3 m apart: standard deviations, the probability \
        that the line is there, how many drives saw it there, and when the last of them set out (`confirmed`).",
    schemas: ["ControlPoint", "ControlPoints"],
    filters: &[CATEGORY, CELL, LANE, DRIVES, MIN_DRIVES, MIN_EXISTENCE, MAX_LATERAL_SIGMA_M],
    has_heights: true,
    of_map: Some(MapCollection::ControlPoints),
};

const CELLS: Collection = Collection {
    id: "cells",
    title: "Cells",
    description: "The pieces in which the shared map is fused: web-mercator tiles of zoom 14, with their version and the \
        quality of their lines. `state` is of now: current, dirty (drives have said more, which is being fused), or replaced \
        (a newer version is there than this page's).",
    schemas: ["Cell", "Cells"],
    filters: &[CELL, DRIVES, MIN_DRIVES, MIN_EXISTENCE, MAX_LATERAL_SIGMA_M],
    has_heights: false,
    of_map: Some(MapCollection::Cells),
};

pub(in crate::serve) const DRIVE_LANES: Collection = Collection {
    id: "drives",
    title: "Drives",
    description: "The lanes of all drives that have a place on the earth, each as that drive alone saw them. Drives change \
        while they are driven: pages of one walk are of now, and a lane that is there all along comes once.",
    schemas: ["DriveLane", "DriveLanes"],
    filters: &[CATEGORY, SESSION, MIN_EXISTENCE],
    has_heights: true,
    of_map: None,
};

/// All collections, in the order in which they are listed.
pub(in crate::serve) const COLLECTIONS: [Collection; 4] = [LANES, CONTROL_POINTS, CELLS, DRIVE_LANES];

impl Collection {
    /// Every query parameter of its items.
    pub(in crate::serve) fn parameters(&self) -> Vec<Parameter> {
        let cursor = if self.of_map.is_some() { MAP_CURSOR } else { DRIVES_CURSOR };
        [BBOX, BBOX_CRS, DATETIME, LIMIT, cursor].into_iter().chain(self.filters.iter().copied()).collect()
    }

    /// Address of its items.
    pub(in crate::serve) fn items_path(&self) -> String {
        format!("/collections/{}/items", self.id)
    }
}
