//! The kernels of density control: statistics, splitting, placing.

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Blocks, Gpu, Recorder, Size};
use fathom_core::rng::{Stream, random_bits};
use fathom_twins::{Gaussians64, samples};

use crate::device::{assert_same_bits, device, poison, storage};

/// The model in one trainable block with `capacity` entries.
fn block_of(gpu: &Gpu, model: &Gaussians, capacity: u32) -> Blocks {
    let mut blocks = Blocks::new(gpu, model.sh_degree).unwrap();
    blocks.push_trainable(gpu, model, capacity, Moments::Compact).unwrap();
    blocks
}

#[test]
fn statistics_are_opacity_gradients_and_size_and_reset_sums() {
    let Some(gpu) = device() else { return };
    let mut model = samples::random(141, 200, 1);
    model.means[3][1] = f32::NAN;
    model.quats[4][0] = f32::INFINITY;
    model.opacity_logits[5] = f32::NAN;
    let blocks = block_of(&gpu, &model, 200);
    let (_, block, training) = blocks.trainable().next().unwrap();
    let sums: Vec<[f32; 4]> =
        (0..200).map(|i| [0.5 * i as f32, (i % 4) as f32, 0.3, 0.1 * i as f32]).collect();
    gpu.write(&training.density_sums, 0, &sums);
    let stats = storage(&gpu, &[[f32::NAN; 4]; 200]);
    let mut recorder = Recorder::new(&gpu);
    let buffers = [
        ("block", &block.uniform),
        ("transforms", &block.transforms),
        ("density_sums", &training.density_sums),
        ("stats", &stats),
    ];
    recorder.dispatch("density_stats", Size::Items(200, 64), &buffers).unwrap();
    recorder.submit();
    let stats: Vec<[f32; 4]> = gpu.read(&stats, 0, 200).unwrap();
    for (i, found) in stats.iter().enumerate() {
        let opacity =
            if (3..6).contains(&i) { 0.0 } else { 1.0 / (1.0 + (-f64::from(model.opacity_logits[i])).exp()) };
        let mean = |sum: f32| f64::from(sum) / f64::from(sums[i][1]).max(1.0);
        let scale = model.log_scales[i].iter().copied().fold(f32::MIN, f32::max);
        let numbers = [mean(sums[i][0]), mean(sums[i][3]), f64::from(scale).exp()];
        // 1e-6: one exponential and one division.
        assert!((f64::from(found[0]) - opacity).abs() < 1e-6, "opacity of {i}: {} and {opacity}", found[0]);
        for (found, expected) in found[1..].iter().zip(numbers) {
            assert!(
                (f64::from(*found) - expected).abs() <= 1e-6 * expected,
                "statistics of {i}: {found} and {expected}"
            );
        }
    }
    let after: Vec<f32> = gpu.read(&training.density_sums, 0, 800).unwrap();
    assert!(after.chunks(4).all(|row| row == [0.0, 0.0, 0.3, 0.0]), "only the smoothing must stay");
}

#[test]
fn a_split_keeps_place_and_variance_and_resets_its_halves() {
    let Some(gpu) = device() else { return };
    // The third number of a disk is not a scale.
    for (degree, axes) in [(0, 3), (1, 3), (3, 3), (1, 2)] {
        let model = samples::random(142, 100, degree);
        let mut blocks = block_of(&gpu, &model, 130);
        // Sources 1, 4, 7, ...; the first five halves replace other Gaussians, the rest are appended.
        let sources: Vec<u32> = (0..33).map(|i| 3 * i + 1).collect();
        let places: Vec<u32> = (0..33).map(|i| if i < 5 { 3 * i } else { 95 + i }).collect();
        let staged_at: Vec<u32> = (0..33).map(|i| 32 - i).collect();
        let rows = |of: &[u32]| of.iter().zip(&staged_at).map(|(&a, &b)| [a, b]).collect::<Vec<[u32; 2]>>();
        blocks.set_trainable_total(&gpu, 128);
        let stride = u64::from(3 + fathom_core::gpu::sh_stride(degree));
        let staged = gpu.buffer("staged", 33 * stride * 16).unwrap();
        poison(&gpu, &staged);
        let (splits, placements) = (storage(&gpu, &rows(&sources)), storage(&gpu, &rows(&places)));
        let count = gpu.uniform("count", &[33, axes, 0, 0]);
        // The sources have steps; their halves must have none.
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
            check_split(&before, &children, axes as usize, [source, place].map(|i| i as usize));
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
            assert_eq!(untouched, expected, "Gaussian {index} must not change");
        }
    }
}

