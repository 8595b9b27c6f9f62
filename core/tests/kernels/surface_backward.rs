//! Gradients of a scene that is seen through a water surface, the step of its plane, and what keeps its three
//! frames together.

use std::sync::Arc;

use fathom_core::gpu::{
    Frame, Gpu, MaskLossUniform, Recorder, Size, StepUniform, SurfaceRays as Kind, SurfaceStepUniform,
    counter,
};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::surface::{SetGradients, record_agreement};
use fathom_core::train::{
    BackwardBuffers, DiskBuffers, TracedBuffers, record_backward, record_backward_in_bands,
};
use fathom_twins::{
    DiskRasterGradients, Gaussians64, PictureGradients, Pictures, PlaneState, RasterGradients, RasterRules,
    RayGradient, RayGradients, compose_backward, mask_loss, plane_gradients, project_seen,
    project_seen_backward, trace_backward_along,
};
use glam::DVec3;

use crate::device::{assert_same_bits, device, layouts, poison, storage};
use crate::disks::{assert_parameters, from_numbers, numbers, sums};
use crate::surface::{Pool, Seen, Traced, sets};
use crate::view::{View, gradients_only};

/// Gradients of the picture at random, zero where a pixel of either set is not decided.
fn weights(seen: &Seen, of: [&Traced; 2]) -> Vec<[f32; 4]> {
    let pixel = |i: usize| {
        let u = |c| 2.0 * uniform_at(611, Stream::Test, i as u32, c) - 1.0;
        if of.iter().all(|set| set.decided[i]) { [u(0), u(1), u(2), u(3)] } else { [0.0; 4] }
    };
    (0..seen.pixels()).map(pixel).collect()
}

/// The gradients of the three pictures, by the twin, from the pictures of the kernels.
fn twin_of_pictures(seen: &Seen, v: &[[f32; 4]]) -> PictureGradients {
    let [straight, reflected, refracted] = &seen.pictures();
    let of = Pictures { straight, reflected: &reflected.raster, refracted: &refracted.raster };
    let v: Vec<[f64; 3]> = v.iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect();
    compose_backward(&seen.pool.water, &seen.rays(), of, &v)
}

/// Runs the backward pass of the composition.
fn through_the_surface(seen: &Seen, v: &[[f32; 4]]) {
    let gpu = seen.gpu();
    let v_image = storage(gpu, v);
    let v_mask = storage(gpu, &vec![f32::NAN; v.len()]);
    for TracedBuffers { v_pixels, v_rays } in seen.device.traced() {
        poison(gpu, v_pixels);
        poison(gpu, v_rays.unwrap());
    }
    let mut recorder = Recorder::new(gpu);
    let of = SetGradients { v_image: &v_image, v_mask: &v_mask };
    seen.device.record_backward(&mut recorder, seen.frames(), v.len() as u32, of).unwrap();
    recorder.submit();
}

/// Buffers that the backward pass of a set at the surface needs.
struct Buffers {
    unused: wgpu::Buffer,
    slots: wgpu::Buffer,
    step: wgpu::Buffer,
}

impl Buffers {
    fn new(view: &View, step: &StepUniform) -> Self {
        let gpu = &view.gpu;
        let slots = gpu.buffer("slots", 80 * (view.counter(counter::INTERSECTIONS) as u64).max(1)).unwrap();
        poison(gpu, &slots);
        Self { unused: storage(gpu, &[f32::NAN; 4]), slots, step: gpu.uniform("step", step) }
    }

    fn of<'a>(&'a self, traced: TracedBuffers<'a>) -> BackwardBuffers<'a> {
        BackwardBuffers {
            v_image: &self.unused,
            v_range: &self.unused,
            slot_gradients: &self.slots,
            disks: None,
            traced: Some(traced),
            step: &self.step,
            appearances: &[],
        }
    }
}

