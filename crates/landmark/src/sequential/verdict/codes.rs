//! All on/off codes of a clock at once.
//!
//! A clock cuts time into chips, and an exposure shows one chip, or the end of one and the start of the
//! next. Given the amplitude of the light, the likelihood of a code is then a product over pairs of
//! neighbouring chips, and its mean over all codes a product of matrices of 2x2: exact, for 2^18 codes
//! as for four, with half-lit frames where they belong. A code that repeats closes the product to a
//! ring; one that does not is a ring of more chips than are seen.
//!
//! The clock is fitted: a light that is no request lies between those of any grid, and a strong one is
//! told from its neighbours by a fraction of an exposure.

use super::super::evidence::Series;
use super::super::nuisance::{Nuisance, dot};

/// Places of a chip at which the edges are tried, before the best are refined.
const OFFSETS: usize = 8;

/// So many of the best clocks are refined.
const FINALISTS: usize = 8;

/// Passes in which the light of the code and the nuisances that hide part of it are told apart.
const PASSES: usize = 3;

/// Halvings of the step by which a clock is refined, in each pass.
const HALVINGS: usize = 5;

/// A series that shows a light of known amplitude.
pub struct Lit<'a> {
    pub series: &'a Series,
    pub nuisance: &'a Nuisance,
    /// Times since the first frame and exposures (s).
    pub times: &'a [(f64, f64)],
    /// Brightness when on (grey levels).
    pub amplitude: f64,
    /// Variance of the noise (grey levels squared).
    pub noise: f64,
    /// Share of light in every frame, to start with.
    pub light: Vec<f32>,
}

/// A clock that cuts time into chips.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    /// Length of a chip (s).
    pub chip: f64,
    /// Chips that have passed at the middle of the window.
    pub offset: f64,
}

/// Log likelihood ratios, against no light, of two neighbouring chips of which only the second, only
/// the first or both are on.
type Pair = [f64; 3];

/// The pairs of all chips of a code, each with its successor; that of the last is the first.
#[derive(Debug, Clone, Default)]
pub struct Ring(Vec<Pair>);

/// A series with the nuisances put back that were taken from the light.
struct Whole {
    values: Vec<f32>,
    /// What that adds to its likelihood without need (nats).
    excess: f64,
}

