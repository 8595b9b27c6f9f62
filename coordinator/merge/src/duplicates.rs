//! Decides which Gaussians near borders are removed because another partition has the same one.
//!
//! The rule, as if everything were in memory: candidates are visited in order of rank. A candidate is removed
//! if it agrees with an earlier one of another partition that stays. So of a chain A~B~C by rank, where A and
//! C do not agree, B goes and C stays. The rule depends on neither files nor rows nor times of arrival. No
//! two remaining Gaussians agree across a border: merging the result again removes nothing.
//!
//! Where the candidates exceed their memory limit, the scene is cut into regions. A region holds the
//! candidates inside and those outside that reach into it, so for each candidate inside it knows all that it
//! can agree with. It decides what follows from these alone, and leaves open what depends on a candidate
//! outside. The open ones are decided at the end, in order of rank. By induction over ranks the result is
//! that of the rule, for any cut into regions.

use std::collections::{BTreeMap, HashMap};

use crate::MergeError;
use crate::candidate::{Bounds, Candidate, Rank, RowId};
use crate::thinning::Standing;

/// Bytes of a candidate while a region is decided: itself, its rank, its state and its entry in the spatial
/// hash.
pub const CANDIDATE_BYTES: usize = size_of::<Candidate>() + size_of::<(Rank, u32)>() + 3 * size_of::<u32>();

/// A half-open box, scene axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Smallest coordinates, inclusive.
    pub low: [f32; 3],
    /// Largest coordinates, exclusive.
    pub high: [f32; 3],
}

impl Region {
    /// All of space.
    pub const ALL: Self = Self { low: [f32::NEG_INFINITY; 3], high: [f32::INFINITY; 3] };

    /// Whether a centre lies in it.
    pub fn contains(&self, mean: [f32; 3]) -> bool {
        (0..3).all(|axis| mean[axis] >= self.low[axis] && mean[axis] < self.high[axis])
    }

    /// Whether a box, grown by `reach`, touches it.
    pub fn meets(&self, low: [f32; 3], high: [f32; 3], reach: f32) -> bool {
        (0..3).all(|axis| {
            f64::from(high[axis]) + f64::from(reach) >= f64::from(self.low[axis])
                && f64::from(low[axis]) - f64::from(reach) <= f64::from(self.high[axis])
        })
    }

    /// Its halves across its longest side; `None` where that is not longer than `reach`: each half would hold
    /// as many candidates.
    fn halves(&self, reach: f32) -> Option<[Self; 2]> {
        let side = |axis: usize| self.high[axis] - self.low[axis];
        let axis = (0..3).max_by(|&a, &b| side(a).total_cmp(&side(b))).unwrap_or(0);
        let middle = self.low[axis] + 0.5 * side(axis);
        if !(side(axis) > reach && middle > self.low[axis] && middle < self.high[axis]) {
            return None;
        }
        let (mut lower, mut upper) = (*self, *self);
        (lower.high[axis], upper.low[axis]) = (middle, middle);
        Some([lower, upper])
    }
}

/// Removed rows, and rows that depend on other regions.
#[derive(Default)]
pub struct Decisions {
    /// Removed rows.
    removed: HashMap<RowId, Standing>,
    open: Vec<Open>,
}

/// A removed row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Duplicate {
    /// Row of its partition's file.
    pub row: u32,
    /// Its set and opacity.
    pub standing: Standing,
}

/// A candidate that is removed unless all of `above` are: earlier candidates that agree with it.
struct Open {
    rank: Rank,
    id: RowId,
    standing: Standing,
    above: Vec<RowId>,
}

impl Decisions {
    /// Decides `region`, halved until `load` can hold each part. `load` returns the candidates that lie in a
    /// region or reach into it. With `true` it returns `None` where they are too many; with `false` it always
    /// returns them. No candidate reaches further than `reach`.
    ///
    /// # Errors
    /// Errors of `load`.
    pub fn decide_in_parts(
        &mut self,
        region: Region,
        reach: f32,
        bounds: &Bounds,
        load: &mut impl FnMut(&Region, bool) -> Result<Option<Vec<Candidate>>, MergeError>,
    ) -> Result<(), MergeError> {
        let halves = region.halves(reach);
        match (load(&region, halves.is_some())?, halves) {
            (Some(candidates), _) => self.decide(&candidates, &region, bounds),
            (None, Some(halves)) => {
                for half in halves {
                    self.decide_in_parts(half, reach, bounds, load)?;
                }
            }
            (None, None) => {}
        }
        Ok(())
    }