/// Runs the backward pass of a set, and returns the gradients of its slots.
fn backward(seen: &Seen, set: usize) -> Vec<[f32; 20]> {
    let (view, gpu) = (&seen.views[set], seen.gpu());
    let buffers = Buffers::new(view, &gradients_only());
    let mut recorder = Recorder::new(gpu);
    let of = buffers.of(seen.device.traced()[set - 1]);
    record_backward(gpu, &mut recorder, &view.frame, &view.blocks, &view.uniform, of).unwrap();
    recorder.submit();
    gpu.read(&buffers.slots, 0, view.counter(counter::INTERSECTIONS)).unwrap()
}

/// The gradients of the rays of a set as the kernel wrote them.
fn rays_of(seen: &Seen, set: usize) -> Vec<RayGradient> {
    let rows: Vec<[[f32; 4]; 2]> =
        seen.gpu().read(seen.device.traced()[set - 1].v_rays.unwrap(), 0, seen.pixels()).unwrap();
    let vector = |v: &[f32; 4]| DVec3::new(v[0].into(), v[1].into(), v[2].into());
    rows.iter().map(|row| RayGradient { origin: vector(&row[0]), direction: vector(&row[1]) }).collect()
}

/// Asserts that two numbers agree; `size` is that of what they are made of.
#[track_caller]
fn close(what: &str, kernel: f64, twin: f64, tolerance: f64) {
    assert!(
        (kernel - twin).abs() <= tolerance,
        "{what}: kernel {kernel:e}, twin {twin:e}, tolerance {tolerance:e}"
    );
}

#[test]
fn gradients_of_the_composition_match_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(612, 200, 1));
            let pixels = seen.pixels();
            let v: Vec<[f32; 4]> = (0..pixels as u32)
                .map(|i| std::array::from_fn(|c| 2.0 * uniform_at(613, Stream::Test, i, c as u32) - 1.0))
                .collect();
            let v_image = storage(&gpu, &v);
            let [reflected, refracted] = [(); 2].map(|()| storage(&gpu, &vec![[f32::NAN; 4]; pixels]));
            let [mask, share] = [(); 2].map(|()| storage(&gpu, &vec![f32::NAN; pixels]));
            let targets = seen.views.each_ref().map(|view| view.frame.targets().unwrap());
            let mut recorder = Recorder::new(&gpu);
            let bound = [
                ("frame", &seen.views[0].frame.uniform),
                ("surface", seen.device.plane()),
                ("image", &targets[0].image),
                ("normal_image", targets[0].normal_image.as_ref().unwrap()),
                ("reflected", &targets[1].image),
                ("refracted", &targets[2].image),
                ("refracted_rays", targets[2].rays.as_ref().unwrap()),
                ("v_image", &v_image),
                ("v_mask_image", &mask),
                ("v_reflected", &reflected),
                ("v_refracted", &refracted),
                ("v_fresnel", &share),
            ];
            let size = Size::Items(pixels as u32, 64);
            recorder.dispatch("surface_compose_backward", size, &bound).unwrap();
            recorder.submit();
            let [straight, reflected, refracted] = [&v_image, &reflected, &refracted]
                .map(|buffer| -> Vec<[f32; 4]> { gpu.read(buffer, 0, pixels).unwrap() });
            let [mask, share] =
                [&mask, &share].map(|buffer| -> Vec<f32> { gpu.read(buffer, 0, pixels).unwrap() });
            let (twin, rays, pictures) = (twin_of_pictures(&seen, &v), seen.rays(), seen.pictures());
            for i in 0..pixels {
                if !rays.is_hit(i) {
                    assert_eq!(straight[i], v[i]);
                    let others = [mask[i], share[i]].into_iter().chain(reflected[i]).chain(refracted[i]);
                    assert!(others.into_iter().all(|v| v == 0.0), "{}: pixel {i}", pool.name);
                    continue;
                }
                let what = format!("{}: pixel {i}", pool.name);
                // Slopes of the sRGB curve are up to 12.92.
                for c in 0..3 {
                    close(&what, straight[i][c].into(), twin.straight[i][c], 1e-6);
                    close(&what, reflected[i][c].into(), twin.reflected[i][c], 3e-5);
                    close(&what, refracted[i][c].into(), twin.refracted[i][c], 3e-5);
                }
                close(&what, straight[i][3].into(), twin.alpha[i], 1e-5);
                close(&what, mask[i].into(), twin.mask[i], 1e-5);
                close(&what, share[i].into(), twin.share[i], 3e-5);
                for (kernel, v, set) in [(&reflected, &twin.reflected, 1), (&refracted, &twin.refracted, 2)] {
                    let rem = (0..3).map(|c| v[i][c] * pictures[set].raster.rgb[i][c]).sum();
                    close(&what, kernel[i][3].into(), rem, 1e-4);
                }
            }
        }
    }
}

