//! OGC API - Features: the map as collections of GeoJSON features, for whoever opens it unasked (QGIS, GDAL, a browser).
//!
//! | part | here |
//! |---|---|
//! | landing page, conformance, collections | [`landing`] |
//! | which collections there are, what they are filtered by | [`collection`] |
//! | a request for items: `bbox`, `datetime`, filters, `limit` | [`item_query`], [`datetime`], [`filters`] |
//! | where a page begins, at which state of the map | [`cursor`] |
//! | the features of one cell, as they are written | [`cell_features`], [`lanes`], [`control_points`], [`cells`] |
//! | those that were written already | [`feature_cache`] |
//! | a page of them, and one of them | [`super::items`], [`super::drive_items`] |
//!
//! Standard: OGC 17-069r4, classes Core, GeoJSON and OpenAPI 3.0. Coordinates are WGS84 longitude, latitude and height above
//! the ellipsoid (RFC 7946), and nothing else: Part 2 (other reference systems) is not here.

pub(super) mod cell_features;
pub(super) mod cells;
pub(super) mod collection;
pub(super) mod control_points;
pub(super) mod cursor;
pub(super) mod datetime;
pub(super) mod drive_walks;
pub(super) mod feature_cache;
pub(super) mod filters;
pub(super) mod item_query;
pub(super) mod landing;
pub(super) mod lanes;

/// Features of a page, where the query does not say.
pub(super) const DEFAULT_FEATURES: usize = 1_000;
/// Most features of a page.
pub(super) const MOST_FEATURES: usize = 10_000;
/// Most coordinates of a page; the feature that reaches it is the page's last.
pub(super) const MOST_COORDINATES: usize = 200_000;
/// The only reference system of coordinates: WGS84 longitude, latitude.
pub(super) const CRS84: &str = "http://www.opengis.net/def/crs/OGC/1.3/CRS84";
/// The same with ellipsoidal heights.
pub(super) const CRS84H: &str = "http://www.opengis.net/def/crs/OGC/0/CRS84h";
