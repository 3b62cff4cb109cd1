//! First-order Gauss-Markov noise: errors that are alike for a while and then forgotten.
//!
//! `x(t + dt) = a x(t) + sqrt(1 - a^2) w`, `a = exp(-dt / tau)`, `w ~ N(0, 1)`: unit variance at all times and
//! correlation `exp(-|dt| / tau)`. A bias that never fades is added by [`PartlyConstant`].

use crate::random::{SimRng, normal};

/// A stationary process of unit variance.
#[derive(Clone, Copy, Debug)]
pub struct GaussMarkov {
    value: f64,
}

impl GaussMarkov {
    /// A process that has been running for ever.
    pub fn stationary(rng: &mut SimRng) -> Self {
        Self { value: normal(rng) }
    }

    /// Moves on by `dt_s` seconds, with correlation time `tau_s`, and gives the new value.
    pub fn advance(&mut self, dt_s: f64, tau_s: f64, rng: &mut SimRng) -> f64 {
        let kept = (-dt_s / tau_s).exp();
        self.value = kept * self.value + (1.0 - kept * kept).sqrt() * normal(rng);
        self.value
    }
}

/// Unit-variance error, a share of whose variance is constant and the rest Gauss-Markov.
///
/// `e = sqrt(s) c + sqrt(1 - s) x(t)` with `c ~ N(0, 1)` drawn once.
#[derive(Clone, Copy, Debug)]
pub struct PartlyConstant {
    constant: f64,
    fading: GaussMarkov,
    value: f64,
}

impl PartlyConstant {
    /// A process whose constant part has the share `constant_share` of the variance, in `[0, 1]`.
    pub fn stationary(constant_share: f64, rng: &mut SimRng) -> Self {
        let constant = constant_share.sqrt() * normal(rng);
        let fading = GaussMarkov::stationary(rng);
        Self { constant, value: constant + (1.0 - constant_share).sqrt() * fading.value, fading }
    }

    /// Moves on by `dt_s` seconds.
    pub fn advance(&mut self, dt_s: f64, tau_s: f64, constant_share: f64, rng: &mut SimRng) {
        self.value = self.constant + (1.0 - constant_share).sqrt() * self.fading.advance(dt_s, tau_s, rng);
    }

    /// The error now, in standard deviations.
    #[must_use]
    pub fn value(&self) -> f64 {
        self.value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn variance_is_one_and_correlation_fades_by_its_time_constant() {
        let mut rng = Seed(1).stream(Purpose::Detector, 0);
        let mut process = GaussMarkov::stationary(&mut rng);
        let values: Vec<f64> = (0..200_000).map(|_| process.advance(0.1, 0.5, &mut rng)).collect();
        let n = values.len() as f64;
        let variance = values.iter().map(|x| x * x).sum::<f64>() / n;
        let lagged = values.iter().zip(&values[5..]).map(|(a, b)| a * b).sum::<f64>() / n;
        assert!((variance - 1.0).abs() < 0.03, "variance {variance}");
        assert!((lagged / variance - (-1.0f64).exp()).abs() < 0.03, "correlation after one time constant {lagged}");
    }

    #[test]
    fn the_constant_share_never_fades() {
        let mut rng = Seed(2).stream(Purpose::Detector, 0);
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..20_000 {
            let mut error = PartlyConstant::stationary(0.25, &mut rng);
            let before = error.value();
            error.advance(1e3, 0.5, 0.25, &mut rng);
            sum += before * error.value();
            square += error.value() * error.value();
        }
        assert!((square / 20_000.0 - 1.0).abs() < 0.05);
        assert!((sum / 20_000.0 - 0.25).abs() < 0.03, "covariance far apart is the constant share");
    }
}
