//! Boxes on the earth: the `bbox` of a query, the box around a set of lanes, and whether a line enters a box.
//!
//! A box whose west is east of its east runs over the antimeridian (RFC 7946, 5.2).

use lanemap_core::geometry::georeference::Georeference;
use nalgebra::Point3;

use super::line::{Coordinate, written};
use crate::session::published::extent;

/// A box in degrees, with heights in metres where a query names them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Western border, degrees, in `[-180, 180]`.
    pub west: f64,
    /// Southern border, degrees, in `[-90, 90]`.
    pub south: f64,
    /// Eastern border, degrees; below `west` in a box over the antimeridian.
    pub east: f64,
    /// Northern border, degrees, not below `south`.
    pub north: f64,
    /// Lowest and highest height, metres above the ellipsoid.
    pub heights: Option<(f64, f64)>,
}

impl Bounds {
    /// Reads `west,south,east,north` or `west,south,low,east,north,high`.
    ///
    /// # Errors
    /// Another count of numbers, one that is not finite or out of range, south above north, low above high.
    pub fn parse(text: &str) -> Result<Self, String> {
        let numbers = text
            .split(',')
            .map(|number| number.trim().parse::<f64>().ok().filter(|value| value.is_finite()))
            .collect::<Option<Vec<f64>>>()
            .ok_or("it must be finite numbers separated by commas")?;
        let (west, south, east, north, heights) = match numbers[..] {
            [west, south, east, north] => (west, south, east, north, None),
            [west, south, low, east, north, high] => (west, south, east, north, Some((low, high))),
            _ => return Err(format!("it must have 4 or 6 numbers, and has {}", numbers.len())),
        };
        for (name, value, limit) in
            [("west", west, 180.0), ("east", east, 180.0), ("south", south, 90.0), ("north", north, 90.0)]
        {
            if value.abs() > limit {
                return Err(format!("{name} = {value} is outside -{limit} ..= {limit}"));
            }
        }
        if south > north {
            return Err(format!("south = {south} is above north = {north}"));
        }
        if let Some((low, high)) = heights.filter(|(low, high)| low > high) {
            return Err(format!("its lowest height {low} is above its highest {high}"));
        }
        Ok(Self { west, south, east, north, heights })
    }

    /// The box around points of a map frame; `None` without points.
    ///
    /// The box is taken in metres and its border carried to the earth, so that it costs 9 conversions however many
    /// points there are. Not guaranteed: to enclose them exactly ([`Bounds::loosened`] does).
    #[must_use]
    pub fn around(georeference: &Georeference, points_map: impl Iterator<Item = Point3<f64>>) -> Option<Self> {
        let corners = extent(points_map.map(|point| georeference.enu_from_map * point))?;
        Self::around_extent(georeference, corners)
    }

    /// The box around an extent in east-north-up at the anchor, metres: lowest and highest corner.
    #[must_use]
    pub fn around_extent(georeference: &Georeference, [low, high]: [Point3<f64>; 2]) -> Option<Self> {
        let halves = [0.0, 0.5, 1.0];
        let border = halves.into_iter().flat_map(|x| halves.into_iter().map(move |y| (x, y))).map(|(x, y)| {
            let along = |axis: usize, part: f64| low[axis] + (high[axis] - low[axis]) * part;
            let point_enu = Point3::new(along(0, x), along(1, y), 0.5 * (low.z + high.z));
            written(georeference.anchor.wgs84_from_enu(&point_enu))
        });
        Self::of_coordinates(border)
    }

    fn of_coordinates(mut border: impl Iterator<Item = Coordinate>) -> Option<Self> {
        let [longitude, latitude, _] = border.next()?;
        let (mut west, mut east) = (longitude, longitude);
        let (mut south, mut north) = (latitude, latitude);
        for [next, latitude, _] in border {
            // Beside the first one, even where the antimeridian lies between them.
            let beside = next - 360.0 * ((next - longitude) / 360.0).round();
            (west, east) = (west.min(beside), east.max(beside));
            (south, north) = (south.min(latitude), north.max(latitude));
        }
        let wrapped = |longitude: f64| longitude - 360.0 * (longitude / 360.0).round();
        Some(Self { west: wrapped(west), south, east: wrapped(east), north, heights: None })
    }

