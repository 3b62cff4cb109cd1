//! What is drawn of a cell from afar, below zoom 14: the lanes of a road lie within one pixel there.
//!
//! The longest line is drawn first; a line most of whose way (nine tenths) leads through pixels that hold a line already, or
//! beside them, is left out, and so is one that is shorter than a pixel. A function of the cell and the zoom alone:
//! neighbouring tiles show the same lines.

use std::{cmp::Reverse, collections::HashSet};

use crate::{lattice::Vertex, projected::ProjectedLine};

/// Number of zooms that are drawn so.
pub(crate) const OVERVIEW_ZOOMS: usize = (crate::WHOLE_FROM - *crate::VECTOR_ZOOMS.start()) as usize;
/// Side of a pixel, units, of a tile that is drawn 512 pixels wide.
const PIXEL: i64 = 8;
/// Of ten pixels on a line's way, how many hold a line where it is left out.
const COVERED_OF_TEN: usize = 9;

/// What is drawn of a cell at one zoom.
#[derive(Debug, Default)]
pub(crate) struct Overview {
    /// Indices of lines, in the cell's order, and their vertices.
    pub(crate) lines: Vec<(usize, Vec<Vertex>)>,
}

impl Overview {
    pub(crate) fn of(lines: &[ProjectedLine], zoom: u8) -> Self {
        let mut drawn: Vec<(usize, Vec<Vertex>)> = Vec::with_capacity(lines.len());
        for (index, line) in lines.iter().enumerate() {
            let mut vertices = Vec::new();
            line.curve().append_vertices(0, line.last(), zoom, &mut vertices);
            if length(&vertices) >= PIXEL {
                drawn.push((index, vertices));
            }
        }
        drawn.sort_by_key(|(index, vertices)| (Reverse(length(vertices)), *index));
        let mut held = HashSet::new();
        drawn.retain(|(_, vertices)| {
            let way = pixels(vertices);
            let covered = way.iter().filter(|pixel| is_near(pixel, &held)).count();
            let kept = 10 * covered < COVERED_OF_TEN * way.len();
            if kept {
                held.extend(way);
            }
            kept
        });
        drawn.sort_unstable_by_key(|(index, _)| *index);
        Self { lines: drawn }
    }
}

/// Length of a line, at least, in units: the greater of both axes, summed.
fn length(vertices: &[Vertex]) -> i64 {
    vertices.windows(2).map(|pair| (pair[1][0] - pair[0][0]).abs().max((pair[1][1] - pair[0][1]).abs())).sum()
}

/// The pixels on a line's way.
fn pixels(vertices: &[Vertex]) -> Vec<[i64; 2]> {
    let mut way = Vec::new();
    for pair in vertices.windows(2) {
        let step = [pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]];
        let steps = (step[0].abs().max(step[1].abs()) / PIXEL).max(1);
        for part in 0..=steps {
            let pixel = [0, 1].map(|axis| (pair[0][axis] + step[axis] * part / steps).div_euclid(PIXEL));
            if way.last() != Some(&pixel) {
                way.push(pixel);
            }
        }
    }
    way
}

fn is_near(pixel: &[i64; 2], held: &HashSet<[i64; 2]>) -> bool {
    (-1..=1).any(|x| (-1..=1).any(|y| held.contains(&[pixel[0] + x, pixel[1] + y])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_way_of_a_line_leads_through_neighbouring_pixels() {
        let way = pixels(&[[0, 0], [100, 40], [100, 90]]);
        assert_eq!((way.first(), way.last()), (Some(&[0, 0]), Some(&[12, 11])));
        for pair in way.windows(2) {
            assert!((pair[1][0] - pair[0][0]).abs() <= 1 && (pair[1][1] - pair[0][1]).abs() <= 1, "{pair:?}");
        }
    }
}