    /// Decides the candidates inside `region`; `candidates` must include all from outside that reach into it.
    pub fn decide(&mut self, candidates: &[Candidate], region: &Region, bounds: &Bounds) {
        let mut order: Vec<(Rank, u32)> = candidates
            .iter()
            .enumerate()
            .map(|(index, candidate)| (candidate.rank(), index as u32))
            .collect();
        order.sort_unstable();
        let mut earlier = SpatialHash::new(candidates);
        let mut is_open = vec![false; candidates.len()];
        for (rank, index) in order {
            let candidate = &candidates[index as usize];
            let inside = region.contains(candidate.mean);
            let mut above = Vec::new();
            let mut goes = false;
            earlier.near(candidate, bounds.levels_apart, |other| {
                let known = &candidates[other as usize];
                if known.id.partition != candidate.id.partition && bounds.agree(known, candidate) {
                    goes |= !is_open[other as usize];
                    above.push(known.id);
                }
                goes
            });
            if goes {
                if inside {
                    self.removed.insert(candidate.id, candidate.standing());
                }
                continue;
            }
            // A candidate outside may depend on others outside.
            is_open[index as usize] = !inside || !above.is_empty();
            if inside && !above.is_empty() {
                self.open.push(Open { rank, id: candidate.id, standing: candidate.standing(), above });
            }
            earlier.insert(index, candidate);
        }
    }

    /// The removed rows by partition, ascending.
    pub fn finish(mut self) -> BTreeMap<u32, Vec<Duplicate>> {
        self.open.sort_unstable_by_key(|open| open.rank);
        for open in &self.open {
            if open.above.iter().any(|id| !self.removed.contains_key(id)) {
                self.removed.insert(open.id, open.standing);
            }
        }
        let mut by_partition: BTreeMap<u32, Vec<Duplicate>> = BTreeMap::new();
        for (RowId { partition, row }, standing) in self.removed {
            by_partition.entry(partition).or_default().push(Duplicate { row, standing });
        }
        by_partition.values_mut().for_each(|rows| rows.sort_unstable_by_key(|duplicate| duplicate.row));
        by_partition
    }
}

