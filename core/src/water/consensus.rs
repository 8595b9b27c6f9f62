//! One water of what the partitions of a job found, each from its own views (`water.partitions = joint`).
//!
//! Each of the nine numbers by itself, as the unconstrained number of eq. 8: the mean over the partitions,
//! weighted by their evidence. Evidence is the sum of the squared gradients that a number had while it moved:
//! what a partition's views say of the number grows with their count and with how much a picture changes with
//! it. Between partitions whose pictures fit about equally well that is the inverse of a variance, up to a
//! factor that they share. A number that moved nowhere keeps the value of the global stage.
//!
//! From four partitions on, one that lies more than [`FAR_OFF`] robust standard deviations from the median
//! counts less.
//!
//! Sums run by ascending partition, so the result does not depend on who was first.

use serde::{Deserialize, Serialize};

use super::{StandardErrors, Water, WaterRecord};
use crate::{CoreError, Result};

/// Version of [`Consensus`].
const FORMAT: u32 = 1;
/// Robust standard deviations from which a partition counts less.
const FAR_OFF: f64 = 5.0;
/// So many partitions must have evidence before one of them is far off: of three, two may be.
const LEAST_TO_JUDGE: usize = 4;
/// Least standard deviation of an unconstrained number: below a thousandth of a number nobody is far off.
const LEAST_SPREAD: f64 = 1e-3;
/// Standard deviations in a median absolute deviation (normal distribution).
const OF_MEDIAN_DEVIATION: f64 = 1.4826;

/// What one partition says of the water.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartitionEvidence {
    /// Which, from 0.
    pub partition: u32,
    /// Its nine numbers.
    pub water: Water,
    /// What stands behind each in the order of eq. 8, 0 or more: [`crate::train::Trainer::water_evidence`] by
    /// unconstrained number. 0, and whatever is not finite, is none.
    pub evidence: [f64; 9],
}

/// Three numbers each, red, green and blue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shares {
    /// Of `beta_d`.
    pub beta_d: [f64; 3],
    /// Of `beta_b`.
    pub beta_b: [f64; 3],
    /// Of `b_inf`.
    pub b_inf: [f64; 3],
}

/// What one partition gave to the consensus: an entry of `partitions` in `water.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartitionWater {
    /// Which, from 0.
    pub partition: u32,
    /// What it found: attenuation of the direct signal, red, green, blue, 1/scene unit of the input.
    pub beta_d: [f64; 3],
    /// Growth of the backscatter, 1/scene unit of the input.
    pub beta_b: [f64; 3],
    /// Colour of the water at infinity, linear light.
    pub b_inf: [f64; 3],
    /// Its share of each number of the consensus, 0 to 1. The shares of a number add up to 1 over the
    /// partitions, or are all 0 where it moved in none and is that of the global stage.
    pub weight: Shares,
    /// Numbers that were far from those of the other partitions and counted less for it, such as `beta_d[0]`.
    pub far_off: Vec<String>,
}

/// The water of a job by all of its partitions. Their second tasks take it from here; `water.json` is `water`
/// with `partitions` in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Consensus {
    /// Version of this layout: 1.
    pub format: u32,
    /// The water of the rest of the job.
    pub water: WaterRecord,
    /// What each partition gave, by ascending number.
    pub partitions: Vec<PartitionWater>,
}

impl Consensus {
    /// Reads what was written as JSON.
    ///
    /// # Errors
    /// When it is none that this program can read.
    pub fn from_json(json: &[u8]) -> Result<Self> {
        let refuse = |why: String| CoreError::Scene(format!("the consensus of the partitions: {why}"));
        let read: Self = serde_json::from_slice(json).map_err(|error| refuse(error.to_string()))?;
        read.check().map_err(refuse)?;
        Ok(read)
    }

    /// Says what about it this program cannot use.
    pub(crate) fn check(&self) -> std::result::Result<(), String> {
        if self.format != FORMAT {
            return Err(format!("it has format {}, and this program reads {FORMAT}", self.format));
        }
        let water = self.water.water();
        if water.is_physical() {
            Ok(())
        } else {
            Err(format!("its numbers are none that a water can have: {water:?}"))
        }
    }
}