    /// A box that surely holds the lanes whose control points this box is [`Bounds::around`].
    ///
    /// A spline swings out of its control points by decimetres, and a wide box bulges on the earth by metres where only
    /// its corners and middles were converted: a metre and a hundredth of its size cover both, to 1,000 km.
    #[must_use]
    pub fn loosened(self) -> Self {
        let size_deg = (self.north - self.south) + (self.east - self.west).rem_euclid(360.0);
        self.widened(1e-5 + 0.01 * size_deg)
    }

    fn widened(self, degrees: f64) -> Self {
        let [west, east] = [self.west - degrees, self.east + degrees].map(|longitude| {
            if longitude.abs() > 180.0 { longitude - 360.0_f64.copysign(longitude) } else { longitude }
        });
        Self { west, south: self.south - degrees, east, north: self.north + degrees, heights: self.heights }
    }

    /// Whether two boxes share a point, heights aside.
    #[must_use]
    pub fn touches(&self, other: &Self) -> bool {
        let across = self.spans().into_iter().flatten().any(|(west, east)| {
            other.spans().into_iter().flatten().any(|(other_west, other_east)| west <= other_east && other_west <= east)
        });
        across && self.south <= other.north && other.south <= self.north
    }

    /// Whether all of another box, which does not cross the antimeridian, lies in this one, heights aside.
    #[must_use]
    pub fn holds(&self, other: &Self) -> bool {
        let across = self.spans().into_iter().flatten().any(|(west, east)| west <= other.west && other.east <= east);
        across && self.south <= other.south && other.north <= self.north
    }

    /// Whether a line, cut at the antimeridian, enters this box.
    #[must_use]
    pub fn is_entered_by(&self, line: &[Coordinate]) -> bool {
        let at_its_height = self.heights.is_none_or(|(low, high)| {
            line.iter().any(|point| point[2] >= low) && line.iter().any(|point| point[2] <= high)
        });
        at_its_height
            && self.spans().into_iter().flatten().any(|(west, east)| {
                line.windows(2).any(|pair| chord_enters(pair[0], pair[1], [west, self.south], [east, self.north]))
            })
    }

    /// Longitudes that the box spans, in one piece or in two.
    fn spans(&self) -> [Option<(f64, f64)>; 2] {
        if self.west <= self.east {
            [Some((self.west, self.east)), None]
        } else {
            [Some((self.west, 180.0)), Some((-180.0, self.east))]
        }
    }

    /// The smallest box around others: the longitudes that it leaves out are the widest that all of them do. `None` without
    /// boxes.
    #[must_use]
    pub fn around_all(boxes: &[Self]) -> Option<Self> {
        let mut spans: Vec<(f64, f64)> = boxes.iter().flat_map(|one| one.spans().into_iter().flatten()).collect();
        spans.sort_unstable_by(|one, other| one.0.total_cmp(&other.0));
        let (first_west, mut reached) = *spans.first()?;
        // Width of each gap, its western and its eastern end.
        let mut gaps = Vec::new();
        for (west, east) in spans {
            if west > reached {
                gaps.push((west - reached, reached, west));
            }
            reached = reached.max(east);
        }
        gaps.push((first_west + 360.0 - reached, reached, first_west));
        let (_, east, west) = gaps.into_iter().max_by(|one, other| one.0.total_cmp(&other.0))?;
        Some(Self {
            west,
            south: boxes.iter().map(|one| one.south).fold(f64::INFINITY, f64::min),
            east,
            north: boxes.iter().map(|one| one.north).fold(f64::NEG_INFINITY, f64::max),
            heights: None,
        })
    }

    /// `[west, south, east, north]`, as GeoJSON writes a box.
    #[must_use]
    pub fn to_array(&self) -> [f64; 4] {
        [self.west, self.south, self.east, self.north]
    }
}

