//! One water from the waters of all partitions of a job, each estimated from its own views
//! (`water.partitions = joint`).
//!
//! Each water parameter is averaged independently, in the unconstrained form of eq. 8, weighted by evidence.
//! The evidence of a partition is the sum of the squared gradients of the parameter while it was optimised.
//! It grows with the number of views and with the effect of the parameter on a picture. If the partitions fit
//! their pictures about equally well, it is an inverse variance up to a common factor. A parameter that no
//! partition moved keeps the value of the global stage.
//!
//! With at least four partitions, a value more than [`FAR_OFF`] robust standard deviations from the median
//! gets less weight.
//!
//! Sums run by ascending partition, so the result does not depend on the order of arrival.

use serde::{Deserialize, Serialize};

use super::{StandardErrors, Water, WaterRecord};
use crate::{CoreError, Result};

/// Version of [`Consensus`].
const FORMAT: u32 = 1;
/// Distance from the median, in robust standard deviations, above which a partition gets less weight.
const FAR_OFF: f64 = 5.0;
/// Minimum number of partitions with evidence for outlier detection: of three, two may be outliers.
const LEAST_TO_JUDGE: usize = 4;
/// Minimum standard deviation of an unconstrained parameter, so that tiny differences never count as
/// outliers.
const LEAST_SPREAD: f64 = 1e-3;
/// Ratio of the standard deviation to the median absolute deviation (normal distribution).
const OF_MEDIAN_DEVIATION: f64 = 1.4826;

/// The water estimate of one partition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartitionEvidence {
    /// Partition number, from 0.
    pub partition: u32,
    /// Its water parameters.
    pub water: Water,
    /// Evidence for each parameter in the order of eq. 8, 0 or more:
    /// [`crate::train::Trainer::water_evidence`] by unconstrained parameter. 0 and non-finite values count as
    /// no evidence.
    pub evidence: [f64; 9],
}

/// One share per water parameter, red, green and blue.
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

/// The contribution of one partition to the consensus: an entry of `partitions` in `water.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartitionWater {
    /// Partition number, from 0.
    pub partition: u32,
    /// The attenuation of the direct signal that it found, red, green, blue, 1/scene unit of the input.
    pub beta_d: [f64; 3],
    /// Growth of the backscatter, 1/scene unit of the input.
    pub beta_b: [f64; 3],
    /// Colour of the water at infinity, linear light.
    pub b_inf: [f64; 3],
    /// Its share of each consensus parameter, 0 to 1. The shares of a parameter sum to 1 over the partitions.
    /// They are all 0 if no partition moved the parameter, which then keeps the value of the global stage.
    pub weight: Shares,
    /// Parameters that were outliers among the partitions and got less weight, such as `beta_d[0]`.
    pub far_off: Vec<String>,
}

/// The water of a job, combined from all of its partitions. The second task of each partition starts from it.
/// `water.json` contains `water` with `partitions` in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Consensus {
    /// Version of this layout: 1.
    pub format: u32,
    /// The water for the rest of the job.
    pub water: WaterRecord,
    /// The contribution of each partition, by ascending number.
    pub partitions: Vec<PartitionWater>,
}

impl Consensus {
    /// Reads a consensus from JSON.
    ///
    /// # Errors
    /// When the JSON is malformed or has an unsupported format.
    pub fn from_json(json: &[u8]) -> Result<Self> {
        let refuse = |why: String| CoreError::Scene(format!("the consensus of the partitions: {why}"));
        let read: Self = serde_json::from_slice(json).map_err(|error| refuse(error.to_string()))?;
        read.check().map_err(refuse)?;
        Ok(read)
    }

    /// Checks the format and the parameters; the error says why they cannot be used.
    pub(crate) fn check(&self) -> std::result::Result<(), String> {
        if self.format != FORMAT {
            return Err(format!("it has format {}; this program reads {FORMAT}", self.format));
        }
        let water = self.water.water();
        if water.is_physical() {
            Ok(())
        } else {
            Err(format!("its water parameters are not physical: {water:?}"))
        }
    }
}

