//! Random processes in time and range, of which the models of the detector and of the vehicle are made.

pub mod bursts;
pub mod gauss_markov;
pub mod range_polynomial;
pub mod smooth;

pub use bursts::Bursts;
pub use gauss_markov::{GaussMarkov, PartlyConstant};
pub use range_polynomial::{RangePolynomial, RangeSigmas};
pub use smooth::SmoothNoise;
