//! Roads: land with hills, junctions, links between them with curves, and the lines painted on them.

pub mod cross_section;
pub mod marking;
pub mod network;
pub mod plan;
pub mod reference_line;
pub mod single;
pub mod terrain;
pub mod town;

pub use cross_section::{Carriageway, PaintedLine};
pub use network::{Junction, Link, LinkIndex, LinkKind, RoadLine, RoadLineId, RoadNetwork};
pub use plan::NetworkPlan;
pub use reference_line::ReferenceLine;
pub use single::{Course, SingleRoad};
pub use terrain::Terrain;
pub use town::TownPlan;