/// Liang and Barsky: whether a chord shares a point with an upright rectangle.
fn chord_enters(start: Coordinate, end: Coordinate, low: [f64; 2], high: [f64; 2]) -> bool {
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for axis in 0..2 {
        let run = end[axis] - start[axis];
        if run == 0.0 {
            if start[axis] < low[axis] || start[axis] > high[axis] {
                return false;
            }
            continue;
        }
        let (to_low, to_high) = ((low[axis] - start[axis]) / run, (high[axis] - start[axis]) / run);
        enter = enter.max(to_low.min(to_high));
        leave = leave.min(to_low.max(to_high));
    }
    enter <= leave
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::{line::on_the_earth, sample::georeference};

    #[test]
    fn a_malformed_box_is_refused_with_what_is_wrong() {
        for (text, reason) in [
            ("1,2,3", "it must have 4 or 6 numbers, and has 3"),
            ("1,2,x,4", "it must be finite numbers separated by commas"),
            ("1,2,NaN,4", "it must be finite numbers separated by commas"),
            ("1,2,181,4", "east = 181 is outside -180 ..= 180"),
            ("1,5,3,4", "south = 5 is above north = 4"),
            ("1,2,9,3,4,8", "its lowest height 9 is above its highest 8"),
        ] {
            assert_eq!(Bounds::parse(text).unwrap_err(), reason, "{text}");
        }
    }

    #[test]
    fn a_line_enters_a_box_that_it_crosses_without_a_point_inside() {
        let bounds = Bounds::parse("1,1,2,2").unwrap();
        assert!(bounds.is_entered_by(&[[0.0, 1.5, 0.0], [3.0, 1.6, 0.0]]));
        assert!(!bounds.is_entered_by(&[[0.0, 0.5, 0.0], [3.0, 0.6, 0.0]]));
        assert!(!bounds.is_entered_by(&[[0.0, 2.5, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 0.0]]));
    }

    #[test]
    fn a_box_over_the_antimeridian_is_entered_from_both_sides() {
        let bounds = Bounds::parse("179,-1,-179,1").unwrap();
        assert!(bounds.is_entered_by(&[[179.5, 0.0, 0.0], [180.0, 0.0, 0.0]]));
        assert!(bounds.is_entered_by(&[[-180.0, 0.0, 0.0], [-179.5, 0.0, 0.0]]));
        assert!(!bounds.is_entered_by(&[[178.0, 0.0, 0.0], [178.5, 0.0, 0.0]]));
        assert!(bounds.touches(&Bounds::parse("-179.5,0,-170,0.5").unwrap()));
        assert!(!bounds.touches(&Bounds::parse("-178,0,-170,0.5").unwrap()));
    }

    #[test]
    fn the_box_around_others_leaves_out_the_widest_gap() {
        let around = |boxes: &[&str]| {
            let boxes: Vec<_> = boxes.iter().map(|text| Bounds::parse(text).unwrap()).collect();
            Bounds::around_all(&boxes).map(|around| around.to_array())
        };
        assert_eq!(around(&[]), None);
        assert_eq!(around(&["11,48,12,49"]), Some([11.0, 48.0, 12.0, 49.0]));
        assert_eq!(around(&["11,48,12,49", "13,47,14,48", "11.5,48,13.5,48"]), Some([11.0, 47.0, 14.0, 49.0]));
        assert_eq!(around(&["179,-1,-179,1", "-170,0,-160,2"]), Some([179.0, -1.0, -160.0, 2.0]));
        assert_eq!(around(&["170,0,175,1", "-175,0,-170,1"]), Some([170.0, 0.0, -170.0, 1.0]));
    }

    #[test]
    fn heights_of_a_box_leave_out_a_bridge_above_it() {
        let bounds = Bounds::parse("1,1,0,2,2,10").unwrap();
        assert!(bounds.is_entered_by(&[[0.0, 1.5, 5.0], [3.0, 1.5, 5.0]]));
        assert!(!bounds.is_entered_by(&[[0.0, 1.5, 15.0], [3.0, 1.5, 15.0]]));
    }

    #[test]
    fn the_loosened_box_around_points_encloses_each_of_them_over_the_antimeridian_and_over_100_km() {
        for step_m in [9.0, 2_000.0] {
            let georeference = georeference(-179.9999, 48.0);
            let points: Vec<_> =
                (0..50).map(|i| Point3::new(f64::from(i) * step_m, f64::from(i % 7) * 3.0, 0.0)).collect();
            let bounds = Bounds::around(&georeference, points.iter().copied()).unwrap().loosened();
            assert!(bounds.west > bounds.east, "it runs over the antimeridian");
            for point in &points {
                let place = on_the_earth(&georeference, point);
                assert!(bounds.is_entered_by(&[place, place]), "{place:?} in {bounds:?}");
            }
        }
    }
}
