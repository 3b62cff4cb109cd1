//! `/collections/{lanes, control_points, cells}/items`: the shared map as features, a bounded page at a time.
//!
//! The first page is of the newest revision of the map. The link `next` names that revision, so that all pages of a walk
//! are one map however it changes meanwhile: they are read from the versions of cells that are kept
//! (`cell_versions_kept_s`). Once one of these is gone, the walk is over (410).

use std::sync::Arc;

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_core::fleet::CellId;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    form, in_background,
    link_base::LinkBase,
    ogc::{
        MOST_COORDINATES,
        cell_features::CellFeatures,
        cells::write_state,
        collection::{Collection, MapCollection},
        control_points,
        cursor::{Cursor, MapCursor},
        feature_cache::{FeatureCache, Told},
        item_query::ItemQuery,
        lanes,
    },
    page::{PageFeatures, single},
    problem::{Problem, repeated},
    query::Parameters,
};
use crate::fuse::{CellVersion, MapRevision, SharedMap};

/// Path of the lines of the shared map.
pub(super) const PATH: &str = "/collections/lanes/items";

/// Most cells whose features are counted for `numberMatched`: more would take too long.
const MOST_COUNTED_CELLS: usize = 1024;

/// The borders of a cell.
pub(crate) fn of_cell(cell: CellId) -> Bounds {
    let bounds = cell.bounds();
    Bounds { west: bounds.west, south: bounds.south, east: bounds.east, north: bounds.north, heights: None }
}

/// A walk through a collection, at one of its pages.
struct Walk {
    map: SharedMap,
    cache: FeatureCache,
    collection: Collection,
    kind: MapCollection,
    query: ItemQuery,
    revision: MapRevision,
    /// The cells that may have wanted features, all of the walk, and their versions at the revision.
    cells: Vec<(CellId, CellVersion)>,
    /// Where the page begins.
    from: Option<MapCursor>,
    /// Address of the first page.
    first: String,
}

/// `GET /collections/{collection}/items`
pub(super) async fn items(
    (collection, kind): (Collection, MapCollection),
    State(state): State<ServeState>,
    State(cache): State<FeatureCache>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let query = ItemQuery::read(&uri, &collection)?;
    form::accepts_geojson(&headers)?;
    let walk = Walk::at((collection, kind), state.map, cache, query, &base)?;
    let [of_cells, of_revision] = walk.tags(&base);
    if let Some(tag) = [&of_cells, &of_revision].into_iter().find(|tag| tag.is_held_by(&headers)) {
        return Ok(tag.not_modified());
    }
    let (walk, page) = in_background(move || {
        let page = walk.page();
        (walk, page)
    })
    .await?;
    let page = page?;
    // The next page's address names the revision.
    let tag = if page.next.is_some() { of_revision } else { of_cells };
    page.answer(&walk.collection, &walk.query, &base, tag)
}

impl Walk {
    fn at(
        (collection, kind): (Collection, MapCollection),
        map: SharedMap,
        cache: FeatureCache,
        query: ItemQuery,
        base: &LinkBase,
    ) -> Result<Self, Problem> {
        let first = base.link(&format!("{}{}", collection.items_path(), query.written_with(None)));
        let (revision, mut cells, from) = match query.cursor {
            None => {
                let (revision, cells) = map.list_with_revision();
                let cells = cells.into_iter().map(|(cell, record)| (cell, record.version)).collect::<Vec<_>>();
                (revision, cells, None)
            }
            Some(Cursor::Map(at)) => {
                let over = |reason: String| Problem::WalkOver { reason, first: first.clone() };
                let cells = map.versions_at(at.revision).map_err(|error| over(error.to_string()))?;
                (at.revision, cells.into_iter().collect(), Some(at))
            }
            Some(Cursor::Drives(_)) => return Err(query.foreign_cursor()),
        };
        cells.retain(|(cell, version)| {
            version.0 > 0
                && query.filters.cell.is_none_or(|wanted| wanted == *cell)
                && query.bounds.is_none_or(|bounds| of_cell(*cell).loosened().touches(&bounds))
        });
        Ok(Self { map, cache, collection, kind, query, revision, cells, from, first })
    }

    /// The tags of the page: as the only or last one, and as one that another follows.
    fn tags(&self, base: &LinkBase) -> [EntityTag; 2] {
        let states: Vec<(bool, bool)> = match self.kind {
            MapCollection::Cells => self.cells.iter().map(|(cell, version)| self.state(*cell, *version)).collect(),
            MapCollection::Lanes | MapCollection::ControlPoints => vec![],
        };
        let asked = (self.collection.id, &self.query.written, base.as_str(), states);
        [EntityTag::of((&asked, &self.cells)), EntityTag::of((&asked, &self.cells, self.revision))]
    }

    fn state(&self, cell: CellId, version: CellVersion) -> (bool, bool) {
        (self.map.is_dirty(cell), self.map.record(cell).is_some_and(|record| record.version == version))
    }