#[test]
fn gradients_of_traced_disks_and_rays_match_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(614, 200, 0));
            let traced = [seen.traced(1), seen.traced(2)];
            through_the_surface(&seen, &weights(&seen, traced.each_ref()));
            for (set, of) in [(1, &traced[0]), (2, &traced[1])] {
                let pixels = seen.pixels();
                let v_pixels: Vec<[f32; 4]> =
                    gpu.read(seen.device.traced()[set - 1].v_pixels, 0, pixels).unwrap();
                let v = DiskRasterGradients {
                    raster: RasterGradients {
                        rgb: v_pixels.iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect(),
                        alpha: vec![0.0; pixels],
                        range: vec![0.0; pixels],
                    },
                    normal: vec![[0.0; 3]; pixels],
                    mask: vec![0.0; pixels],
                };
                let view = &seen.views[set];
                let Traced { disks, lists, rays, twin, .. } = of;
                let (camera, background) = (&pool.camera, view.scene.background64());
                let rules = RasterRules::HARD;
                let (v_disks, v_rays) =
                    trace_backward_along(disks, lists, rays, camera, twin, background, &rules, &v);
                let kernel = sums(view, &backward(&seen, set));
                let mut shown = 0;
                for (id, (expected, (kernel, sizes))) in v_disks.iter().zip(&kernel).enumerate() {
                    shown += usize::from(expected.contribution > 0.01);
                    for (n, expected) in numbers(expected).into_iter().enumerate() {
                        let tolerance = 2e-3 * (sizes[n].max(expected.abs()) + 1.0);
                        let what = format!("{}, set {set}: number {n} of disk {id}", pool.name);
                        close(&what, kernel[n], expected, tolerance);
                    }
                }
                assert!(shown > 20, "{}, set {set}: {shown} disks are seen", pool.name);
                let mut steered = 0;
                for (i, (kernel, twin)) in rays_of(&seen, set).iter().zip(&v_rays).enumerate() {
                    steered += usize::from(twin.origin.length() > 1e-3);
                    let what = format!("{}, set {set}: ray of pixel {i}", pool.name);
                    for c in 0..3 {
                        // Disks of opposite slope cancel.
                        close(&what, kernel.origin[c], twin.origin[c], 2e-3 * (twin.origin.length() + 1.0));
                        let size = twin.direction.length() + 3.0;
                        close(&what, kernel.direction[c], twin.direction[c], 2e-3 * size);
                    }
                }
                assert!(steered > 200, "{}, set {set}: {steered} rays have gradients", pool.name);
            }
        }
    }
}

