//! Weighted least-squares polynomials up to order 3, by orthogonal polynomials.
//!
//! `f(x) = sum_k c_k q_k(t)`, `t = (x - centre) / scale`, where the `q_k` are orthogonal on the data (Forsythe 1957): the QR
//! decomposition of the Vandermonde matrix without the matrix. No normal equations, so no loss of half the digits.

/// A polynomial of order 3 or less.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cubic {
    centre: f64,
    scale: f64,
    /// Coefficients of `1, t, t^2, t^3`.
    coefficients: [f64; 4],
}

impl Cubic {
    /// Fits `(x, value, weight)`; `None` without data. The order falls further where the abscissae are too few.
    #[must_use]
    #[allow(clippy::needless_pass_by_value)] // a cheap iterator, read several times
    pub fn fit(data: impl Iterator<Item = (f64, f64, f64)> + Clone, order: usize) -> Option<Self> {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (x, _, _) in data.clone() {
            low = low.min(x);
            high = high.max(x);
        }
        if low > high {
            return None;
        }
        let (centre, scale) = (0.5 * (low + high), (0.5 * (high - low)).max(1e-9));
        let inner = |p: &[f64; 4], q: &[f64; 4]| {
            data.clone()
                .map(|(x, _, w)| {
                    let t = (x - centre) / scale;
                    w * evaluate(p, t) * evaluate(q, t)
                })
                .sum::<f64>()
        };
        let mut coefficients = [0.0; 4];
        let mut basis: Vec<([f64; 4], f64)> = Vec::with_capacity(4);
        for k in 0..=order.min(3) {
            let mut next = [0.0; 4];
            next[k] = 1.0;
            // Twice is enough (Kahan): the second pass removes what rounding left of the first.
            for _ in 0..2 {
                for (earlier, norm) in &basis {
                    let share = inner(&next, earlier) / norm;
                    next.iter_mut().zip(earlier).for_each(|(mine, theirs)| *mine -= share * theirs);
                }
            }
            let norm = inner(&next, &next);
            if norm <= 1e-20 {
                break;
            }
            let residual = data.clone().map(|(x, value, w)| {
                let t = (x - centre) / scale;
                w * evaluate(&next, t) * (value - evaluate(&coefficients, t))
            });
            let share = residual.sum::<f64>() / norm;
            coefficients.iter_mut().zip(&next).for_each(|(c, q)| *c += share * q);
            basis.push((next, norm));
        }
        Some(Self { centre, scale, coefficients })
    }

    /// Value at `x`.
    #[must_use]
    pub fn at(&self, x: f64) -> f64 {
        evaluate(&self.coefficients, (x - self.centre) / self.scale)
    }

    /// First derivative at `x`.
    #[must_use]
    pub fn slope_at(&self, x: f64) -> f64 {
        let t = (x - self.centre) / self.scale;
        let [_, c1, c2, c3] = self.coefficients;
        (c1 + t * (2.0 * c2 + t * 3.0 * c3)) / self.scale
    }
}

fn evaluate(coefficients: &[f64; 4], t: f64) -> f64 {
    let [c0, c1, c2, c3] = coefficients;
    c0 + t * (c1 + t * (c2 + t * c3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_cubic_far_from_the_origin_is_recovered(c in prop::array::uniform4(-2.0..2.0f64), offset in -1e4..1e4f64) {
            let f = |x: f64| { let t = (x - offset) / 30.0; c[0] + t * (c[1] + t * (c[2] + t * c[3])) };
            let data: Vec<_> = (0..12).map(|k| { let x = offset + f64::from(k) * 5.0; (x, f(x), 1.0 + f64::from(k)) }).collect();
            let fit = Cubic::fit(data.iter().copied(), 3).unwrap();
            for (x, value, _) in &data {
                prop_assert!((fit.at(*x) - value).abs() < 1e-9);
            }
            let h = 1e-4;
            let slope = (fit.at(offset + 20.0 + h) - fit.at(offset + 20.0 - h)) / (2.0 * h);
            prop_assert!((fit.slope_at(offset + 20.0) - slope).abs() < 1e-6);
        }
    }

    #[test]
    fn residuals_are_orthogonal_to_the_polynomials() {
        let data =
            [(0.0, 1.0, 1.0), (1.0, 3.0, 2.0), (2.0, 2.0, 1.0), (4.0, 5.0, 0.5), (7.0, 1.0, 1.0), (9.0, 4.0, 3.0)];
        let fit = Cubic::fit(data.into_iter(), 2).unwrap();
        for power in 0..3 {
            let product: f64 = data.iter().map(|(x, y, w)| w * (y - fit.at(*x)) * x.powi(power)).sum();
            assert!(product.abs() < 1e-9);
        }
    }

    #[test]
    fn two_abscissae_give_a_line_whatever_order_was_asked() {
        let fit = Cubic::fit([(0.0, 0.0, 1.0), (0.0, 2.0, 1.0), (3.0, 4.0, 1.0)].into_iter(), 3).unwrap();
        assert!((fit.at(0.0) - 1.0).abs() < 1e-9 && (fit.at(3.0) - 4.0).abs() < 1e-9);
    }
}