/// The consensus of `partitions`, in any order, that all began with the water `coarse` of the global stage;
/// `unit` is the usual viewing distance, by which [`Water::to_raw`] counts.
///
/// Standard errors are those of the weighted mean by the spread of the partitions, but not below those of
/// `coarse` where it has any: numbers that are held near a common start agree better than they know. Where
/// fewer than two partitions have evidence they are those of `coarse`.
///
/// # Errors
/// When a partition comes twice or its numbers are none that a water can have.
pub fn consensus(coarse: &WaterRecord, unit: f64, partitions: &[PartitionEvidence]) -> Result<Consensus> {
    let refuse = |why: String| CoreError::Scene(format!("the water of the partitions: {why}"));
    let mut partitions = partitions.to_vec();
    partitions.sort_by_key(|partition| partition.partition);
    for pair in partitions.windows(2) {
        if pair[0].partition == pair[1].partition {
            return Err(refuse(format!("partition {} has two", pair[0].partition)));
        }
    }
    if let Some(PartitionEvidence { partition, water, .. }) =
        partitions.iter().find(|partition| !partition.water.is_physical())
    {
        return Err(refuse(format!(
            "that of partition {partition} is none that a water can have: {water:?}"
        )));
    }
    let raw: Vec<[f64; 9]> = partitions.iter().map(|partition| partition.water.to_raw(unit)).collect();
    let start = coarse.water().to_raw(unit);
    let (mut values, mut errors) = (coarse.water().to_array(), coarse.standard_error.to_array());
    let mut shares = vec![[0.0; 9]; partitions.len()];
    let mut far_off = vec![Vec::new(); partitions.len()];
    for i in 0..9 {
        let column: Vec<f64> = raw.iter().map(|raw| raw[i]).collect();
        let evidence: Vec<f64> = partitions.iter().map(|partition| partition.evidence[i]).collect();
        let Some(agreed) = agree(start[i], &column, &evidence) else { continue };
        let mut all = start;
        all[i] = agreed.mean;
        let there = Water::from_raw(all, unit);
        values[i] = there.to_array()[i];
        if let Some(error) = agreed.error {
            let slope = there.slopes(unit)[i];
            let known = errors[i].is_finite();
            errors[i] = if known { errors[i].max(error * slope) } else { error * slope };
        }
        for (k, share) in agreed.shares.into_iter().enumerate() {
            shares[k][i] = share;
        }
        for k in agreed.far_off {
            far_off[k].push(format!("{}[{}]", ["beta_d", "beta_b", "b_inf"][i / 3], i % 3));
        }
    }
    let Water { beta_d, beta_b, b_inf } = Water::from_array(values);
    let per_m = |beta: [f64; 3]| coarse.metres_per_unit.map(|metres| beta.map(|value| value / metres));
    let agreed = WaterRecord {
        standard_error: StandardErrors::from_array(errors),
        source: "consensus".to_owned(),
        beta_d_per_m: per_m(beta_d),
        beta_b_per_m: per_m(beta_b),
        beta_d,
        beta_b,
        b_inf,
        ..coarse.clone()
    };
    // A unit near nothing makes numbers that no file can hold; none of a sound partition does.
    let per_metre = [agreed.beta_d_per_m, agreed.beta_b_per_m].into_iter().flatten().flatten();
    if !agreed.water().is_physical() || !per_metre.into_iter().all(f64::is_finite) {
        let water = agreed.water();
        return Err(refuse(format!(
            "what they agree on, in a unit of {unit:e}, is none that a water can have: {water:?}"
        )));
    }
    let gave = partitions.iter().zip(shares).zip(far_off).map(|((partition, shares), far_off)| {
        let Water { beta_d, beta_b, b_inf } = partition.water;
        let three = |at: usize| std::array::from_fn(|c| shares[at + c]);
        let weight = Shares { beta_d: three(0), beta_b: three(3), b_inf: three(6) };
        PartitionWater { partition: partition.partition, beta_d, beta_b, b_inf, weight, far_off }
    });
    Ok(Consensus { format: FORMAT, water: agreed, partitions: gave.collect() })
}

/// What partitions agree on about one number.
struct Agreed {
    mean: f64,
    /// Standard error of the mean; `None` where one partition has all the weight.
    error: Option<f64>,
    /// Of each partition; they add up to 1.
    shares: Vec<f64>,
    /// Indices of those that count less.
    far_off: Vec<usize>,
}