impl Lit<'_> {
    /// Middle of the window (s).
    pub fn middle(&self) -> f64 {
        let (first, last) = (self.times.first(), self.times.last());
        0.5 * (first.map_or(0.0, |f| f.0) + last.map_or(0.0, |l| l.0 + l.1))
    }

    /// Log likelihood ratio, against no light, of the codes of `length` chips that `weigh` sums up: the
    /// mean over the chips (length in s, and by how much relative they may be refined) at the best
    /// offset of their edges.
    pub fn over_clocks(
        &self,
        chips: &[(f64, f64)],
        length: usize,
        weigh: impl Fn(&Ring, Clock) -> f64,
    ) -> f64 {
        let start = self.whole(&self.light);
        let mut ring = Ring::default();
        let mut found = Vec::with_capacity(chips.len() * OFFSETS);
        for &(chip, reach) in chips {
            found.extend((0..OFFSETS).map(|k| {
                let clock = Clock { chip, offset: k as f64 / OFFSETS as f64 };
                self.cut(&start, clock, length, &mut ring);
                (weigh(&ring, clock) - start.excess, clock, reach)
            }));
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let finalists = found.into_iter().take(FINALISTS);
        let refined = finalists.map(|(level, clock, reach)| {
            self.refined(&start, (level, clock), reach, length, &weigh)
        });
        refined.fold(f64::NEG_INFINITY, f64::max) - (chips.len().max(1) as f64).ln()
    }

    /// The level of a clock once it is fitted, and the nuisances with it.
    fn refined(
        &self,
        start: &Whole,
        (mut level, mut clock): (f64, Clock),
        reach: f64,
        length: usize,
        weigh: &impl Fn(&Ring, Clock) -> f64,
    ) -> f64 {
        let mut ring = Ring::default();
        let mut own: Option<Whole> = None;
        for pass in 0..PASSES {
            if pass > 0 {
                self.cut(own.as_ref().unwrap_or(start), clock, length, &mut ring);
                let whole = own.insert(self.whole(&self.expected(clock, &ring)));
                self.cut(whole, clock, length, &mut ring);
                level = weigh(&ring, clock) - whole.excess;
            }
            let whole = own.as_ref().unwrap_or(start);
            let mut size = if pass == 0 { 0.5 } else { 0.125 };
            for _ in 0..HALVINGS {
                for (longer, later) in [(size, 0.0), (-size, 0.0), (0.0, size), (0.0, -size)] {
                    let next = Clock {
                        chip: clock.chip * (1.0 + longer * reach),
                        offset: clock.offset + later / OFFSETS as f64,
                    };
                    self.cut(whole, next, length, &mut ring);
                    let other = weigh(&ring, next) - whole.excess;
                    if other > level {
                        (level, clock) = (other, next);
                    }
                }
                size *= 0.5;
            }
        }
        level
    }

    /// Puts back what the nuisances took from a light.
    fn whole(&self, light: &[f32]) -> Whole {
        let amplitude = self.amplitude as f32;
        let mut taken = light.to_vec();
        self.series.clear(self.nuisance, &mut taken);
        taken.iter_mut().zip(light).for_each(|(t, l)| *t = amplitude * (l - *t));
        let excess = 0.5 * f64::from(dot(&taken, &taken)) / self.noise;
        Whole {
            values: self.series.values.iter().zip(&taken).map(|(v, t)| v + t).collect(),
            excess,
        }
    }

    /// Every frame's first chip in a code of so many, and the share of its exposure there.
    fn chips(&self, clock: Clock, length: usize) -> impl Iterator<Item = (usize, f64)> {
        let (middle, per_second, last) = (self.middle(), 1.0 / clock.chip, length - 1);
        let length = length as f64;
        self.times.iter().map(move |&(t, e)| {
            let from = (t - middle) * per_second + clock.offset;
            let (first, exposure) = (from.floor(), e * per_second);
            let rest = first + 1.0 - from;
            let share = if exposure <= rest { 1.0 } else { rest / exposure };
            // Time stamps may be anything: beyond what a float tells apart, the chip is arbitrary.
            (last.min((first - (first / length).floor() * length) as usize), share)
        })
    }

    /// Cuts the frames into the chips of a code that repeats after `length`.
    fn cut(&self, whole: &Whole, clock: Clock, length: usize, ring: &mut Ring) {
        ring.0.clear();
        ring.0.resize(length, [0.0; 3]);
        let (gain, half) = (self.amplitude / self.noise, 0.5 * self.amplitude);
        for ((first, share), v) in self.chips(clock, length).zip(&whole.values) {
            let fit = |light: f64| gain * light * (f64::from(*v) - half * light);
            let pair = &mut ring.0[first];
            pair[0] += fit(1.0 - share);
            pair[1] += fit(share);
            pair[2] += fit(1.0);
        }
    }

    /// Share of light in every frame, the mean over all codes by their likelihood.
    fn expected(&self, clock: Clock, ring: &Ring) -> Vec<f32> {
        let chances = ring.chances();
        let light = |(first, share): (usize, f64)| {
            let [second, only, both] = chances[first];
            (both + share * only + (1.0 - share) * second) as f32
        };
        self.chips(clock, chances.len()).map(light).collect()
    }
}

/// Rows: the first chip off, on; columns: the second.
type Matrix = [f64; 4];

const UNIT: Matrix = [1.0, 0.0, 0.0, 1.0];

fn product([a, b, c, d]: &Matrix, [e, f, g, h]: &Matrix) -> Matrix {
    [a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h]
}

/// A matrix that is about to vanish scaled to a largest element of one; the logarithm of the scale is
/// added to `log`.
fn scaled(matrix: Matrix, log: &mut f64) -> Matrix {
    let top = matrix.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    if top > 1e-100 {
        return matrix;
    }
    *log += top.ln();
    matrix.map(|v| v / top)
}

/// The likelihoods of a pair when every chip is on or off by chance, scaled.
fn likelihoods(&[second, only, both]: &Pair, log: &mut f64) -> Matrix {
    let top = second.max(only).max(both).max(0.0);
    *log += top;
    [0.0, second, only, both].map(|v| 0.5 * (v - top).exp())
}

impl Ring {
    /// Logarithm of the mean likelihood ratio of all codes.
    pub fn log_mean(&self) -> f64 {
        let mut log = 0.0;
        let all = self.0.iter().fold(UNIT, |all, pair| {
            let next = likelihoods(pair, &mut log);
            scaled(product(&all, &next), &mut log)
        });
        log + (all[0] + all[3]).max(f64::MIN_POSITIVE).ln()
    }

