//! Density control's kernels: statistics, splitting, placing.

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Blocks, Gpu, Recorder, Size};
use fathom_core::reference::{Gaussians64, samples};

use crate::device::{device, poison, storage};

/// The model in one trainable block with `capacity` entries.
fn block_of(gpu: &Gpu, model: &Gaussians, capacity: u32) -> Blocks {
    let mut blocks = Blocks::new(gpu, model.sh_degree).unwrap();
    blocks.push_trainable(gpu, model, capacity, Moments::Compact).unwrap();
    blocks
}

#[test]
fn statistics_are_opacity_and_mean_gradient_and_start_anew() {
    let Some(gpu) = device() else { return };
    let mut model = samples::random(141, 200, 1);
    model.means[3][1] = f32::NAN;
    model.quats[4][0] = f32::INFINITY;
    model.opacity_logits[5] = f32::NAN;
    let blocks = block_of(&gpu, &model, 200);
    let (_, block, training) = blocks.trainable().next().unwrap();
    let sums: Vec<[f32; 4]> = (0..200).map(|i| [0.5 * i as f32, (i % 4) as f32, 0.3, 0.0]).collect();
    gpu.write(&training.refine, 0, &sums);
    let stats = storage(&gpu, &[[f32::NAN; 2]; 200]);
    let mut recorder = Recorder::new(&gpu);
    let buffers = [
        ("block", &block.uniform),
        ("transforms", &block.transforms),
        ("refine", &training.refine),
        ("stats", &stats),
    ];
    recorder.dispatch("refine_stats", Size::Items(200, 64), &buffers).unwrap();
    recorder.submit();
    let stats: Vec<[f32; 2]> = gpu.read(&stats, 0, 200).unwrap();
    for (i, found) in stats.iter().enumerate() {
        let opacity =
            if (3..6).contains(&i) { 0.0 } else { 1.0 / (1.0 + (-f64::from(model.opacity_logits[i])).exp()) };
        let mean = f64::from(sums[i][0]) / f64::from(sums[i][1]).max(1.0);
        // 1e-6: one exponential and one division.
        assert!((f64::from(found[0]) - opacity).abs() < 1e-6, "opacity of {i}: {} and {opacity}", found[0]);
        assert!((f64::from(found[1]) - mean).abs() <= 1e-6 * mean, "weight of {i}: {} and {mean}", found[1]);
    }
    let after: Vec<f32> = gpu.read(&training.refine, 0, 800).unwrap();
    assert!(after.iter().all(|&value| value == 0.0));
}

#[test]
fn a_split_keeps_the_place_and_the_variance_and_its_halves_start_anew() {
    let Some(gpu) = device() else { return };
    for degree in [0, 1, 3] {
        let model = samples::random(142, 100, degree);
        let mut blocks = block_of(&gpu, &model, 130);
        // Sources 1, 4, 7, ...; the first five to the places of others, the rest behind the end.
        let sources: Vec<u32> = (0..33).map(|i| 3 * i + 1).collect();
        let places: Vec<u32> = (0..33).map(|i| if i < 5 { 3 * i } else { 95 + i }).collect();
        let staged_at: Vec<u32> = (0..33).map(|i| 32 - i).collect();
        let rows = |of: &[u32]| of.iter().zip(&staged_at).map(|(&a, &b)| [a, b]).collect::<Vec<[u32; 2]>>();
        blocks.set_trainable_total(&gpu, 128);
        let stride = u64::from(3 + fathom_core::gpu::sh_stride(degree));
        let staged = gpu.buffer("staged", 33 * stride * 16).unwrap();
        poison(&gpu, &staged);
        let (splits, placements) = (storage(&gpu, &rows(&sources)), storage(&gpu, &rows(&places)));
        let count = gpu.uniform("count", &[33_u32, 0, 0, 0]);
        // Steps that the sources had: their halves have none.
        let (_, block, _) = blocks.trainable().next().unwrap();
        for &source in &sources {
            gpu.write(&block.transforms, u64::from(source) * 48 + 44, &[7_u32]);
        }
        let mut recorder = Recorder::new(&gpu);
        for (stage, list, count_name, list_name) in [
            ("densify_split", &splits, "split", "splits"),
            ("densify_place", &placements, "place", "placements"),
        ] {
            let buffers = [
                ("block", &block.uniform),
                (count_name, &count),
                (list_name, list),
                ("transforms", &block.transforms),
                ("sh_coeffs", &block.sh_coeffs),
                ("staged", &staged),
            ];
            recorder.dispatch(stage, Size::Items(33, 64), &buffers).unwrap();
        }
        recorder.submit();
        let after = blocks.download(&gpu).unwrap();
        let (before, children) = (Gaussians64::from(&model), Gaussians64::from(&after));
        let k = model.coeffs();
        for (&source, &place) in sources.iter().zip(&places) {
            check_split(&before, &children, source as usize, place as usize);
            for child in [source as usize, place as usize] {
                let own = &after.sh_coeffs[child * k..(child + 1) * k];
                assert_eq!(
                    own,
                    &model.sh_coeffs[source as usize * k..(source as usize + 1) * k],
                    "colour of {child}"
                );
                let steps = gpu.read::<u32>(&block.transforms, child as u64 * 48 + 44, 1).unwrap();
                assert_eq!(steps, [0], "steps of {child}");
            }
        }
        for index in (0..100).filter(|i| !sources.contains(i) && !places.contains(i)) {
            let mut untouched = Gaussians::empty(degree);
            untouched.push_from(&after, index as usize);
            let mut expected = Gaussians::empty(degree);
            expected.push_from(&model, index as usize);
            assert_eq!(untouched, expected, "Gaussian {index} has no part in this");
        }
    }
}

fn check_split(before: &Gaussians64, after: &Gaussians64, source: usize, place: usize) {
    let opacity = |logit: f64| 1.0 / (1.0 + (-logit).exp());
    let close = |what: &str, a: f64, b: f64| {
        // 1e-5: powers and logarithms of numbers of order 1.
        assert!(
            (a - b).abs() < 1e-5 * (1.0 + b.abs()),
            "{what} of the halves of {source}: {a}, expected {b}"
        );
    };
    let axis = (0..3)
        .max_by(|&a, &b| before.log_scales[source][a].total_cmp(&before.log_scales[source][b]))
        .unwrap();
    let [mut distance2, mut along] = [0.0; 2];
    let [w, x, y, z] = before.quats[source];
    let turn = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w).normalize());
    for k in 0..3 {
        close("middle", 0.5 * (after.means[source][k] + after.means[place][k]), before.means[source][k]);
        let offset = 0.5 * (after.means[place][k] - after.means[source][k]);
        distance2 += offset * offset;
        along += offset * turn.col(axis)[k];
        for child in [source, place] {
            let shrunk = if k == axis { 0.5 * 2.0_f64.ln() } else { 0.0 };
            close("scale", after.log_scales[child][k], before.log_scales[source][k] - shrunk);
        }
    }
    let variance = (2.0 * before.log_scales[source][axis]).exp();
    close("variance along the axis", distance2 + (2.0 * after.log_scales[source][axis]).exp(), variance);
    close("direction", along.abs(), distance2.sqrt());
    let one = 1.0 - opacity(before.opacity_logits[source]);
    for child in [source, place] {
        close("opacity", opacity(after.opacity_logits[child]), 1.0 - one.powf(0.5_f64.sqrt()));
        assert_eq!(after.quats[child], before.quats[source], "turn of the halves of {source}");
    }
}
