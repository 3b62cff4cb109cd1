//! Errors that grow along a line with its range: second-order polynomials with random coefficients.
//!
//! `e(r) = s0 a0 + s1 a1 (r / 50 m) + s2 a2 (r / 50 m)^2`, the `a` independent and of unit variance, each partly
//! constant over the drive and partly Gauss-Markov. At 50 m the variance is `s0^2 + s1^2 + s2^2`.

use crate::{noise::gauss_markov::PartlyConstant, random::SimRng};

/// Range at which the three coefficients weigh the same, metres.
const REFERENCE_RANGE_M: f64 = 50.0;

/// Standard deviations of the three terms of a range polynomial, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeSigmas {
    /// Offset: the same at every range.
    pub offset_m: f64,
    /// Slope: at 50 m.
    pub slope_m: f64,
    /// Bend: at 50 m.
    pub bend_m: f64,
}

impl RangeSigmas {
    /// Standard deviation of the whole at a range, metres.
    #[must_use]
    pub fn sigma_at_m(&self, range_m: f64) -> f64 {
        let r = range_m / REFERENCE_RANGE_M;
        (self.offset_m.powi(2) + (self.slope_m * r).powi(2) + (self.bend_m * r * r).powi(2)).sqrt()
    }
}

/// A random polynomial in range that changes in time.
#[derive(Clone, Copy, Debug)]
pub struct RangePolynomial {
    coefficients: [PartlyConstant; 3],
}

impl RangePolynomial {
    /// A polynomial that has been running for ever.
    pub fn stationary(constant_share: f64, rng: &mut SimRng) -> Self {
        Self { coefficients: std::array::from_fn(|_| PartlyConstant::stationary(constant_share, rng)) }
    }

    /// Moves on by `dt_s` seconds with correlation time `tau_s`.
    pub fn advance(&mut self, dt_s: f64, tau_s: f64, constant_share: f64, rng: &mut SimRng) {
        for coefficient in &mut self.coefficients {
            coefficient.advance(dt_s, tau_s, constant_share, rng);
        }
    }

    /// The error at a range, metres.
    #[must_use]
    pub fn at_m(&self, range_m: f64, sigmas: &RangeSigmas) -> f64 {
        let r = range_m / REFERENCE_RANGE_M;
        let [offset, slope, bend] = self.coefficients.map(|coefficient| coefficient.value());
        sigmas.offset_m * offset + sigmas.slope_m * slope * r + sigmas.bend_m * bend * r * r
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn the_spread_over_many_lines_is_the_stated_one_at_every_range() {
        let sigmas = RangeSigmas { offset_m: 0.1, slope_m: 0.3, bend_m: 0.38 };
        let mut rng = Seed(4).stream(Purpose::Detector, 0);
        let lines: Vec<RangePolynomial> = (0..20_000).map(|_| RangePolynomial::stationary(0.15, &mut rng)).collect();
        for range_m in [5.0, 20.0, 50.0] {
            let mean_square =
                lines.iter().map(|line| line.at_m(range_m, &sigmas).powi(2)).sum::<f64>() / lines.len() as f64;
            let expected = sigmas.sigma_at_m(range_m);
            assert!((mean_square.sqrt() / expected - 1.0).abs() < 0.03, "at {range_m} m");
        }
        assert!((sigmas.sigma_at_m(50.0) - 0.494).abs() < 0.001);
    }
}