    fn page(&self) -> Result<PageFeatures, Problem> {
        let question = self.query.question(&self.collection);
        let counted = self.from.filter(|from| from.question == question).and_then(|from| from.matched);
        let matched = if counted.is_some() { counted } else { self.count()? };
        let mut page = PageFeatures { matched, ..PageFeatures::default() };
        let first = self.from.map_or(0, |from| self.cells.partition_point(|(cell, _)| *cell < from.cell));
        for (cell, version) in &self.cells[first..] {
            let features = self.features(*cell, *version)?;
            let begin = self.from.filter(|from| from.cell == *cell).map_or(0, |from| from.index as usize);
            for index in (begin..features.len()).filter(|index| features.is_wanted(*index, &self.query)) {
                if page.returned == self.query.limit || page.coordinates >= MOST_COORDINATES {
                    let index = u32::try_from(index).unwrap_or(u32::MAX);
                    let next = MapCursor { revision: self.revision, cell: *cell, index, question, matched };
                    page.next = Some(Cursor::Map(next));
                    return Ok(page);
                }
                page.push(features.size(index), |out| self.write(&features, index, out));
            }
        }
        Ok(page)
    }

    fn write(&self, features: &CellFeatures, index: usize, out: &mut Vec<u8>) {
        features.write(index, out);
        if self.kind == MapCollection::Cells {
            write_state(&self.map, features.cell, features.map.version, out);
        }
    }

    /// Number of wanted features on all pages; `None` where there are too many cells to count.
    fn count(&self) -> Result<Option<u64>, Problem> {
        if self.cells.len() > MOST_COUNTED_CELLS {
            return Ok(None);
        }
        let counts = self.cells.iter().map(|(cell, version)| self.count_in(*cell, *version));
        let sum = counts.sum::<Result<usize, Problem>>()?;
        Ok(Some(sum as u64))
    }

    fn count_in(&self, cell: CellId, version: CellVersion) -> Result<usize, Problem> {
        let is_plain = self.query.interval.is_none() && self.query.filters.is_empty();
        if self.kind == MapCollection::Cells || !is_plain {
            return Ok(self.features(cell, version)?.count(&self.query));
        }
        let told = self.cache.told(&self.map, cell, version)?.ok_or_else(|| self.over(cell, version))?;
        let holds =
            |bounds: &Bounds| bounds.heights.is_none() && told.bounds.is_none_or(|around| bounds.holds(&around));
        if self.query.bounds.as_ref().is_none_or(holds) {
            return Ok(self.told_of(&told));
        }
        Ok(self.features(cell, version)?.count(&self.query))
    }

    fn told_of(&self, told: &Told) -> usize {
        if self.kind == MapCollection::Lanes { told.lanes } else { told.control_points }
    }

    fn features(&self, cell: CellId, version: CellVersion) -> Result<Arc<CellFeatures>, Problem> {
        let features = self.cache.get(&self.map, self.kind, cell, version)?;
        features.ok_or_else(|| self.over(cell, version))
    }

    fn over(&self, cell: CellId, version: CellVersion) -> Problem {
        let reason = format!("version {} of cell {cell}, of which this page is, is not kept", version.0);
        Problem::WalkOver { reason, first: self.first.clone() }
    }
}

/// `GET /collections/{collection}/items/{id}`
pub(super) async fn item(
    (collection, kind): (Collection, MapCollection),
    State(state): State<ServeState>,
    State(cache): State<FeatureCache>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    form::accepts_geojson(&headers)?;
    let missing = || Problem::NoSuchFeature { collection: collection.id, feature: repeated(&id) };
    let name = FeatureName::parse(kind, &id).ok_or_else(missing)?;
    let record = state.map.record(name.cell).filter(|record| record.version.0 > 0).ok_or_else(missing)?;
    let (map, cell, version) = (state.map.clone(), name.cell, record.version);
    let features = in_background(move || cache.get(&map, kind, cell, version)).await??.ok_or_else(missing)?;
    let index = name.find(&features).ok_or_else(missing)?;
    let mut text = Vec::new();
    features.write(index, &mut text);
    if kind == MapCollection::Cells {
        write_state(&state.map, cell, version.0, &mut text);
    }
    let tag = EntityTag::of((&text, base.as_str()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    single(&collection, &id, text, &base, &tag)
}

/// What the id of a feature says.
struct FeatureName<'a> {
    cell: CellId,
    lane: &'a str,
    part: u32,
    /// Index of a control point.
    within: Option<usize>,
}

impl<'a> FeatureName<'a> {
    fn parse(kind: MapCollection, id: &'a str) -> Option<Self> {
        let mut parts = id.split('.');
        let named = parts.next()?;
        let cell = named.parse::<CellId>().ok().filter(|cell| cell.to_string() == named)?;
        let mut name = Self { cell, lane: "", part: 0, within: None };
        if kind != MapCollection::Cells {
            name.lane = parts.next()?;
            name.part = number(parts.next()?)?;
        }
        if kind == MapCollection::ControlPoints {
            name.within = Some(number(parts.next()?)?);
        }
        parts.next().is_none().then_some(name)
    }

    fn find(&self, features: &CellFeatures) -> Option<usize> {
        match (self.within, self.lane) {
            (None, "") => Some(0),
            (None, lane) => lanes::find(features, lane, self.part),
            (Some(within), lane) => control_points::find(features, lane, self.part, within),
        }
    }
}

/// A number as ids have it: `+1` and `01` are none.
fn number<T: std::str::FromStr + ToString>(text: &str) -> Option<T> {
    text.parse::<T>().ok().filter(|number| number.to_string() == text)
}