fn check_split(before: &Gaussians64, after: &Gaussians64, axes: usize, [source, place]: [usize; 2]) {
    let opacity = |logit: f64| 1.0 / (1.0 + (-logit).exp());
    let close = |what: &str, a: f64, b: f64| {
        // 1e-5: powers and logarithms of numbers near 1.
        assert!(
            (a - b).abs() < 1e-5 * (1.0 + b.abs()),
            "{what} of the halves of {source}: {a}, expected {b}"
        );
    };
    let axis = (0..axes)
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
        assert_eq!(after.quats[child], before.quats[source], "rotation of the halves of {source}");
    }
}

/// Two standard normal numbers from 64 bits, as in `shared/random.wgsl`.
fn normal_pair(a: u32, b: u32) -> [f64; 2] {
    let open = |bits: u32| (f64::from(bits >> 8) + 1.0) / 16_777_216.0;
    let (radius, turn) = ((-2.0 * open(a).ln()).sqrt(), std::f64::consts::TAU * open(b));
    [radius * turn.cos(), radius * turn.sin()]
}

#[test]
fn clones_are_copies_and_classic_halves_are_drawn_from_parents() {
    let Some(gpu) = device() else { return };
    let (seed, iteration) = (77, 1234);
    for degree in [0, 3] {
        let model = samples::random(143, 100, degree);
        let mut blocks = block_of(&gpu, &model, 140);
        blocks.set_trainable_total(&gpu, 140);
        // Parents 0, 2, 4, ...; every other one is split. Children are appended and staged in another order.
        let parents: Vec<u32> = (0..40).map(|i| 2 * i).collect();
        let rows: Vec<[u32; 4]> =
            parents.iter().map(|&at| [at, 39 - at / 2, u32::from(at % 4 == 0), 0]).collect();
        let places: Vec<[u32; 2]> = (0..40).map(|i| [100 + i, 39 - i]).collect();
        let (_, block, _) = blocks.trainable().next().unwrap();
        for &parent in &parents {
            gpu.write(&block.transforms, u64::from(parent) * 48 + 44, &[7_u32]);
        }
        let before = Gaussians64::from(&blocks.download(&gpu).unwrap());
        let row = u64::from(3 + fathom_core::gpu::sh_stride(degree)) * 16;
        let staged = gpu.buffer("staged", 40 * row).unwrap();
        poison(&gpu, &staged);
        let (children, placements) = (storage(&gpu, &rows), storage(&gpu, &places));
        let divide = gpu.uniform("divide", &[40_u32, seed, iteration, 0]);
        let place = gpu.uniform("place", &[40_u32, 0, 0, 0]);
        let shared = [
            ("block", &block.uniform),
            ("transforms", &block.transforms),
            ("sh_coeffs", &block.sh_coeffs),
            ("staged", &staged),
        ];
        let mut recorder = Recorder::new(&gpu);
        let own = [("divide", &divide), ("children", &children)];
        recorder.dispatch("densify_classic", Size::Items(40, 64), &[&shared[..], &own].concat()).unwrap();
        let own = [("place", &place), ("placements", &placements)];
        recorder.dispatch("densify_place", Size::Items(40, 64), &[&shared[..], &own].concat()).unwrap();
        recorder.submit();
        let after = Gaussians64::from(&blocks.download(&gpu).unwrap());
        let steps = |at: usize| gpu.read::<u32>(&block.transforms, at as u64 * 48 + 44, 1).unwrap()[0];
        let k = model.coeffs();
        for (n, &parent) in parents.iter().enumerate() {
            let (parent, child) = (parent as usize, 100 + n);
            let split = parent % 4 == 0;
            assert_eq!((steps(parent), steps(child)), (if split { 0 } else { 7 }, 0), "steps of {parent}");
            let bits = random_bits(seed, Stream::Split, parent as u32, iteration);
            let bits2 = random_bits(seed, Stream::Split, parent as u32, !iteration);
            let [p, q, r] = [[bits[0], bits[1]], [bits[2], bits2[0]], [bits2[1], bits2[2]]]
                .map(|[a, b]| normal_pair(a, b));
            let [w, x, y, z] = before.quats[parent];
            let turn = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w).normalize());
            for (at, normal) in [(parent, [p[0], p[1], q[0]]), (child, [q[1], r[0], r[1]])] {
                assert_eq!(after.quats[at], before.quats[parent]);
                assert_eq!(after.opacity_logits[at], before.opacity_logits[parent]);
                assert_eq!(
                    after.sh_coeffs[at * k..(at + 1) * k],
                    before.sh_coeffs[parent * k..(parent + 1) * k]
                );
                if !split {
                    assert_eq!(after.means[at], before.means[parent], "a clone must keep its place");
                    assert_eq!(after.log_scales[at], before.log_scales[parent]);
                    continue;
                }
                let scales = glam::DVec3::from(before.log_scales[parent].map(f64::exp));
                let mean =
                    glam::DVec3::from(before.means[parent]) + turn * (scales * glam::DVec3::from(normal));
                let difference = (mean - glam::DVec3::from(after.means[at])).length();
                // WGSL promises a cosine to 2^-11, and a normal number is at most 6 times one. Mesa's CPU
                // driver rounds as f32 does.
                let is_mesa = gpu.adapter().name.contains("llvmpipe");
                let of_deviation = if is_mesa { 1e-5 } else { 6.0 / 2048.0 };
                let tolerance = of_deviation * scales.max_element() + 1e-6;
                assert!(difference < tolerance, "centre of {at}, a half of {parent}: {difference:e} off");
                for (found, was) in after.log_scales[at].iter().zip(before.log_scales[parent]) {
                    assert!((found - was + 1.6_f64.ln()).abs() < 1e-6, "scale of {at}");
                }
            }
        }
        for index in (0..100).filter(|i| i % 2 == 1 || *i >= 80) {
            assert_eq!(after.means[index], before.means[index], "Gaussian {index} must not change");
        }
    }
}

