//! The bits of a line: written and read field by field, in the order of `spline_tile.proto`.

use lanemap_core::{
    LaneId, TimestampNs,
    fleet::{CellId, DriveId, FusedLaneId},
};

use super::{
    bits::{BitReader, BitWriter, signed_cost},
    fit::Step,
    fitted::{FittedBorder, FittedLine, seconds},
    known::Codes,
    steps::{Heading, LENGTHS_MM, Millimetres},
};

/// The length that stands for one that follows in millimetres.
const MEASURED: u64 = 14;
/// The length that stands for a step in each axis.
const FREE: u64 = 15;
/// Columns and rows of the neighbours of a cell, from north, clockwise.
const AROUND: [[i64; 2]; 8] = [[0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1]];
/// Most control points of a line that is read: bounds what a short string of bits may ask for.
const MOST_POINTS: u64 = 1 << 20;

/// A drive after which lines are named.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Witness {
    pub(super) started: TimestampNs,
    pub(super) drive: DriveId,
}

impl Witness {
    pub(super) fn of(id: &FusedLaneId) -> Self {
        Self { started: id.started, drive: id.drive }
    }
}

/// What all lines of a cell have in common.
#[derive(Debug)]
pub(super) struct CellCode {
    pub(super) cell: CellId,
    /// Latitude and longitude of the anchor, in units of 1e-9 degrees.
    pub(super) anchor: [i64; 2],
    /// In their order.
    pub(super) witnesses: Vec<Witness>,
    pub(super) left_order: u32,
    pub(super) up_order: u32,
}

/// What the next line is coded against.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Before {
    witness: usize,
    lane: u64,
    first: Millimetres,
    codes: Codes,
}

/// A line as it was read.
#[derive(Clone, Debug)]
pub(super) struct CodedLine {
    pub(super) id: FusedLaneId,
    pub(super) part: u32,
    pub(super) category: u64,
    pub(super) doubt_percent: u64,
    pub(super) drives: u32,
    pub(super) last_seen_s: i64,
    pub(super) confirmed_s: i64,
    pub(super) begins_at: Option<FittedBorder>,
    pub(super) ends_at: Option<FittedBorder>,
    pub(super) points: Vec<(Millimetres, Codes)>,
}

/// The orders by which the offsets of some lines take the fewest bits: to the left, and upwards.
pub(super) fn best_orders(lines: &[&FittedLine]) -> (u32, u32) {
    let best = |offset: fn(&Step) -> Option<i64>| {
        let cost = |order: u32| -> u64 {
            let offsets = lines.iter().flat_map(|line| &line.knots).filter_map(|(knot, _)| offset(&knot.step));
            offsets.map(|offset| u64::from(signed_cost(offset, order))).sum()
        };
        (0..16).min_by_key(|order| cost(*order)).unwrap_or_default()
    };
    let along = |step: &Step| if let Step::Along { left_mm, .. } = step { Some(*left_mm) } else { None };
    let upwards = |step: &Step| if let Step::Along { up_mm, .. } = step { Some(*up_mm) } else { None };
    (best(along), best(upwards))
}

impl CellCode {
    pub(super) fn write(&self, line: &FittedLine, before: &mut Before, bits: &mut BitWriter) {
        let witness = self.index(&line.id);
        bits.unsigned((witness - before.witness) as u64, 0);
        let earlier = if witness == before.witness { before.lane } else { 0 };
        bits.signed(line.id.lane.0.wrapping_sub(earlier).cast_signed(), 5);
        for number in [line.id.piece, line.id.stretch, line.part] {
            bits.unsigned(number.into(), 0);
        }
        bits.bits(line.category, 4);
        bits.unsigned(line.doubt_percent, 0);
        bits.unsigned(line.drives.saturating_sub(1).into(), 1);
        let started_s = seconds(line.id.started.0);
        bits.signed(line.last_seen_s - started_s, 8);
        let confirmed_after_s = line.confirmed_s - started_s;
        // Two times that were rounded down to seconds: a second is no difference.
        bits.flag(confirmed_after_s.abs() > 1);
        if confirmed_after_s.abs() > 1 {
            bits.signed(confirmed_after_s, 12);
        }
        for border in [&line.begins_at, &line.ends_at] {
            bits.flag(border.is_some());
            if let Some(border) = border {
                self.write_border(border, &line.id, bits);
            }
        }
        bits.unsigned(line.knots.len() as u64 - 2, 3);
        write_points(self, line, before, bits);
        (before.witness, before.lane) = (witness, line.id.lane.0);
    }