#[test]
fn parameters_at_the_surface_get_the_gradients_of_the_twin() {
    let Some(gpu) = device() else { return };
    for pool in Pool::all() {
        let seen = Seen::new(&gpu, &pool, sets(615, 200, 3));
        let traced = [seen.traced(1), seen.traced(2)];
        through_the_surface(&seen, &weights(&seen, traced.each_ref()));
        for set in [1, 2] {
            let view = &seen.views[set];
            let slots = sums(view, &backward(&seen, set));
            let v_disks: Vec<_> = slots.iter().map(|(sums, _)| from_numbers(*sums)).collect();
            let (model, sight) = (Gaussians64::from(&view.scene.model), &pool.sights()[set]);
            let mut disks = project_seen(&model, &pool.camera, sight, 3, &RasterRules::HARD);
            // Rounding turns the line of sight to a disk that nearly touches the surface.
            let depth = |id: usize| pool.water.plane.height(DVec3::from_array(model.means[id])).abs();
            (0..disks.len()).filter(|&id| depth(id) < 0.005).for_each(|id| disks[id] = None);
            let twin = project_seen_backward(&model, &pool.camera, sight, 3, &disks, &v_disks);
            let name = format!("{}, set {set}", pool.name);
            let shown = assert_parameters(&name, &view.parameter_gradients(), &twin, &disks, &v_disks);
            assert!(shown > 20, "{name}: {shown} disks are seen");
        }
    }
}

#[test]
fn gradients_at_the_surface_are_the_same_in_bands() {
    for gpu in layouts() {
        let pool = &Pool::all()[0];
        let seen = Seen::new(&gpu, pool, sets(616, 150, 1));
        let traced = [seen.traced(1), seen.traced(2)];
        through_the_surface(&seen, &weights(&seen, traced.each_ref()));
        for set in [1, 2] {
            backward(&seen, set);
            let view = &seen.views[set];
            let (whole, rays) = (view.parameter_gradients(), rays_of(&seen, set));
            let of = seen.device.traced()[set - 1];
            poison(&gpu, of.v_rays.unwrap());
            let (frame, blocks, uniform) = (&view.frame, &view.blocks, &view.uniform);
            let buffers = Buffers::new(view, &gradients_only());
            let mut recorder = Recorder::new(&gpu);
            let bands = uniform.bands(3, gpu.tile());
            assert_eq!(bands.len(), 3);
            record_backward_in_bands(&gpu, &mut recorder, frame, blocks, uniform, &bands, buffers.of(of))
                .unwrap();
            recorder.submit();
            assert_eq!(view.parameter_gradients(), whole, "set {set}");
            assert_eq!(rays_of(&seen, set), rays, "set {set}");
        }
    }
}

/// Sums of `surface_gradients`.
fn partials(seen: &Seen) -> Vec<[f32; 4]> {
    seen.gpu().read(seen.device.partials(), 0, seen.pixels().div_ceil(64)).unwrap()
}

fn record_step(seen: &Seen, step: u32, rates: [f32; 2]) {
    let unbias = |beta: f64| (1.0 / (1.0 - beta.powf(f64::from(step)))) as f32;
    let uniform = SurfaceStepUniform {
        tilt_rate: rates[0],
        offset_rate: rates[1],
        unbias1: unbias(0.9),
        unbias2: unbias(0.999),
        pivot: seen.pool.pivot(),
        ..SurfaceStepUniform::default()
    };
    let gpu = seen.gpu();
    let mut recorder = Recorder::new(gpu);
    seen.device.record_step(gpu, &mut recorder, seen.frames(), seen.pixels() as u32, uniform).unwrap();
    recorder.submit();
}