/// Candidates by position. The reach of each selects its level: a grid whose cells are at least as wide as
/// any reach of that level. Candidates that agree with it lie in one of the 27 cells around it, on its level
/// or an adjacent one.
struct SpatialHash<'a> {
    candidates: &'a [Candidate],
    /// First candidate of each bucket.
    heads: Vec<u32>,
    /// The next one of the same bucket, by candidate.
    next: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl<'a> SpatialHash<'a> {
    fn new(candidates: &'a [Candidate]) -> Self {
        let buckets = candidates.len().next_power_of_two();
        Self { candidates, heads: vec![NONE; buckets], next: vec![NONE; candidates.len()] }
    }

    fn insert(&mut self, index: u32, candidate: &Candidate) {
        let level = level(candidate.reach);
        let bucket = self.bucket(level, cell(candidate.mean, level));
        self.next[index as usize] = std::mem::replace(&mut self.heads[bucket], index);
    }

    /// Calls `visit` with the candidates that may agree with `candidate` until it returns true. Buckets are
    /// shared, so it may see a candidate twice, or unrelated ones.
    fn near(&self, candidate: &Candidate, levels_apart: i32, mut visit: impl FnMut(u32) -> bool) {
        let own = level(candidate.reach);
        for level in own - levels_apart..=own + levels_apart {
            let centre = cell(candidate.mean, level);
            for step in 0..27 {
                let around = [step % 3 - 1, step / 3 % 3 - 1, step / 9 - 1];
                let at = std::array::from_fn(|axis| centre[axis].wrapping_add(around[axis]));
                let mut index = self.heads[self.bucket(level, at)];
                while index != NONE {
                    if visit(index) {
                        return;
                    }
                    index = self.next[index as usize];
                }
            }
        }
    }

    fn bucket(&self, level: i32, [x, y, z]: [i64; 3]) -> usize {
        debug_assert_eq!(self.next.len(), self.candidates.len());
        let mut mixed = level as u64;
        for part in [x, y, z] {
            mixed = (mixed ^ part as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            mixed ^= mixed >> 29;
        }
        mixed as usize & (self.heads.len() - 1)
    }
}

/// The power of two at or below a reach.
fn level(reach: f32) -> i32 {
    ((f64::from(reach).to_bits() >> 52) & 0x7ff) as i32 - 1023
}

/// The cell of a level, whose edges are twice its power of two.
fn cell(mean: [f32; 3], level: i32) -> [i64; 3] {
    let edge = 2.0_f64.powi(level + 1);
    mean.map(|value| (f64::from(value) / edge).floor() as i64)
}

#[cfg(test)]
mod tests {

    use fathom_core::config::MergeConfig;
    use proptest::prelude::*;

    use super::*;
    use crate::ply_rows::Splat;

    fn bounds() -> Bounds {
        Bounds::new(&MergeConfig::default())
    }

    fn ball(partition: u32, row: u32, mean: [f32; 3], radius: f32, logit: f32) -> Candidate {
        let splat = Splat {
            log_scales: [radius.ln(); 3],
            quat_wxyz: [1.0, 0.0, 0.0, 0.0],
            colour: [0.0; 3],
            set: 0.0,
        };
        let content = [partition, row].map(u32::to_le_bytes).concat();
        bounds().candidate(RowId { partition, row }, &content, mean, logit, &splat).unwrap()
    }

    fn decide(candidates: &[Candidate]) -> Vec<RowId> {
        let mut decisions = Decisions::default();
        decisions.decide(candidates, &Region::ALL, &bounds());
        rows(decisions)
    }

    fn rows(decisions: Decisions) -> Vec<RowId> {
        let by_partition = decisions.finish().into_iter();
        let rows = by_partition
            .flat_map(|(partition, rows)| rows.into_iter().map(move |d| RowId { partition, row: d.row }));
        rows.collect()
    }

    /// The rule as written, over all pairs.
    fn by_the_rule(candidates: &[Candidate]) -> Vec<RowId> {
        let mut order: Vec<&Candidate> = candidates.iter().collect();
        order.sort_unstable_by_key(|candidate| candidate.rank());
        let (mut stay, mut go): (Vec<&Candidate>, Vec<RowId>) = (Vec::new(), Vec::new());
        for candidate in order {
            let same = |other: &&&Candidate| {
                other.id.partition != candidate.id.partition && bounds().agree(other, candidate)
            };
            if stay.iter().find(same).is_some() {
                go.push(candidate.id);
            } else {
                stay.push(candidate);
            }
        }
        go.sort_unstable();
        go
    }

    #[test]
    fn a_chain_loses_its_middle_if_that_ranks_between_its_ends() {
        // Neighbours are 0.4 deviations apart and agree; the ends are 0.8 apart and do not.
        let chain = |logits: [f32; 3]| {
            let of = |i: u32| ball(i % 2, i, [0.4 * i as f32, 0.0, 0.0], 1.0, logits[i as usize]);
            decide(&[0, 1, 2].map(of)).iter().map(|id| id.row).collect::<Vec<_>>()
        };
        assert_eq!(chain([3.0, 2.0, 1.0]), [1], "A stays, so B goes, so C stays");
        assert_eq!(chain([1.0, 3.0, 2.0]), [0, 2], "B stays, so both ends go");
        assert_eq!(chain([3.0, 1.0, 2.0]), [1]);
    }

    #[test]
    fn gaussians_of_one_partition_are_never_duplicates() {
        let twins = [ball(4, 0, [0.0; 3], 1.0, 1.0), ball(4, 1, [0.0; 3], 1.0, 1.0)];
        assert!(decide(&twins).is_empty());
        let third = ball(5, 0, [0.1, 0.0, 0.0], 1.0, 2.0);
        assert_eq!(decide(&[twins[0], third, twins[1]]).len(), 2, "and both go before one of another");
    }

    #[test]
    fn a_region_is_halved_until_it_is_no_longer_than_a_reach() {
        let region = Region { low: [0.0; 3], high: [1.0, 8.0, 2.0] };
        let [lower, upper] = region.halves(0.1).unwrap();
        assert_eq!((lower.high, upper.low), ([1.0, 4.0, 2.0], [0.0, 4.0, 0.0]));
        assert_eq!(region.halves(8.0), None);
        assert_eq!(Region { low: [1.0; 3], high: [1.0; 3] }.halves(0.0), None);
    }

    /// Balls of several sizes in a space so small that chains are common.
    fn crowd() -> impl Strategy<Value = Vec<Candidate>> {
        let one = (0_u32..4, prop::array::uniform3(-1.5_f32..1.5), 0.1_f32..0.9, -2_i32..3);
        prop::collection::vec(one, 0..60).prop_map(|crowd| {
            let all = crowd.into_iter().enumerate();
            all.map(|(row, (partition, mean, radius, logit))| {
                ball(partition, row as u32, mean, radius, logit as f32)
            })
            .collect()
        })
    }

    proptest! {
        #[test]
        fn the_spatial_hash_finds_what_the_rule_finds_over_all_pairs(crowd in crowd()) {
            prop_assert_eq!(decide(&crowd), by_the_rule(&crowd));
        }

        #[test]
        fn the_order_of_candidates_does_not_matter(crowd in crowd(), turn in 0_usize..60) {
            let mut other = crowd.clone();
            other.reverse();
            other.rotate_left(turn % crowd.len().max(1));
            prop_assert_eq!(decide(&crowd), decide(&other));
        }

        #[test]
        fn the_remaining_gaussians_hold_no_duplicates(crowd in crowd()) {
            let gone = decide(&crowd);
            let left: Vec<Candidate> = crowd.into_iter().filter(|c| !gone.contains(&c.id)).collect();
            prop_assert!(decide(&left).is_empty());
        }

        #[test]
        fn regions_of_any_size_decide_as_one(crowd in crowd(), most in 1_usize..40) {
            let mut decisions = Decisions::default();
            let mut parts = 0;
            let region = Region { low: [-1.5; 3], high: [1.5; 3] };
            let reach = crowd.iter().map(|c| c.reach).fold(0.0, f32::max);
            decisions
                .decide_in_parts(region, reach * 0.3, &bounds(), &mut |region, bounded| {
                    let meets = |c: &&Candidate| region.meets(c.mean, c.mean, c.reach);
                    let inside: Vec<Candidate> = crowd.iter().filter(meets).copied().collect();
                    let given = !bounded || inside.len() <= most;
                    parts += usize::from(given);
                    Ok(given.then_some(inside))
                })
                .unwrap();
            prop_assert!(parts > 1 || crowd.len() <= most || reach > 0.0);
            prop_assert_eq!(rows(decisions), decide(&crowd));
        }
    }
}