#[test]
fn rows_move_whole_and_between_blocks() {
    let Some(gpu) = device() else { return };
    for words in [4_u32, 12, 48] {
        let content = |salt: u32| (0..50 * words).map(|i| i * 7 + salt).collect::<Vec<u32>>();
        let (from, to) = (content(1), content(1_000_000));
        let (source, target) = (storage(&gpu, &from), storage(&gpu, &to));
        let staged = storage(&gpu, &vec![0_u32; (3 * words) as usize]);
        let (taken, put) = ([[40_u32, 2], [7, 0], [49, 1]], [[0_u32, 3], [1, 0], [2, 11]]);
        let size = gpu.uniform("size", &[3, words, 0, 0]);
        let mut recorder = Recorder::new(&gpu);
        for (moves, from, to) in [(&taken, &source, &staged), (&put, &staged, &target)] {
            let moves = storage(&gpu, moves);
            let buffers = [("size", &size), ("moves", &moves), ("rows_in", from), ("rows_out", to)];
            recorder.dispatch("densify_move", Size::Items(3 * words, 64), &buffers).unwrap();
        }
        recorder.submit();
        let w = words as usize;
        let mut expected = to;
        for (source, target) in [(7, 3), (49, 0), (40, 11)] {
            expected[target * w..(target + 1) * w].copy_from_slice(&from[source * w..(source + 1) * w]);
        }
        let found: Vec<u32> = gpu.read(&target, 0, expected.len()).unwrap();
        assert_same_bits(&format!("rows of {words} words"), &found, &expected);
        assert_same_bits("the source", &gpu.read::<u32>(&source, 0, from.len()).unwrap(), &from);
    }
}

