//! Seeded random numbers: one stream a purpose, so that one consumer never shifts another.

use std::sync::OnceLock;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The generator of a purpose: equal seed, name and index give equal numbers.
pub fn stream(seed: u64, purpose: &str, index: u64) -> Pcg64Mcg {
    // FNV-1a over all three, so that neighbouring seeds start far apart.
    let bytes = purpose.bytes().chain(seed.to_le_bytes()).chain(index.to_le_bytes());
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325u64, |h, b| {
        (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    Pcg64Mcg::seed_from_u64(hash)
}

/// A standard normal number (Box and Muller).
pub fn normal(rng: &mut Pcg64Mcg) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// Standard normal numbers from 16 random bits: the quantiles of 65536 equal shares (to 4.3 sigma).
pub fn normal_table() -> &'static [f32] {
    static TABLE: OnceLock<Vec<f32>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let mut table = vec![0.0; 1 << 16];
        // Midpoint quantiles by integrating the density outwards from the median.
        let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
        let half = 1usize << 15;
        let mut x = 0.0;
        for k in 0..half {
            let target = (k as f64 + 0.5) / 65536.0;
            // Newton on the distribution function; the start is the neighbour.
            for _ in 0..8 {
                let error = distribution_above_median(x) - target;
                x -= error / density(x).max(1e-9);
            }
            table[half + k] = x as f32;
            table[half - 1 - k] = -x as f32;
        }
        table
    })
}

/// Probability that a standard normal number lies between 0 and x >= 0 (series of the error
/// function, exact to rounding for x below 5).
fn distribution_above_median(x: f64) -> f64 {
    let (mut term, mut sum, mut k) = (x, x, 1.0);
    while term > 1e-17 {
        term *= x * x / (2.0 * k + 1.0);
        sum += term;
        k += 1.0;
    }
    sum * (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_standard_normal() {
        let table = normal_table();
        let mean = table.iter().sum::<f32>() / 65536.0;
        let variance = table.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / 65536.0;
        assert!(mean.abs() < 1e-4 && (variance - 1.0).abs() < 1e-3, "{mean} {variance}");
        let above = |limit: f32| table.iter().filter(|&&x| x > limit).count() as f64 / 65536.0;
        assert!((above(1.0) - 0.158_655).abs() < 2e-5 && (above(3.0) - 0.001_350).abs() < 2e-5);
    }

    #[test]
    fn streams_differ_and_repeat() {
        let draw = |seed, name, index| stream(seed, name, index).random::<u64>();
        assert_eq!(draw(1, "a", 2), draw(1, "a", 2));
        assert!(draw(1, "a", 2) != draw(2, "a", 2) && draw(1, "a", 2) != draw(1, "b", 2));
    }
}