/// The consensus of `partitions`, in any order, that all started from the water `coarse` of the global stage.
/// `unit` is the scene scale for [`Water::to_raw`].
///
/// Standard errors are those of the weighted mean, from the spread of the partitions. They are never smaller
/// than the errors of `coarse`, if those are known: partitions that stay near a common start agree better
/// than their data justify. With fewer than two partitions that have evidence, they are those of `coarse`.
///
/// # Errors
/// When a partition occurs twice or its parameters are not physical.
pub fn consensus(coarse: &WaterRecord, unit: f64, partitions: &[PartitionEvidence]) -> Result<Consensus> {
    let refuse = |why: String| CoreError::Scene(format!("the water of the partitions: {why}"));
    let mut partitions = partitions.to_vec();
    partitions.sort_by_key(|partition| partition.partition);
    for pair in partitions.windows(2) {
        if pair[0].partition == pair[1].partition {
            return Err(refuse(format!("partition {} occurs twice", pair[0].partition)));
        }
    }
    if let Some(PartitionEvidence { partition, water, .. }) =
        partitions.iter().find(|partition| !partition.water.is_physical())
    {
        return Err(refuse(format!("the parameters of partition {partition} are not physical: {water:?}")));
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
    // A unit near 0 gives values that JSON cannot hold; a sound partition never has one.
    let per_metre = [agreed.beta_d_per_m, agreed.beta_b_per_m].into_iter().flatten().flatten();
    if !agreed.water().is_physical() || !per_metre.into_iter().all(f64::is_finite) {
        let water = agreed.water();
        return Err(refuse(format!("with a unit of {unit:e}, the consensus is not physical: {water:?}")));
    }
    let gave = partitions.iter().zip(shares).zip(far_off).map(|((partition, shares), far_off)| {
        let Water { beta_d, beta_b, b_inf } = partition.water;
        let three = |at: usize| std::array::from_fn(|c| shares[at + c]);
        let weight = Shares { beta_d: three(0), beta_b: three(3), b_inf: three(6) };
        PartitionWater { partition: partition.partition, beta_d, beta_b, b_inf, weight, far_off }
    });
    Ok(Consensus { format: FORMAT, water: agreed, partitions: gave.collect() })
}

/// The consensus on one parameter.
struct Agreed {
    mean: f64,
    /// Standard error of the mean; `None` where one partition has all the weight.
    error: Option<f64>,
    /// Share of each partition; they sum to 1.
    shares: Vec<f64>,
    /// Indices of the partitions with reduced weight.
    far_off: Vec<usize>,
}

/// `None` without evidence.
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
                // Squared, so that the pull of an outlier decreases with its distance.
                weights[k] *= (limit / off).powi(2);
                far_off.push(k);
            }
        }
    }
    let total: f64 = weights.iter().sum();
    let shares: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
    let sum = |of: &dyn Fn(f64) -> f64| -> f64 { shares.iter().zip(values).map(|(w, v)| w * of(*v)).sum() };
    // Relative to the common start, so that equal values stay exactly equal.
    let mean = start + sum(&|value| value - start);
    let variance = sum(&|value| (value - mean).powi(2));
    let effective = 1.0 / shares.iter().map(|share| share * share).sum::<f64>();
    let error = (effective > 1.0 + 1e-9).then(|| (variance / (effective - 1.0)).sqrt());
    Some(Agreed { mean, error, shares, far_off })
}