    /// Log likelihood ratio of one code.
    fn log_of(&self, code: impl Fn(usize) -> bool) -> f64 {
        let pair = |(k, pair): (usize, &Pair)| match (code(k), code((k + 1) % self.0.len())) {
            (false, false) => 0.0,
            (false, true) => pair[0],
            (true, false) => pair[1],
            (true, true) => pair[2],
        };
        self.0.iter().enumerate().map(pair).sum()
    }

    /// The same as the mean of all, without `codes` and those that differ from them in one chip.
    pub fn log_mean_without(&self, codes: &[&dyn Fn(usize) -> bool]) -> f64 {
        let mean = self.log_mean();
        let all = mean + self.0.len() as f64 * std::f64::consts::LN_2;
        let share = |code: &&dyn Fn(usize) -> bool| {
            let flipped = (0..self.0.len()).map(|f| self.log_of(|k| code(k) != (k == f)));
            flipped.chain([self.log_of(code)]).map(|l| (l - all).exp()).sum::<f64>()
        };
        // What is left when nearly nothing is left drowns in rounding.
        mean + (1.0 - codes.iter().map(share).sum::<f64>()).max(1e-12).ln()
    }

    /// Chance of each state of every pair.
    fn chances(&self) -> Vec<Pair> {
        let mut scale = 0.0;
        let matrices: Vec<Matrix> = self.0.iter().map(|p| likelihoods(p, &mut scale)).collect();
        let mut after = vec![UNIT; matrices.len() + 1];
        for (k, matrix) in matrices.iter().enumerate().rev() {
            after[k] = scaled(product(matrix, &after[k + 1]), &mut scale);
        }
        let mut before = UNIT;
        let pair = |(matrix, after): (&Matrix, &Matrix)| {
            // From the second chip of the pair round to its first.
            let [a, b, c, d] = product(after, &before);
            let weights = [matrix[0] * a, matrix[1] * c, matrix[2] * b, matrix[3] * d];
            before = scaled(product(&before, matrix), &mut scale);
            let sum = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
            [weights[1] / sum, weights[2] / sum, weights[3] / sum]
        };
        matrices.iter().zip(&after[1..]).map(pair).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAIRS: [Pair; 5] =
        [[0.3, -2.0, 1.5], [-4.0, 2.5, 0.1], [1.0, 1.1, -3.0], [0.0; 3], [-0.5, 0.7, 2.0]];

    fn bit(code: u32) -> impl Fn(usize) -> bool {
        move |k| code >> k & 1 == 1
    }

    /// All codes one by one.
    fn likelihoods_of_all() -> Vec<f64> {
        let ring = Ring(PAIRS.to_vec());
        (0..32).map(|code| ring.log_of(bit(code)).exp()).collect()
    }

    #[test]
    fn all_codes_at_once_are_all_codes_one_by_one() {
        let ring = Ring(PAIRS.to_vec());
        let mean = likelihoods_of_all().iter().sum::<f64>() / 32.0;
        assert!((ring.log_mean() - mean.ln()).abs() < 1e-12, "{}", ring.log_mean());
    }

    #[test]
    fn codes_that_differ_in_one_chip_are_left_out() {
        let all = likelihoods_of_all();
        let code = 0b01101u32;
        let others = all.iter().enumerate();
        let others = others.filter(|(k, _)| (*k as u32 ^ code).count_ones() >= 2).map(|(_, l)| l);
        let mean = others.sum::<f64>() / 32.0;
        let found = Ring(PAIRS.to_vec()).log_mean_without(&[&bit(code)]);
        assert!((found - mean.ln()).abs() < 1e-12, "{found} is not {}", mean.ln());
    }

    #[test]
    fn chances_are_shares_of_the_codes() {
        let all = likelihoods_of_all();
        let chances = Ring(PAIRS.to_vec()).chances();
        for (k, chances) in chances.into_iter().enumerate() {
            for (state, found) in
                [(false, true), (true, false), (true, true)].into_iter().zip(chances)
            {
                let shown = |code: &u32| (bit(*code)(k), bit(*code)((k + 1) % 5)) == state;
                let share = (0..32).filter(shown).map(|c| all[c as usize]).sum::<f64>();
                let expected = share / all.iter().sum::<f64>();
                assert!((found - expected).abs() < 1e-12, "{k} {state:?}: {found}, {expected}");
            }
        }
    }
}