#[test]
fn a_reset_lowers_opacities_and_forgets_their_moments_alone() {
    let Some(gpu) = device() else { return };
    for (moments, row, words) in [(Moments::Compact, 16_u32, [3, 3]), (Moments::F32, 24, [3, 15])] {
        let model = samples::random(144, 90, 1);
        let mut blocks = Blocks::new(&gpu, 1).unwrap();
        blocks.push_trainable(&gpu, &model, 100, moments).unwrap();
        let (_, block, training) = blocks.trainable().next().unwrap();
        let kept: Vec<u32> = (0..100 * row).map(|i| i + 1).collect();
        gpu.write(&training.moments, 0, &kept);
        let reset = gpu.uniform("reset", &[row, words[0], words[1], 0]);
        let mut recorder = Recorder::new(&gpu);
        let buffers = [
            ("block", &block.uniform),
            ("reset", &reset),
            ("transforms", &block.transforms),
            ("moments", &training.moments),
        ];
        recorder.dispatch("densify_reset", Size::Items(90, 64), &buffers).unwrap();
        recorder.submit();
        let after = blocks.download(&gpu).unwrap();
        let most = (0.01_f32 / 0.99).ln();
        let mut lowered = 0;
        for (found, was) in after.opacity_logits.iter().zip(&model.opacity_logits) {
            assert!((found - was.min(most)).abs() < 1e-6, "{found} of {was}");
            lowered += usize::from(*was > most);
        }
        assert!(lowered > 45, "{lowered} were lowered");
        assert_same_bits("centres", &after.means, &model.means);
        let expected: Vec<u32> = (0..100 * row)
            .map(|i| if i / row < 90 && words.contains(&(i % row)) { 0 } else { i + 1 })
            .collect();
        assert_same_bits(
            &format!("{moments:?}"),
            &gpu.read::<u32>(&training.moments, 0, kept.len()).unwrap(),
            &expected,
        );
    }
}

#[test]
fn the_finest_view_that_sees_a_gaussian_sets_its_smoothing() {
    let Some(gpu) = device() else { return };
    let model = samples::random(145, 300, 0);
    let blocks = block_of(&gpu, &model, 300);
    let (_, block, training) = blocks.trainable().next().unwrap();
    gpu.write(&training.density_sums, 0, &[[1.0_f32, 2.0, 3.0, 4.0]; 300]);
    // Long and short lenses; one camera is among the Gaussians.
    let mut views: Vec<_> = [3.0, 2.0, 0.2].map(|away| samples::off_centre_view(75, 53, away)).to_vec();
    views[1].0.fx *= 3.0;
    let mut rows: Vec<[f32; 4]> = Vec::new();
    for (camera, pose) in &views {
        let turn = glam::DMat3::from_quat(pose.rotation);
        rows.extend((0..3).map(|i| turn.row(i).extend(pose.translation[i]).as_vec4().to_array()));
        rows.push([camera.fx, camera.fy, camera.cx, camera.cy].map(|v| v as f32));
        rows.push([75.0, 53.0, 0.0, 0.0]);
    }
    let listed = storage(&gpu, &rows);
    let buffers = [
        ("block", &block.uniform),
        ("transforms", &block.transforms),
        ("views", &listed),
        ("density_sums", &training.density_sums),
    ];
    let mut recorder = Recorder::new(&gpu);
    recorder.dispatch("smoothing", Size::Items(300, 64), &buffers).unwrap();
    recorder.submit();
    let found: Vec<[f32; 4]> = gpu.read(&training.density_sums, 0, 300).unwrap();
    let mut by_views = [0; 4];
    for (index, row) in found.iter().enumerate() {
        assert_eq!([row[0], row[1], row[3]], [1.0, 2.0, 4.0], "the rest of row {index}");
        let rates = views.iter().filter_map(|(camera, pose)| {
            let m = pose.transform(model.means[index].map(f64::from).into());
            let x = (camera.fx * m.x / m.z + camera.cx) / 75.0;
            let y = (camera.fy * m.y / m.z + camera.cy) / 53.0;
            let inside = |share: f64| share > -0.15 && share < 1.15;
            (m.z > 0.01 && inside(x) && inside(y)).then_some(camera.fx.max(camera.fy) / m.z)
        });
        let rates: Vec<f64> = rates.collect();
        by_views[rates.len()] += 1;
        let expected = rates.iter().copied().reduce(f64::max).map_or(0.0, |rate| 0.2_f64.sqrt() / rate);
        // 1e-5: the depth is a sum of numbers near 3, and about 0.1 where the error matters most.
        let difference = (f64::from(row[2]) - expected).abs();
        assert!(difference <= 1e-5 * expected.max(0.01), "smoothing of {index}: {} and {expected}", row[2]);
    }
    assert!(by_views[1..].iter().all(|&count| count > 0), "Gaussians by number of views: {by_views:?}");
}