#[test]
fn gradients_and_steps_of_the_plane_match_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(617, 200, 0));
            let traced = [seen.traced(1), seen.traced(2)];
            let v = weights(&seen, traced.each_ref());
            through_the_surface(&seen, &v);
            backward(&seen, 1);
            backward(&seen, 2);
            let pivot = DVec3::from_array(pool.pivot().map(f64::from));
            let (reflected, refracted) = (rays_of(&seen, 1), rays_of(&seen, 2));
            let share = twin_of_pictures(&seen, &v).share;
            let of = RayGradients { reflected: &reflected, refracted: &refracted, share: &share };
            let twin = plane_gradients(&pool.water, &pool.camera, &pool.pose, &seen.rays(), of, pivot);

            let rates = [0.01, 0.02];
            let (mut plane, mut state) = (pool.water.plane, PlaneState::default());
            poison(&gpu, seen.device.partials());
            for step in 1..=2 {
                record_step(&seen, step, rates);
                let kernel = partials(&seen);
                if step == 1 {
                    for (group, (kernel, twin)) in kernel.iter().zip(twin.chunks(64)).enumerate() {
                        for c in 0..4 {
                            let size: f64 = twin.iter().map(|v| v[c].abs()).sum();
                            let what = format!("{}: number {c} of group {group}", pool.name);
                            let sum = twin.iter().map(|v| v[c]).sum();
                            close(&what, kernel[c].into(), sum, 1e-4 * (size + 1.0));
                        }
                    }
                    assert!(twin.iter().map(|v| v[3].abs()).sum::<f64>() > 10.0);
                }
                let total =
                    kernel.iter().fold([0.0; 4], |sum, v| std::array::from_fn(|c| sum[c] + f64::from(v[c])));
                state.step(&mut plane, total, rates.map(f64::from), pivot);
                let found = seen.device.read(&gpu).unwrap();
                for c in 0..3 {
                    close("normal", found.normal[c].into(), plane.normal[c], 2e-6);
                }
                close("offset", found.offset.into(), plane.offset, 2e-6);
            }
            assert_eq!(seen.device.steps_left_out(&gpu).unwrap(), 0);
        }
    }
}

#[test]
fn a_spoilt_gradient_or_a_short_list_moves_no_plane() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[0];
    let seen = Seen::new(&gpu, pool, sets(618, 60, 0));
    let traced = [seen.traced(1), seen.traced(2)];
    through_the_surface(&seen, &weights(&seen, traced.each_ref()));
    backward(&seen, 1);
    backward(&seen, 2);
    let before = seen.device.read(&gpu).unwrap();
    let overflow = u64::from(counter::OVERFLOW) * 4;
    gpu.write(&seen.views[0].frame.counters, overflow, &[1_u32]);
    record_step(&seen, 1, [0.01; 2]);
    assert_eq!(seen.device.read(&gpu).unwrap(), before);
    gpu.write(&seen.views[0].frame.counters, overflow, &[0_u32]);
    let hit = (0..seen.pixels()).find(|&i| seen.rays().is_hit(i)).unwrap();
    gpu.write(seen.device.traced()[1].v_rays.unwrap(), 32 * hit as u64, &[f32::NAN; 8]);
    record_step(&seen, 1, [0.01; 2]);
    assert_eq!(seen.device.read(&gpu).unwrap(), before);
    assert_eq!(seen.device.steps_left_out(&gpu).unwrap(), 1);
    gpu.write(seen.device.traced()[1].v_rays.unwrap(), 32 * hit as u64, &[0.0_f32; 8]);
    record_step(&seen, 1, [0.01; 2]);
    assert_ne!(seen.device.read(&gpu).unwrap(), before);
}

#[test]
fn the_loss_of_the_masks_matches_the_twin() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[1];
    let seen = Seen::new(&gpu, pool, sets(619, 200, 0));
    let (pixels, columns) = (seen.pixels(), pool.camera.width as usize);
    let (cells, first) = ([19_usize, 14_usize], 7);
    let words: Vec<u32> = (0..40).map(|i| (uniform_at(619, Stream::Test, i, 0) * 4.0e9) as u32).collect();
    let before: Vec<f32> = (0..pixels).map(|i| uniform_at(620, Stream::Test, i as u32, 0)).collect();
    let (bits, v_mask) = (storage(&gpu, &words), storage(&gpu, &before));
    let weight = 0.05;
    let mask_loss_of =
        MaskLossUniform { cells: cells.map(|n| n as u32), first, weight: 2.0 * weight / pixels as f32 };
    let mut recorder = Recorder::new(&gpu);
    let straight = &seen.views[0].frame;
    seen.device
        .record_mask_loss(&gpu, &mut recorder, straight, pixels as u32, &bits, mask_loss_of, &v_mask)
        .unwrap();
    recorder.submit();
    let kernel: Vec<f32> = gpu.read(&v_mask, 0, pixels).unwrap();
    let is_water = |i: usize| {
        let rows = pool.camera.height as usize;
        let cell = (i / columns * cells[1] / rows) * cells[0] + i % columns * cells[0] / columns;
        words[first as usize + cell / 32] >> (cell % 32) & 1 == 1
    };
    let (_, twin) = mask_loss(&seen.masks(), is_water, weight.into());
    for i in 0..pixels {
        close(&format!("pixel {i}"), kernel[i].into(), f64::from(before[i]) + twin[i], 1e-7);
    }
}

