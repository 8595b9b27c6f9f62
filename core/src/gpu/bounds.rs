//! Culling bounds of frozen Gaussians: a spatial order, and a bounding box for every chunk of it.
//!
//! A view that sees a fiftieth of a merged model must not visit every Gaussian. Trainable Gaussians have no
//! bounds: they move at every step, and density control places new ones anywhere.

use rayon::prelude::*;

use crate::gaussians::Gaussians;

/// Gaussians per culling bound. Mirror: `CHUNK` of `shaders/shared/gaussian.wgsl`.
pub const CULL_CHUNK: u32 = 4096;

/// Gaussians that reach farther than this many times the median get chunks of their own. One of them would
/// make the bound of its chunk useless.
const WIDE: f32 = 16.0;

/// Distance from its centre, scene units, at which the weight of a Gaussian falls below one step of 8-bit
/// colour. 0 for a Gaussian that is never visible.
fn reach(model: &Gaussians, index: usize) -> f32 {
    let opacity = 1.0 / (1.0 + (-model.opacity_logits[index]).exp());
    let deviations = (2.0 * (255.0 * opacity).ln().max(0.0)).sqrt();
    let [x, y, z] = model.log_scales[index];
    let reach = deviations * x.max(y).max(z).exp();
    if reach.is_finite() && model.means[index].iter().all(|v| v.is_finite()) { reach } else { 0.0 }
}

/// The Gaussians of a model along a Morton curve; the few that reach far come last.
pub fn spatial_order(model: &Gaussians) -> Vec<u32> {
    let n = model.len();
    if n <= CULL_CHUNK as usize {
        return (0..n as u32).collect();
    }
    let reaches: Vec<f32> = (0..n).into_par_iter().map(|i| reach(model, i)).collect();
    let mut sorted = reaches.clone();
    let (_, median, _) = sorted.select_nth_unstable_by(n / 2, f32::total_cmp);
    let widest = WIDE * *median;
    let finite = |mean: &[f32; 3]| mean.iter().all(|v| v.is_finite());
    let (mut low, mut high) = ([f32::MAX; 3], [f32::MIN; 3]);
    for (mean, _) in
        model.means.iter().zip(&reaches).filter(|(mean, reach)| finite(mean) && **reach <= widest)
    {
        for k in 0..3 {
            low[k] = low[k].min(mean[k]);
            high[k] = high[k].max(mean[k]);
        }
    }
    let code = |index: usize| -> u64 {
        let mean = model.means[index];
        if !finite(&mean) {
            return u64::MAX;
        }
        let cell = |k: usize| {
            let share = (mean[k] - low[k]) / (high[k] - low[k]).max(f32::MIN_POSITIVE);
            (share.clamp(0.0, 1.0) * 2_097_151.0) as u64
        };
        spread(cell(0)) | spread(cell(1)) << 1 | spread(cell(2)) << 2
    };
    let mut keys: Vec<(bool, u64, u32)> =
        (0..n).into_par_iter().map(|i| (reaches[i] > widest, code(i), i as u32)).collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, _, index)| index).collect()
}

/// The low 21 bits of a number, with two zeros between neighbours.
fn spread(value: u64) -> u64 {
    let mut v = value & 0x1f_ffff;
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

/// `[chunks*2]`: (centre of the bounding box of the means, largest reach), (half its sides, 0). A chunk that
/// is never visible has a reach below 0.
pub fn chunk_bounds(model: &Gaussians, order: &[u32]) -> Vec<[f32; 4]> {
    let bound = |chunk: &[u32]| {
        let (mut low, mut high, mut furthest) = ([f32::MAX; 3], [f32::MIN; 3], -1.0_f32);
        for &index in chunk {
            let far = reach(model, index as usize);
            if far <= 0.0 {
                continue;
            }
            furthest = furthest.max(far);
            for k in 0..3 {
                low[k] = low[k].min(model.means[index as usize][k]);
                high[k] = high[k].max(model.means[index as usize][k]);
            }
        }
        if furthest < 0.0 {
            return [[0.0, 0.0, 0.0, -1.0], [0.0; 4]];
        }
        let middle: [f32; 3] = std::array::from_fn(|k| 0.5 * low[k] + 0.5 * high[k]);
        // To the farther end, so that rounding of the middle leaves no mean outside.
        let half = |k: usize| (high[k] - middle[k]).max(middle[k] - low[k]);
        [[middle[0], middle[1], middle[2], furthest], [half(0), half(1), half(2), 0.0]]
    };
    order.par_chunks(CULL_CHUNK as usize).map(bound).collect::<Vec<_>>().concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Stream, uniform_at};

    /// Gaussians in a box of side 2 around the origin, of all sizes.
    fn random(seed: u32, count: u32) -> Gaussians {
        let mut model = Gaussians::empty(0);
        for i in 0..count {
            let u = |j: u32| uniform_at(seed, Stream::Test, i, j);
            model.means.push([0, 1, 2].map(|j| 2.0 * u(j) - 1.0));
            model.quats.push([3, 4, 5, 6].map(|j| 2.0 * u(j) - 0.99));
            model.log_scales.push([7, 8, 9].map(|j| 3.0 * u(j) - 4.0));
            model.opacity_logits.push(5.0 * u(10) - 2.0);
            model.sh_coeffs.push([11, 12, 13].map(|j| 2.0 * u(j) - 1.0));
        }
        model
    }

    #[test]
    fn spatial_order_is_a_permutation_with_neighbours_together() {
        let mut model = random(7, 8 * CULL_CHUNK);
        model.log_scales[77] = [4.0; 3];
        model.means[99] = [f32::NAN; 3];
        let order = spatial_order(&model);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().copied().eq(0..8 * CULL_CHUNK));
        assert_eq!(order.last(), Some(&77), "the Gaussian that reaches far is last");
        // A box of side 2 cut into eight chunks, about one per octant: half sides of 1/2.
        let bounds = chunk_bounds(&model, &order);
        assert_eq!(bounds.len(), 16);
        let volume = |half: &[f32; 4]| half[..3].iter().product::<f32>();
        let mean = bounds.iter().skip(1).step_by(2).take(7).map(volume).sum::<f32>() / 7.0;
        assert!((0.12..0.3).contains(&mean), "{mean} of 1: {bounds:?}");
    }

    #[test]
    fn a_bound_contains_every_mean_and_the_largest_reach() {
        let model = random(8, 9000);
        let order = spatial_order(&model);
        let bounds = chunk_bounds(&model, &order);
        for (chunk, bound) in order.chunks(CULL_CHUNK as usize).zip(bounds.chunks(2)) {
            for &index in chunk {
                for k in 0..3 {
                    let off = (model.means[index as usize][k] - bound[0][k]).abs();
                    assert!(off <= bound[1][k], "{index} is outside");
                }
                assert!(reach(&model, index as usize) <= bound[0][3]);
            }
        }
    }
}