/// `None` where there is no evidence.
fn agree(start: f64, values: &[f64], evidence: &[f64]) -> Option<Agreed> {
    let most = evidence.iter().copied().filter(|weight| weight.is_finite()).fold(0.0, f64::max);
    if most <= 0.0 {
        return None;
    }
    let sound = |weight: f64| if weight.is_finite() && weight > 0.0 { weight / most } else { 0.0 };
    let mut weights: Vec<f64> = evidence.iter().map(|weight| sound(*weight)).collect();
    let heard: Vec<f64> = values.iter().zip(&weights).filter(|(_, w)| **w > 0.0).map(|(v, _)| *v).collect();
    let mut far_off = Vec::new();
    if heard.len() >= LEAST_TO_JUDGE {
        let centre = median(heard.clone());
        let deviation = median(heard.iter().map(|value| (value - centre).abs()).collect());
        let limit = FAR_OFF * (OF_MEDIAN_DEVIATION * deviation).max(LEAST_SPREAD);
        for (k, value) in values.iter().enumerate() {
            let off = (value - centre).abs();
            if weights[k] > 0.0 && off > limit {
                // Squared: what it pulls falls with its distance.
                weights[k] *= (limit / off).powi(2);
                far_off.push(k);
            }
        }
    }
    let total: f64 = weights.iter().sum();
    let shares: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
    let sum = |of: &dyn Fn(f64) -> f64| -> f64 { shares.iter().zip(values).map(|(w, v)| w * of(*v)).sum() };
    // From where all began: where all are equal, nothing is rounded away.
    let mean = start + sum(&|value| value - start);
    let variance = sum(&|value| (value - mean).powi(2));
    let effective = 1.0 / shares.iter().map(|share| share * share).sum::<f64>();
    let error = (effective > 1.0 + 1e-9).then(|| (variance / (effective - 1.0)).sqrt());
    Some(Agreed { mean, error, shares, far_off })
}