#[test]
fn a_mask_reset_blackens_disks_below_the_surface_only() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[0];
    let seen = Seen::new(&gpu, pool, sets(621, 150, 1));
    let blocks = &seen.views[0].blocks;
    let before = blocks.download(&gpu).unwrap();
    let mut recorder = Recorder::new(&gpu);
    seen.device.record_reset(&mut recorder, blocks).unwrap();
    recorder.submit();
    let after = blocks.download(&gpu).unwrap();
    let (mut expected, mut below) = (before.clone(), 0);
    for i in 0..before.len() {
        let height = pool.water.plane.height(DVec3::from_array(before.means[i].map(f64::from)));
        if height < 0.0 {
            below += 1;
            expected.log_scales[i][2] = before.log_scales[i][2].min(-2.2);
            // Coefficient 0 times its basis function is -1/2.
            expected.sh_coeffs[4 * i] = [-0.5 / 0.282_094_8; 3];
        }
    }
    assert!(below > 30 && below < 120, "{below} disks below the surface");
    let rounded = |v: &[f32; 3]| v.map(|v| (1e5 * v).round());
    assert_eq!(after.means, before.means);
    assert_eq!(after.log_scales, expected.log_scales);
    for (i, (after, expected)) in after.sh_coeffs.iter().zip(&expected.sh_coeffs).enumerate() {
        assert_eq!(rounded(after), rounded(expected), "coefficient {} of disk {}", i % 4, i / 4);
    }
}

#[test]
fn density_control_of_a_set_counts_what_its_rays_see() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[0];
    let seen = Seen::new(&gpu, pool, sets(623, 100, 0));
    let view = &seen.views[0];
    let (_, block, training) = view.blocks.trainable().next().unwrap();
    let (model, stats) = (&view.scene.model, gpu.buffer("statistics", 1600).unwrap());
    let sigmoid = |logit: f32| 1.0 / (1.0 + (-f64::from(logit)).exp());
    let height = |i: usize| pool.water.plane.height(DVec3::from_array(model.means[i].map(f64::from)));
    for kernel in
        ["density_stats_disks", "density_stats_masked", "density_stats_above", "density_stats_below"]
    {
        poison(&gpu, &stats);
        gpu.write(&training.density_sums, 0, &[[6.0_f32, 4.0, 0.0, 2.0]; 100]);
        let mut bound = vec![
            ("block", &block.uniform),
            ("transforms", &block.transforms),
            ("density_sums", &training.density_sums),
            ("stats", &stats),
        ];
        if kernel.ends_with("above") || kernel.ends_with("below") {
            bound.push(("surface", seen.device.plane()));
        }
        let mut recorder = Recorder::new(&gpu);
        recorder.dispatch(kernel, Size::Items(100, 64), &bound).unwrap();
        recorder.submit();
        let found: Vec<[f32; 4]> = gpu.read(&stats, 0, 100).unwrap();
        for (i, found) in found.iter().enumerate() {
            let share = match kernel {
                "density_stats_masked" => sigmoid(model.log_scales[i][2]),
                "density_stats_above" => f64::from(height(i) > 0.0),
                "density_stats_below" => f64::from(height(i) < 0.0),
                _ => 1.0,
            };
            close(kernel, found[0].into(), share * sigmoid(model.opacity_logits[i]), 1e-6);
            // Masked disks need no detail.
            let weight = if kernel.ends_with("masked") { share } else { 1.0 };
            close(kernel, found[1].into(), 1.5 * weight, 1e-6);
            close(kernel, found[2].into(), 0.5 * weight, 1e-6);
            let scale = f64::from(model.log_scales[i][0].max(model.log_scales[i][1])).exp();
            close(kernel, found[3].into(), scale, 1e-6 * scale);
        }
    }
}