    fn write_border(&self, border: &FittedBorder, id: &FusedLaneId, bits: &mut BitWriter) {
        let [latitude, longitude, height_mm] = border.place;
        bits.signed(latitude - self.anchor[0], 23);
        bits.signed(longitude - self.anchor[1], 23);
        bits.signed(height_mm, 14);
        let next = border.continues_in.and_then(|(cell, next, part)| Some((self.direction(cell)?, next, part)));
        bits.flag(next.is_some());
        if let Some((direction, next, part)) = next {
            bits.bits(direction, 3);
            bits.flag(next != *id);
            if next != *id {
                bits.unsigned(self.index(&next) as u64, 0);
                bits.unsigned(next.lane.0, 5);
                bits.unsigned(next.piece.into(), 0);
                bits.unsigned(next.stretch.into(), 0);
            }
            bits.unsigned(part.into(), 0);
        }
    }

    pub(super) fn read(&self, before: &mut Before, bits: &mut BitReader<'_>) -> Option<CodedLine> {
        let witness = before.witness.checked_add(usize::try_from(bits.unsigned(0)?).ok()?)?;
        let earlier = if witness == before.witness { before.lane } else { 0 };
        let lane = earlier.wrapping_add(bits.signed(5)?.cast_unsigned());
        let Witness { started, drive } = *self.witnesses.get(witness)?;
        let id = FusedLaneId { started, drive, lane: LaneId(lane), piece: small(bits)?, stretch: small(bits)? };
        let part = small(bits)?;
        let (category, doubt_percent) = (bits.bits(4)?, bits.unsigned(0)?);
        let drives = u32::try_from(bits.unsigned(1)?).ok()?.checked_add(1)?;
        let started_s = seconds(started.0);
        let last_seen_s = started_s.checked_add(bits.signed(8)?)?;
        let confirmed_s = if bits.flag()? { started_s.checked_add(bits.signed(12)?)? } else { started_s };
        let begins_at = if bits.flag()? { Some(self.read_border(&id, bits)?) } else { None };
        let ends_at = if bits.flag()? { Some(self.read_border(&id, bits)?) } else { None };
        let count = bits.unsigned(3)?.checked_add(2).filter(|count| *count <= MOST_POINTS)?;
        let points = read_points(self, count, before, bits)?;
        (before.witness, before.lane) = (witness, lane);
        Some(CodedLine {
            id,
            part,
            category,
            doubt_percent,
            drives,
            last_seen_s,
            confirmed_s,
            begins_at,
            ends_at,
            points,
        })
    }

    fn read_border(&self, id: &FusedLaneId, bits: &mut BitReader<'_>) -> Option<FittedBorder> {
        let latitude = self.anchor[0].checked_add(bits.signed(23)?)?;
        let longitude = self.anchor[1].checked_add(bits.signed(23)?)?;
        let place = [latitude, longitude, bits.signed(14)?];
        if !bits.flag()? {
            return Some(FittedBorder { place, continues_in: None });
        }
        let cell = self.neighbour(bits.bits(3)?)?;
        let next = if bits.flag()? {
            let Witness { started, drive } = *self.witnesses.get(usize::try_from(bits.unsigned(0)?).ok()?)?;
            let lane = LaneId(bits.unsigned(5)?);
            FusedLaneId { started, drive, lane, piece: small(bits)?, stretch: small(bits)? }
        } else {
            *id
        };
        Some(FittedBorder { place, continues_in: Some((cell, next, small(bits)?)) })
    }

    fn index(&self, id: &FusedLaneId) -> usize {
        self.witnesses.partition_point(|witness| *witness < Witness::of(id))
    }

    /// Which neighbour a cell is.
    fn direction(&self, cell: CellId) -> Option<u64> {
        (0..8).find(|direction| self.neighbour(*direction) == Some(cell))
    }

    fn neighbour(&self, direction: u64) -> Option<CellId> {
        const TILES: i64 = 1 << lanemap_core::fleet::cell::ZOOM;
        let [right, down] = AROUND[usize::try_from(direction).ok()? % 8];
        let x = (i64::from(self.cell.x()) + right).rem_euclid(TILES);
        CellId::new(u32::try_from(x).ok()?, u32::try_from(i64::from(self.cell.y()) + down).ok()?)
    }
}