/// `values` must not be empty.
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

    /// A partition whose unconstrained parameters are all `off` from those of the start.
    fn partition(partition: u32, off: f64, evidence: f64) -> PartitionEvidence {
        let raw = Water::COASTAL.to_raw(UNIT).map(|value| value + off);
        PartitionEvidence { partition, water: Water::from_raw(raw, UNIT), evidence: [evidence; 9] }
    }

    /// Distance of the consensus from the start, by unconstrained parameter.
    fn moved(found: &Consensus) -> [f64; 9] {
        let (raw, start) = (found.water.water().to_raw(UNIT), Water::COASTAL.to_raw(UNIT));
        std::array::from_fn(|i| raw[i] - start[i])
    }

    fn assert_near(what: &str, found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-9, "{what}: {found}, not {expected}");
    }

    #[test]
    fn unit_that_leads_to_infinite_parameters_is_refused() {
        let begun = coarse([0.01; 9]);
        let refused = consensus(&begun, 1e-320, &[partition(0, 0.1, 1.0)]).unwrap_err().to_string();
        assert!(refused.contains("a unit of 1e-320") && refused.contains("not physical"), "{refused}");
    }

    #[test]
    fn each_parameter_is_averaged_by_its_own_evidence() {
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
        // Two values 0.4 apart with equal weights have a standard error of half the distance.
        let (value, error) = (found.water.b_inf[0], found.water.standard_error.b_inf[0].unwrap());
        assert_near("error of b_inf", error, 0.2 * value * (1.0 - value));
        assert_eq!(found.water.beta_d_per_m.unwrap()[0], found.water.beta_d[0] / 0.5);
    }

    #[test]
    fn errors_are_at_least_those_of_the_start() {
        let found = consensus(&coarse([0.01; 9]), UNIT, &[partition(0, 1e-6, 1.0), partition(1, 0.0, 1.0)]);
        assert_eq!(found.unwrap().water.standard_error.to_array(), [0.01; 9]);
        let apart = consensus(&coarse([1e-9; 9]), UNIT, &[partition(0, 0.5, 1.0), partition(1, 0.0, 1.0)]);
        assert!(apart.unwrap().water.standard_error.to_array().iter().all(|error| *error > 1e-3));
        let alone = consensus(&coarse([0.02; 9]), UNIT, &[partition(0, 0.5, 1.0), partition(1, 0.0, 0.0)]);
        assert_eq!(alone.unwrap().water.standard_error.to_array(), [0.02; 9], "one partition has no spread");
    }

    #[test]
    fn without_evidence_the_global_water_is_kept_bit_for_bit() {
        for none in [0.0, f64::NAN, -1.0, f64::INFINITY] {
            let all = [partition(0, 0.3, none), partition(1, -0.2, none)];
            let found = consensus(&coarse([0.01; 9]), UNIT, &all).unwrap();
            assert_eq!(found.water.water(), Water::COASTAL, "evidence of {none}");
            assert_eq!(found.water.standard_error, coarse([0.01; 9]).standard_error);
            assert!(found.partitions.iter().all(|gave| gave.weight == Shares::default()));
        }
        assert_eq!(consensus(&coarse([0.01; 9]), UNIT, &[]).unwrap().water.water(), Water::COASTAL);
        // A partition without evidence does not affect the others.
        let all = [partition(0, 0.3, f64::NAN), partition(1, -0.2, 2.0)];
        moved(&consensus(&coarse([0.01; 9]), UNIT, &all).unwrap())
            .iter()
            .for_each(|moved| assert_near("the partition with evidence", *moved, -0.2));
    }

    #[test]
    fn outlier_among_four_is_named_and_gets_less_weight() {
        let near = |n: u32| partition(n, 0.01 * f64::from(n), 1.0);
        let mut astray = near(3);
        // With ten times the evidence of another.
        astray = PartitionEvidence { water: partition(3, 2.0, 0.0).water, evidence: [10.0; 9], ..astray };
        let four = consensus(&coarse([0.01; 9]), UNIT, &[near(0), near(1), near(2), astray]).unwrap();
        assert!(moved(&four).iter().all(|moved| (0.0..0.15).contains(moved)), "{:?}", moved(&four));
        assert_eq!(four.partitions[3].far_off.len(), 9);
        assert_eq!(four.partitions[3].far_off[4], "beta_b[1]");
        assert!(four.partitions[..3].iter().all(|gave| gave.far_off.is_empty()));
        let share: f64 = four.partitions.iter().map(|gave| gave.weight.b_inf[1]).sum();
        assert_near("shares", share, 1.0);

        let three = consensus(&coarse([0.01; 9]), UNIT, &[near(0), near(1), astray]).unwrap();
        assert!(three.partitions[2].far_off.is_empty(), "no outliers among three");
        assert!(moved(&three).iter().all(|moved| *moved > 1.5));

        // A difference of a ten-thousandth is too small for an outlier.
        let hardly = [0, 1, 2, 3].map(|n| partition(n, if n == 3 { 1e-4 } else { 0.0 }, 1.0));
        let hardly = consensus(&coarse([0.01; 9]), UNIT, &hardly).unwrap();
        assert!(hardly.partitions.iter().all(|gave| gave.far_off.is_empty()));
    }

    #[test]
    fn result_does_not_depend_on_the_order_of_arrival() {
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
    fn duplicate_or_unphysical_partitions_are_refused() {
        let refused = |partitions: &[PartitionEvidence]| {
            consensus(&coarse([0.01; 9]), UNIT, partitions).unwrap_err().to_string()
        };
        assert!(
            refused(&[partition(4, 0.0, 1.0), partition(4, 0.1, 1.0)]).contains("partition 4 occurs twice")
        );
        let mut dry = partition(2, 0.0, 1.0);
        dry.water.beta_b[0] = -1.0;
        assert!(refused(&[dry]).contains("partition 2"));
        assert!(Consensus::from_json(b"{}").is_err());
    }
}
