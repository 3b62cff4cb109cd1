//! What a snapshot keeps of a lane's information: rows without their trailing zeros, and no factor, which is made anew.

use std::collections::VecDeque;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::{BandedInformation, BandedSum, FactorRow, Knot, Row};

/// What a snapshot keeps of a sum.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct StoredSum {
    first: Knot,
    rows: Vec<StoredRow>,
}

/// A row without its trailing zeros: behind the vehicle most of a wide band is empty.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct StoredRow {
    band: Vec<f64>,
    right: Vector3<f64>,
}

impl<const W: usize> From<Row<W>> for StoredRow {
    fn from(row: Row<W>) -> Self {
        Self { band: row.band[..=row.reach].to_vec(), right: row.right }
    }
}

impl<const W: usize> From<StoredRow> for Row<W> {
    fn from(stored: StoredRow) -> Self {
        let reach = stored.band.len().clamp(1, W) - 1;
        let mut row = Self { right: stored.right, reach, ..Self::default() };
        row.band.iter_mut().zip(stored.band).for_each(|(mine, theirs)| *mine = theirs);
        row
    }
}

impl<const W: usize> From<BandedSum<W>> for StoredSum {
    fn from(sum: BandedSum<W>) -> Self {
        Self { first: sum.first, rows: sum.rows.into_iter().map(StoredRow::from).collect() }
    }
}

impl<const W: usize> From<StoredSum> for BandedSum<W> {
    fn from(stored: StoredSum) -> Self {
        Self { first: stored.first, rows: stored.rows.into_iter().map(Row::from).collect() }
    }
}

/// What a snapshot keeps: the factor is a function of the rows and is made anew.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Stored {
    anchor: Point3<f64>,
    head: Knot,
    rows: Vec<StoredRow>,
    offsets: VecDeque<Vector3<f64>>,
}

impl<const W: usize> From<BandedInformation<W>> for Stored {
    fn from(information: BandedInformation<W>) -> Self {
        let BandedInformation { anchor, head, rows, offsets, .. } = information;
        Self { anchor, head, rows: rows.into_iter().map(StoredRow::from).collect(), offsets }
    }
}

impl<const W: usize> From<Stored> for BandedInformation<W> {
    fn from(stored: Stored) -> Self {
        let Stored { anchor, head, rows, offsets } = stored;
        let rows: VecDeque<Row<W>> = rows.into_iter().map(Row::from).collect();
        let positions = offsets.iter().map(|offset| anchor + offset).collect();
        let factor = std::iter::repeat_n(FactorRow::default(), rows.len()).collect();
        let mut information = Self { anchor, head, rows, factor, offsets, positions, touched: None };
        information.refactorise(0, information.rows.len().saturating_sub(1));
        information
    }
}