/// Parameters and moments, bit for bit.
fn bits(view: &View) -> Vec<u32> {
    let (_, block, training) = view.blocks.trainable().next().unwrap();
    let read = |buffer: &wgpu::Buffer| -> Vec<u32> {
        view.gpu.read(buffer, 0, (buffer.size() / 4) as usize).unwrap()
    };
    [read(&block.transforms), read(&block.sh_coeffs), read(&training.moments)].concat()
}

fn step(view: &View) -> StepUniform {
    StepUniform {
        means_lr: 0.01,
        quats_lr: 0.01,
        scales_lr: 0.01,
        opacity_lr: 0.01,
        sh_dc_lr: 0.01,
        mask_lr: 0.01,
        trainable: view.blocks.total(),
        ..StepUniform::default()
    }
}

/// A step of each set, where the frames agree that there is one.
fn step_all(gpu: &Arc<Gpu>, seen: &Seen) {
    let pixels = seen.pixels();
    let ones = storage(gpu, &vec![1.0_f32; 8 * pixels]);
    for (set, view) in seen.views.iter().enumerate() {
        let mut recorder = Recorder::new(gpu);
        let buffers = Buffers::new(view, &step(view));
        let v_pixels = gpu.buffer("pixel gradients", 32 * pixels as u64).unwrap();
        let of = if set == 0 {
            let disks = Some(DiskBuffers { v_normal: &ones, v_pixels: &v_pixels, v_mask: &ones });
            let unused = buffers.of(seen.device.traced()[0]);
            BackwardBuffers { v_image: &ones, v_range: &ones, disks, traced: None, ..unused }
        } else {
            buffers.of(TracedBuffers { v_pixels: &ones, v_rays: seen.device.traced()[set - 1].v_rays })
        };
        record_backward(gpu, &mut recorder, &view.frame, &view.blocks, &view.uniform, of).unwrap();
        recorder.submit();
    }
}

#[test]
fn if_one_frame_is_too_short_no_set_takes_a_step() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[0];
    for short in [None, Some(0), Some(1), Some(2)] {
        let mut seen = Seen::new(&gpu, pool, sets(622, 60, 0));
        if let Some(set) = short {
            let surface = seen.device.plane().clone();
            let view = &mut seen.views[set];
            let mut frame = Frame::new(&gpu, view.blocks.total(), 1, 1).unwrap().of_disks(&gpu).unwrap();
            if let Some(kind) = [None, Some(Kind::Reflected), Some(Kind::Refracted)][set] {
                frame = frame.at_surface(&gpu, kind, &surface).unwrap();
            }
            frame.prepare_targets(&gpu, view.uniform.size).unwrap();
            view.frame = frame;
            let view = &seen.views[set];
            let mut recorder = Recorder::new(&gpu);
            let uniform = fathom_core::gpu::FrameUniform { iteration: 5, ..view.uniform };
            view.frame.record_forward(&gpu, &mut recorder, &view.blocks, &uniform).unwrap();
            recorder.submit();
        }
        let mut recorder = Recorder::new(&gpu);
        record_agreement(&mut recorder, seen.frames()).unwrap();
        recorder.submit();
        let overflows = seen.views.each_ref().map(|view| view.frame.overflow(&gpu).unwrap());
        assert_eq!(overflows.map(|overflow| overflow.is_some()), [short.is_some(); 3], "{short:?}");
        let before = seen.views.each_ref().map(bits);
        step_all(&gpu, &seen);
        for (set, before) in before.iter().enumerate() {
            let after = bits(&seen.views[set]);
            if short.is_some() {
                assert_same_bits(&format!("set {set}, {short:?} is short"), before, &after);
            } else {
                assert_ne!(*before, after, "set {set} takes a step");
            }
        }
    }
}
