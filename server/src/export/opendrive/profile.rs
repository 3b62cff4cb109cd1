//! Cubics over the way of a road that follow a function: the widths and offsets of lanes.

/// A cubic `a + b ds + c ds^2 + d ds^3` from a way on, `ds` metres after it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Piece {
    pub(super) s_m: f64,
    pub(super) coefficients: [f64; 4],
}

/// Longest piece, metres.
const LONGEST_M: f64 = 40.0;
/// Shortest piece that is cut further, metres.
const SHORTEST_M: f64 = 0.5;
/// Places at which a piece is held to the function, beside those that it goes through.
const CHECKS: u32 = 24;

/// Follows a function between two ways: no piece leaves it by more than `error_m` where it is checked, every few decimetres,
/// unless it is shorter than half a metre. Pieces meet, since each goes through the function at its ends.
pub(super) fn fitted(from_m: f64, to_m: f64, error_m: f64, function: &dyn Fn(f64) -> f64) -> Vec<Piece> {
    let mut pieces = Vec::new();
    let mut waiting = vec![(from_m, to_m)];
    while let Some((from_m, to_m)) = waiting.pop() {
        let length_m = to_m - from_m;
        let piece = through(from_m, length_m, function);
        let good = length_m <= LONGEST_M
            && (0..=CHECKS).all(|check| {
                let s_m = from_m + length_m * f64::from(check) / f64::from(CHECKS);
                (at(&piece, s_m) - function(s_m)).abs() <= error_m
            });
        if good || length_m < SHORTEST_M {
            pieces.push(piece);
        } else {
            let middle_m = 0.5 * (from_m + to_m);
            waiting.push((middle_m, to_m));
            waiting.push((from_m, middle_m));
        }
    }
    pieces
}

/// The cubic through four places of a function, evenly from one end of a piece to the other.
fn through(s_m: f64, length_m: f64, function: &dyn Fn(f64) -> f64) -> Piece {
    let [y0, y1, y2, y3] = [0.0, 1.0, 2.0, 3.0].map(|third: f64| function(s_m + length_m * third / 3.0));
    let (x, x2) = (length_m.max(1e-9), length_m.max(1e-9).powi(2));
    Piece {
        s_m,
        coefficients: [
            y0,
            (-5.5 * y0 + 9.0 * y1 - 4.5 * y2 + y3) / x,
            (9.0 * y0 - 22.5 * y1 + 18.0 * y2 - 4.5 * y3) / x2,
            (-4.5 * y0 + 13.5 * y1 - 13.5 * y2 + 4.5 * y3) / (x2 * x),
        ],
    }
}

/// The value of a piece at a way.
pub(super) fn at(piece: &Piece, s_m: f64) -> f64 {
    let ds = s_m - piece.s_m;
    let [a, b, c, d] = piece.coefficients;
    a + (b + (c + d * ds) * ds) * ds
}

/// A piece as a cubic from a later way on.
fn moved(piece: &Piece, s_m: f64) -> [f64; 4] {
    let ds = s_m - piece.s_m;
    let [_, b, c, d] = piece.coefficients;
    [at(piece, s_m), b + (2.0 * c + 3.0 * d * ds) * ds, c + 3.0 * d * ds, d]
}

/// Whether a piece is no other than the one before it.
pub(super) fn goes_on(before: &Piece, piece: &Piece) -> bool {
    moved(before, piece.s_m).iter().zip(piece.coefficients).all(|(before, own)| (before - own).abs() < 1e-14)
}

/// One function less another, exactly: cut wherever either of them is.
pub(super) fn difference(one: &[Piece], other: &[Piece]) -> Vec<Piece> {
    let mut ways_m: Vec<f64> = one.iter().chain(other).map(|piece| piece.s_m).collect();
    ways_m.sort_by(f64::total_cmp);
    ways_m.dedup();
    let piece_at = |pieces: &[Piece], s_m: f64| {
        let next = pieces.partition_point(|piece| piece.s_m <= s_m);
        pieces.get(next.saturating_sub(1)).map_or([0.0; 4], |piece| moved(piece, s_m))
    };
    let pieces = ways_m.into_iter().map(|s_m| {
        let (minuend, subtrahend) = (piece_at(one, s_m), piece_at(other, s_m));
        Piece { s_m, coefficients: std::array::from_fn(|index| minuend[index] - subtrahend[index]) }
    });
    pieces.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(pieces: &[Piece], s_m: f64) -> f64 {
        let next = pieces.partition_point(|piece| piece.s_m <= s_m);
        at(&pieces[next - 1], s_m)
    }

    #[test]
    fn a_function_is_followed_and_so_is_the_difference_of_two() {
        let one = |s: f64| 3.5 + (s / 20.0).sin();
        let other = |s: f64| -0.2 * (s / 7.0).cos();
        let (pieces, others) = (fitted(5.0, 90.0, 0.001, &one), fitted(5.0, 90.0, 0.001, &other));
        assert!(pieces.len() < 12 && others.len() < 30, "{} {}", pieces.len(), others.len());
        let apart = difference(&pieces, &others);
        for step in 0..=850 {
            let s_m = 5.0 + f64::from(step) / 10.0;
            assert!((value(&pieces, s_m) - one(s_m)).abs() < 0.0015);
            assert!((value(&apart, s_m) - (one(s_m) - other(s_m))).abs() < 0.003);
        }
    }
}