/// Of at least one number.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    if values.len() % 2 == 1 { values[half] } else { 0.5 * (values[half - 1] + values[half]) }
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::config::Composition;

    const UNIT: f64 = 4.0;

    fn coarse(errors: [f64; 9]) -> WaterRecord {
        let acts = Composition::GaussiansSrgb;
        WaterRecord::new(&Water::COASTAL, acts, StandardErrors::from_array(errors), "descended", 0.5)
    }

    /// A partition whose unconstrained numbers are all `off` from those of the start.
    fn partition(partition: u32, off: f64, evidence: f64) -> PartitionEvidence {
        let raw = Water::COASTAL.to_raw(UNIT).map(|value| value + off);
        PartitionEvidence { partition, water: Water::from_raw(raw, UNIT), evidence: [evidence; 9] }
    }

    /// How far the consensus is from the start, by unconstrained number.
    fn moved(found: &Consensus) -> [f64; 9] {
        let (raw, start) = (found.water.water().to_raw(UNIT), Water::COASTAL.to_raw(UNIT));
        std::array::from_fn(|i| raw[i] - start[i])
    }

    fn assert_near(what: &str, found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-9, "{what}: {found}, not {expected}");
    }

    #[test]
    fn a_unit_that_leads_to_numbers_without_end_is_refused() {
        let begun = coarse([0.01; 9]);
        let refused = consensus(&begun, 1e-320, &[partition(0, 0.1, 1.0)]).unwrap_err().to_string();
        assert!(
            refused.contains("a unit of 1e-320") && refused.contains("none that a water can have"),
            "{refused}"
        );
    }

    #[test]
    fn each_number_is_the_mean_weighted_by_its_own_evidence() {
        let mut three_times = partition(1, 0.4, 1.0);
        three_times.evidence[2] = 3.0;
        let found =
            consensus(&coarse([f64::INFINITY; 9]), UNIT, &[partition(0, 0.0, 1.0), three_times]).unwrap();
        for (i, moved) in moved(&found).into_iter().enumerate() {
            assert_near("mean", moved, if i == 2 { 0.3 } else { 0.2 });
        }
        assert_eq!(found.water.source, "consensus");
        assert_eq!(found.partitions[0].weight.beta_d, [0.5, 0.5, 0.25]);
        assert_eq!(found.partitions[1].weight.beta_d, [0.5, 0.5, 0.75]);
        assert_eq!(found.partitions[1].beta_d, three_times.water.beta_d);
        // Of two values 0.4 apart with equal weights: half of that, which is their standard error too.
        let (value, error) = (found.water.b_inf[0], found.water.standard_error.b_inf[0].unwrap());
        assert_near("error of b_inf", error, 0.2 * value * (1.0 - value));
        assert_eq!(found.water.beta_d_per_m.unwrap()[0], found.water.beta_d[0] / 0.5);
    }

    #[test]
    fn errors_of_the_start_are_not_undercut_by_partitions_that_hardly_moved() {
        let found = consensus(&coarse([0.01; 9]), UNIT, &[partition(0, 1e-6, 1.0), partition(1, 0.0, 1.0)]);
        assert_eq!(found.unwrap().water.standard_error.to_array(), [0.01; 9]);
        let apart = consensus(&coarse([1e-9; 9]), UNIT, &[partition(0, 0.5, 1.0), partition(1, 0.0, 1.0)]);
        assert!(apart.unwrap().water.standard_error.to_array().iter().all(|error| *error > 1e-3));
        let alone = consensus(&coarse([0.02; 9]), UNIT, &[partition(0, 0.5, 1.0), partition(1, 0.0, 0.0)]);
        assert_eq!(alone.unwrap().water.standard_error.to_array(), [0.02; 9], "one partition has no spread");
    }

    #[test]
    fn without_any_evidence_the_water_is_that_of_the_global_stage_to_the_bit() {
        for none in [0.0, f64::NAN, -1.0, f64::INFINITY] {
            let all = [partition(0, 0.3, none), partition(1, -0.2, none)];
            let found = consensus(&coarse([0.01; 9]), UNIT, &all).unwrap();
            assert_eq!(found.water.water(), Water::COASTAL, "evidence of {none}");
            assert_eq!(found.water.standard_error, coarse([0.01; 9]).standard_error);
            assert!(found.partitions.iter().all(|gave| gave.weight == Shares::default()));
        }
        assert_eq!(consensus(&coarse([0.01; 9]), UNIT, &[]).unwrap().water.water(), Water::COASTAL);
        // One whose evidence is none does not spoil those of the others.
        let all = [partition(0, 0.3, f64::NAN), partition(1, -0.2, 2.0)];
        moved(&consensus(&coarse([0.01; 9]), UNIT, &all).unwrap())
            .iter()
            .for_each(|moved| assert_near("the one that knows", *moved, -0.2));
    }

    #[test]
    fn one_that_is_far_off_counts_less_among_four_and_is_named() {
        let near = |n: u32| partition(n, 0.01 * f64::from(n), 1.0);
        let mut astray = near(3);
        // As sure as ten others.
        astray = PartitionEvidence { water: partition(3, 2.0, 0.0).water, evidence: [10.0; 9], ..astray };
        let four = consensus(&coarse([0.01; 9]), UNIT, &[near(0), near(1), near(2), astray]).unwrap();
        assert!(moved(&four).iter().all(|moved| (0.0..0.15).contains(moved)), "{:?}", moved(&four));
        assert_eq!(four.partitions[3].far_off.len(), 9);
        assert_eq!(four.partitions[3].far_off[4], "beta_b[1]");
        assert!(four.partitions[..3].iter().all(|gave| gave.far_off.is_empty()));
        let share: f64 = four.partitions.iter().map(|gave| gave.weight.b_inf[1]).sum();
        assert_near("shares", share, 1.0);

        let three = consensus(&coarse([0.01; 9]), UNIT, &[near(0), near(1), astray]).unwrap();
        assert!(three.partitions[2].far_off.is_empty(), "of three nobody is judged");
        assert!(moved(&three).iter().all(|moved| *moved > 1.5));

        // Equal to the last bit but one, which is a ten-thousandth off: nobody is far off.
        let hardly = [0, 1, 2, 3].map(|n| partition(n, if n == 3 { 1e-4 } else { 0.0 }, 1.0));
        let hardly = consensus(&coarse([0.01; 9]), UNIT, &hardly).unwrap();
        assert!(hardly.partitions.iter().all(|gave| gave.far_off.is_empty()));
    }

    #[test]
    fn any_order_of_arrival_gives_the_same_bytes() {
        let all: Vec<PartitionEvidence> =
            (0..7).map(|n| partition(n, (f64::from(n) * 1.7).sin(), 1.0 + f64::from(n * n % 5))).collect();
        let bytes = |partitions: &[PartitionEvidence]| {
            serde_json::to_vec(&consensus(&coarse([0.01; 9]), UNIT, partitions).unwrap()).unwrap()
        };
        let expected = bytes(&all);
        for turn in 1..7 {
            let mut other = all.clone();
            other.rotate_left(turn);
            other.swap(0, 3);
            assert_eq!(bytes(&other), expected, "turned by {turn}");
        }
        let read = Consensus::from_json(&expected).unwrap();
        assert_eq!(serde_json::to_vec(&read).unwrap(), expected, "JSON keeps every bit");
    }

    #[test]
    fn a_partition_that_comes_twice_or_has_no_water_is_refused() {
        let refused = |partitions: &[PartitionEvidence]| {
            consensus(&coarse([0.01; 9]), UNIT, partitions).unwrap_err().to_string()
        };
        assert!(refused(&[partition(4, 0.0, 1.0), partition(4, 0.1, 1.0)]).contains("partition 4 has two"));
        let mut dry = partition(2, 0.0, 1.0);
        dry.water.beta_b[0] = -1.0;
        assert!(refused(&[dry]).contains("partition 2"));
        assert!(Consensus::from_json(b"{}").is_err());
    }
}
