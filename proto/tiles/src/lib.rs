//! Tiles of the shared map: what is drawn of it in a square of the web-mercator plane. No network, no store, no clock.
//!
//! [`ProjectedCell`] is one version of a cell, made ready once; [`vector_tile`] draws any tile out of the cells that it
//! [`touches`](TileId::cells_touched):
//!
//! ```
//! use lanemap_proto::v1;
//! use lanemap_tiles::{ProjectedCell, TileId, vector_tile};
//!
//! let tile = TileId::new(15, 17_436, 11_371).expect("x and y are below 2^15");
//! let cells: Vec<_> = tile.cells_touched().into_iter().map(|cell| {
//!     ProjectedCell::new(cell, &v1::CellMap { cell: cell.to_string(), ..v1::CellMap::default() })
//! }).collect();
//! assert!(vector_tile(tile, cells.iter()).is_empty(), "nothing is there");
//! ```
//!
//! # The vector tiles
//!
//! MVT 2.1, extent 4096, buffer 128 units, zoom 12 to 20; a tile in which nothing is has no bytes. A line's vertices lie
//! within half a unit of its spline and are the same in every tile that shows them ([`lattice`]).
//!
//! Layer `lanes`: a feature is a line of one cell, as in `/collections/lanes/items`. Its id is the same in all tiles, zooms
//! and versions: 53 bits of a hash of that collection's feature id (`cell.lane.part`).
//!
//! | property | type | zoom | |
//! |---|---|---|---|
//! | `category` | string | all | most probable category, e.g. `white_dashed` |
//! | `category_code` | integer | all | its code in OpenLane |
//! | `drives` | integer | all | drives that saw some of it |
//! | `existence` | number | all | probability that it is there, mean over its control points |
//! | `lateral_sigma_m` | number | all | standard deviation across the line, median over its control points |
//! | `last_seen_s` | integer | all | time of the last frame that saw it, seconds since the Unix epoch |
//! | `confirmed_s` | integer | all | start of the last drive that saw its stalest control point, seconds since the Unix epoch |
//! | `cell`, `lane` | string | 14 and above | the cell, and the line's name: with `part`, its feature id |
//! | `part` | integer | 14 and above | which piece of the line within the cell |
//! | `observations` | integer | 14 and above | frames that saw some of it |
//! | `height_sigma_m` | number | 14 and above | standard deviation of its height, median |
//! | `first_seen_s` | integer | 14 and above | time of the first frame that saw it |
//!
//! Below zoom 14 a lane is narrower than a pixel: of lines that would be drawn over each other only the longest is there, and
//! none that is shorter than a pixel ([`overview`]), so that a tile of a town stays small.
//!
//! Layer `stretches`, zoom 15 and above: the same lines, cut where what is known of them changes along them. Its
//! feature ids are its own; `lane_feature` is the id of the whole line in `lanes`.
//!
//! | property | type | |
//! |---|---|---|
//! | `lane_feature` | integer | id of the line in the layer `lanes` |
//! | `category` | string | as in `lanes` |
//! | `category_code` | integer | as in `lanes` |
//! | `drives` | integer | drives that saw this stretch: of its least seen control point |
//! | `existence` | number | probability that the line is there: mean over this stretch |
//! | `lateral_sigma_m` | number | standard deviation across the line, mean over this stretch |
//! | `height_sigma_m` | number | standard deviation of the height, mean over this stretch |
//! | `confirmed_s` | integer | start of the last drive that saw its stalest control point, seconds since the Unix epoch |
//!
//! Layer `dashes`, zoom 15 and above: the same lines, where they are dashed: what is painted of them, 3 m of every 9 m, cut so
//! that dashes run on through the borders of tiles ([`dashes`]). Its feature ids are those of `lanes`.
//!
//! | property | type | |
//! |---|---|---|
//! | `category`, `category_code`, `existence` | | as in `lanes` |
//! | `cell`, `lane`, `part` | | as in `lanes` |

mod dashes;
pub mod lattice;
mod layers;
pub mod mercator;
pub mod mvt;
pub mod overview;
mod projected;
pub mod spline;
mod stretches;
mod tile;

pub use layers::{Field, FieldType, LAYERS, Layer, vector_tile};
pub use projected::ProjectedCell;
pub use tile::{TileId, TileIdError};

/// Zooms of vector tiles.
pub const VECTOR_ZOOMS: std::ops::RangeInclusive<u8> = 12..=20;
/// First zoom at which every line is there with all that is known of it.
pub const WHOLE_FROM: u8 = 14;
/// First zoom with the layer `stretches`.
pub const STRETCHES_FROM: u8 = 15;
/// First zoom with the layer `dashes`.
pub const DASHES_FROM: u8 = 15;
/// Units along the side of a tile.
pub const EXTENT: u32 = 4096;
/// How far beyond its side a tile shows lines, units: 16 pixels of a tile that is drawn 512 pixels wide.
pub const BUFFER: u32 = 128;
