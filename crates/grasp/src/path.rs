//! A way through joint space that touches nothing.
//!
//! In: start and goal postures and a test for straight lines. Out: postures to pass, or the hit that
//! blocked the straight line when no way was found.
//!
//! Method: the straight line; else RRT-Connect (Kuffner and LaValle, 2000): two trees grow from both
//! ends towards random postures and towards each other until they meet; then the way is shortened by
//! random cuts, each tested. Seeded, so that a plan repeats.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use vergence_geometry::JointAngles;

use crate::collision::{Hit, blend};
use crate::kinematics::distance;

/// How hard to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchEffort {
    /// Largest number of random postures tried.
    pub samples: usize,
    /// Largest joint motion of one branch (rad).
    pub branch: f64,
    /// Number of short cuts tried.
    pub cuts: usize,
}

impl Default for SearchEffort {
    fn default() -> Self {
        // 400 samples end a hopeless search within about a second.
        Self { samples: 400, branch: 0.5, cuts: 40 }
    }
}

/// Finds postures from `start` to `goal`, both included, such that `free` holds on every line between
/// two of them. `range` holds the postures that may be tried.
pub fn find(
    start: &JointAngles,
    goal: &JointAngles,
    range: &[(f64, f64); 6],
    effort: &SearchEffort,
    seed: u64,
    free: &mut dyn FnMut(&JointAngles, &JointAngles) -> Result<(), Hit>,
) -> Result<Vec<JointAngles>, Hit> {
    let Err(blocked) = free(start, goal) else { return Ok(vec![*start, *goal]) };
    // Ends that collide cannot be mended by a detour.
    free(start, start)?;
    free(goal, goal)?;
    let mut random = Pcg32::seed_from_u64(seed);
    let mut trees = [vec![(*start, 0)], vec![(*goal, 0)]];
    for n in 0..effort.samples {
        let sample: JointAngles =
            std::array::from_fn(|k| random.random_range(range[k].0..range[k].1));
        let (grown, other) = (n % 2, 1 - n % 2);
        let Some(tip) = grow(&mut trees[grown], &sample, effort.branch, free) else { continue };
        // The other tree comes to meet the new branch as far as it can.
        while let Some(reached) = grow(&mut trees[other], &tip, effort.branch, free) {
            if distance(&reached, &tip) < 1e-9 {
                let mut way = branch_of(&trees[0]);
                way.reverse();
                way.extend(branch_of(&trees[1]).into_iter().skip(1));
                return Ok(shorten(way, effort.cuts, &mut random, free));
            }
        }
    }
    Err(blocked)
}

type Tree = Vec<(JointAngles, usize)>;

/// One branch from the nearest node towards a posture; the new node, when the way to it is free.
fn grow(
    tree: &mut Tree,
    towards: &JointAngles,
    longest: f64,
    free: &mut dyn FnMut(&JointAngles, &JointAngles) -> Result<(), Hit>,
) -> Option<JointAngles> {
    let nearest = (0..tree.len())
        .min_by(|&a, &b| distance(&tree[a].0, towards).total_cmp(&distance(&tree[b].0, towards)))?;
    let from = tree[nearest].0;
    let far = distance(&from, towards);
    if far < 1e-12 {
        return None;
    }
    let to = if far <= longest { *towards } else { blend(&from, towards, longest / far) };
    free(&from, &to).ok()?;
    tree.push((to, nearest));
    Some(to)
}

/// From the newest node back to the root.
fn branch_of(tree: &Tree) -> Vec<JointAngles> {
    let mut way = Vec::new();
    let mut node = tree.len() - 1;
    loop {
        way.push(tree[node].0);
        if node == 0 {
            return way;
        }
        node = tree[node].1;
    }
}

fn shorten(
    mut way: Vec<JointAngles>,
    cuts: usize,
    random: &mut Pcg32,
    free: &mut dyn FnMut(&JointAngles, &JointAngles) -> Result<(), Hit>,
) -> Vec<JointAngles> {
    for _ in 0..cuts {
        if way.len() < 3 {
            break;
        }
        let a = random.random_range(0..way.len() - 2);
        let b = random.random_range(a + 2..way.len());
        if free(&way[a], &way[b]).is_ok() {
            way.drain(a + 1..b);
        }
    }
    way
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall across the first joint at zero with a gap where the second is above one.
    fn wall(a: &JointAngles, b: &JointAngles) -> Result<(), Hit> {
        let blocked = (0..=100)
            .map(|n| blend(a, b, n as f64 / 100.0))
            .any(|q| q[0].abs() < 0.1 && q[1] < 1.0);
        match blocked {
            true => Err(Hit { link: "arm".into(), other: "wall".into(), distance: 0.0 }),
            false => Ok(()),
        }
    }

    #[test]
    fn a_way_round_a_wall_is_found_and_repeats() {
        let (start, goal) = ([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let range = [(-2.0, 2.0); 6];
        let search = |seed| find(&start, &goal, &range, &SearchEffort::default(), seed, &mut wall);
        let way = search(1).unwrap();
        assert_eq!((way[0], way[way.len() - 1]), (start, goal));
        assert!(way.windows(2).all(|w| wall(&w[0], &w[1]).is_ok()), "{way:?}");
        assert!(way.len() > 2);
        assert_eq!(search(1).unwrap(), way);
    }

    #[test]
    fn no_way_is_an_error_that_names_the_wall() {
        let range = [(-2.0, 2.0), (-0.5, 0.5), (-2.0, 2.0), (-2.0, 2.0), (-2.0, 2.0), (-2.0, 2.0)];
        let goal = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let hit = find(&[-1.0; 6], &goal, &range, &SearchEffort::default(), 3, &mut wall);
        assert_eq!(hit.unwrap_err().other, "wall");
    }
}