fn write_points(code: &CellCode, line: &FittedLine, before: &mut Before, bits: &mut BitWriter) {
    let Some(((first, codes), rest)) = line.knots.split_first() else { return };
    for (axis, order) in [15, 15, 9].into_iter().enumerate() {
        bits.signed(first.point[axis] - before.first[axis], order);
    }
    write_codes(codes, &before.codes, 3, 3, bits);
    (before.first, before.codes) = (first.point, *codes);
    for (knot, codes) in rest {
        match knot.step {
            Step::Along { length_mm, left_mm, up_mm } => {
                let listed = LENGTHS_MM.iter().position(|listed| *listed == length_mm);
                bits.bits(listed.map_or(MEASURED, |listed| listed as u64), 4);
                if listed.is_none() {
                    bits.unsigned(length_mm.unsigned_abs().into(), 12);
                }
                bits.signed(left_mm, code.left_order);
                bits.signed(up_mm, code.up_order);
            }
            Step::Free(step) => {
                bits.bits(FREE, 4);
                for (axis, order) in [13, 13, 7].into_iter().enumerate() {
                    bits.signed(step[axis], order);
                }
            }
        }
        bits.flag(*codes != before.codes);
        if *codes != before.codes {
            write_codes(codes, &before.codes, 0, 1, bits);
            before.codes = *codes;
        }
    }
}

fn write_codes(codes: &Codes, before: &Codes, order: u32, existence_order: u32, bits: &mut BitWriter) {
    bits.signed(codes.lateral - before.lateral, order);
    bits.signed((codes.height - codes.lateral) - (before.height - before.lateral), order);
    bits.signed(codes.existence - before.existence, existence_order);
}

fn read_points(
    code: &CellCode,
    count: u64,
    before: &mut Before,
    bits: &mut BitReader<'_>,
) -> Option<Vec<(Millimetres, Codes)>> {
    let first = read_step(&before.first, [15, 15, 9], bits)?;
    before.codes = read_codes(&before.codes, 3, 3, bits)?;
    before.first = first;
    let mut points = vec![(first, before.codes)];
    for _ in 1..count {
        let here = points[points.len() - 1].0;
        let length = bits.bits(4)?;
        let next = if length == FREE {
            read_step(&here, [13, 13, 7], bits)?
        } else {
            let earlier = points.len().checked_sub(2).map(|index| points[index].0)?;
            let length_mm = if length == MEASURED {
                i32::try_from(bits.unsigned(12)?).ok()?
            } else {
                *LENGTHS_MM.get(usize::try_from(length).ok()?)?
            };
            let (left_mm, up_mm) = (bits.signed(code.left_order)?, bits.signed(code.up_order)?);
            Heading::new(earlier, here).step(length_mm, within(left_mm)?, within(up_mm)?)
        };
        if bits.flag()? {
            before.codes = read_codes(&before.codes, 0, 1, bits)?;
        }
        points.push((next.map(within).into_iter().collect::<Option<Vec<_>>>()?.try_into().ok()?, before.codes));
    }
    Some(points)
}

fn read_step(from: &Millimetres, orders: [u32; 3], bits: &mut BitReader<'_>) -> Option<Millimetres> {
    let mut to = *from;
    for (axis, order) in orders.into_iter().enumerate() {
        to[axis] = within(to[axis].checked_add(bits.signed(order)?)?)?;
    }
    Some(to)
}

/// A distance that is no more than the earth's size, so that sums of a few do not overflow.
fn within(distance_mm: i64) -> Option<i64> {
    (distance_mm.abs() < 1 << 34).then_some(distance_mm)
}

fn read_codes(before: &Codes, order: u32, existence_order: u32, bits: &mut BitReader<'_>) -> Option<Codes> {
    let near = |code: i64| (0..=1_000).contains(&code).then_some(code);
    let lateral = near(before.lateral.checked_add(bits.signed(order)?)?)?;
    Some(Codes {
        lateral,
        height: near((lateral + before.height - before.lateral).checked_add(bits.signed(order)?)?)?,
        existence: near(before.existence.checked_add(bits.signed(existence_order)?)?)?,
    })
}

/// A number of which most are 0.
fn small(bits: &mut BitReader<'_>) -> Option<u32> {
    u32::try_from(bits.unsigned(0)?).ok()
}
