//! 2D Gaussians: pictures, gradients of disks and gradients of parameters, against the twins.
//!
//! A pixel is decided when no disk is near a decision there. Decisions are alpha at 1/255 or at its cap, the
//! end of the ray, and which of the two terms of sigma is smaller. Kernel and twin may decide differently
//! elsewhere, so only decided pixels are compared, and only they have gradients.

use std::collections::HashSet;
use std::sync::Arc;

use fathom_core::gpu::{Gpu, Recorder, counter};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::{BackwardBuffers, DiskBuffers, DiskMaps, LEAST_ALPHA, record_backward};
use fathom_twins::{
    DISK_BLUR, Disk, DiskGradient, DiskRaster, DiskRasterGradients, DiskRay, Gaussians64, Raster,
    RasterRules, Sight, Splat, TileLists, bounds_of, depth_order, intersect, normal_consistency,
    pinhole_rays, project_disks, project_disks_backward, samples, trace_backward, trace_forward,
};
use glam::DVec3;

use crate::device::{device, layouts, poison, storage};
use crate::view::{ImageGradients, Scene, View, gradients_only};

/// What the kernels projected and rendered, beside the twin's picture of the same disks.
struct Compared {
    view: View,
    disks: Vec<Option<Disk>>,
    lists: TileLists,
    rays: Vec<DiskRay>,
    twin: DiskRaster,
    decided: Vec<bool>,
}

impl Compared {
    fn new(gpu: &Arc<Gpu>, scene: &Scene) -> Self {
        let view = View::render_disks(gpu, scene);
        let disks = projected(&view, &Sight::straight(&scene.pose));
        let (width, height) = (scene.camera.width, scene.camera.height);
        let lists = intersect(&bounds_of(&disks), width, height);
        let rays = pinhole_rays(&scene.camera);
        let rules = RasterRules::HARD;
        let twin = trace_forward(&disks, &lists, &rays, [width, height], scene.background64(), &rules);
        let decided = (0..rays.len()).map(|pixel| is_decided(&disks, &lists, &rays, width, pixel)).collect();
        Self { view, disks, lists, rays, twin, decided }
    }
}

/// The disks in the camera's frame, as the kernel wrote them, of a view that sees them by `sight`.
pub fn projected(view: &View, sight: &Sight) -> Vec<Option<Disk>> {
    let visible = view.visible();
    let of_frame = view.frame.disks.as_ref().unwrap();
    let records: Vec<[f32; 12]> = view.gpu.read(of_frame, 0, visible.len()).unwrap();
    let splats: Vec<[f32; 12]> = view.gpu.read(&view.frame.projected, 0, visible.len()).unwrap();
    let bounds = view.splats();
    let mut disks = vec![None; bounds.len()];
    for ((&id, record), splat) in visible.iter().zip(&records).zip(&splats) {
        let r = record.map(f64::from);
        let centre = DVec3::new(r[0], r[1], r[2]);
        let axes = [DVec3::new(r[4], r[5], r[6]), DVec3::new(r[8], r[9], r[10])];
        disks[id] = bounds[id].map(|bound| Disk {
            centre,
            axes,
            normal: r[11] * axes[0].cross(axes[1]),
            centre2d: [r[3], r[7]],
            mask: splat[11].into(),
            bound: Splat { depth: sight.depth(centre), ..bound },
        });
    }
    disks
}

/// Whether no disk is near a decision at a pixel.
pub fn is_decided(
    disks: &[Option<Disk>],
    lists: &TileLists,
    rays: &[DiskRay],
    width: u32,
    pixel: usize,
) -> bool {
    needed_at(disks, lists, rays, width, pixel).is_some()
}

/// The disks that the backward pass needs at a pixel: those that are blended, and the one that ends the ray.
/// `None` if a disk is near a decision.
fn needed_at(
    disks: &[Option<Disk>],
    lists: &TileLists,
    rays: &[DiskRay],
    width: u32,
    pixel: usize,
) -> Option<Vec<u32>> {
    let (x, y) = (pixel as u32 % width, pixel as u32 / width);
    let rules = RasterRules::HARD;
    let (mut left, mut needed) = (1.0, Vec::new());
    for &id in lists.of_tile(x / 16, y / 16) {
        let Some(disk) = &disks[id as usize] else { continue };
        let [a_u, a_v] = disk.axes;
        let normal = a_u.cross(a_v);
        let DiskRay { origin, direction, nearest } = rays[pixel];
        let t = normal.dot(disk.centre - origin) / normal.dot(direction);
        let p = origin + t * direction - disk.centre;
        let solid = a_u.dot(p).powi(2) + a_v.dot(p).powi(2);
        let delta = [disk.centre2d[0] - f64::from(x) - 0.5, disk.centre2d[1] - f64::from(y) - 0.5];
        let thin = (delta[0].powi(2) + delta[1].powi(2)) / DISK_BLUR;
        let is_hit = t > nearest && solid <= thin;
        let full = disk.bound.opacity * (-0.5 * if is_hit { solid } else { thin }).exp();
        let near = |value: f64, edge: f64| (value / edge - 1.0).abs() < 5e-3;
        let seen = full > 0.5 * rules.min_alpha || disk.bound.opacity * (-0.5 * solid).exp() > 1e-3;
        // Rounding moves the hit on a plane that is seen from its edge by more than the disk.
        let slant = normal.dot(direction).abs() / (normal.length() * direction.length());
        if seen
            && (near(full, rules.min_alpha)
                || near(full, rules.max_alpha)
                || near(solid, thin)
                || (t - nearest).abs() < 1e-4
                || slant < 2e-3)
        {
            return None;
        }
        let alpha = full.min(rules.max_alpha);
        if alpha < rules.min_alpha {
            continue;
        }
        let next = left * (1.0 - alpha);
        if near(next, rules.min_transmittance) {
            return None;
        }
        needed.push(id);
        if next < rules.min_transmittance {
            break;
        }
        left = next;
    }
    Some(needed)
}

/// How much more the numbers of a scene differ. Rounding of a position is about 1e-7 of the distance, and so
/// 1e-3 of the width of a thin disk.
fn looseness(scene: &Scene) -> f64 {
    if scene.name == "thin" { 5.0 } else { 1.0 }
}

/// Disks of many sizes; thin ones; larger than the picture; partly outside of it.
fn scenes(seed: u32, count: usize, sh_degree: u8) -> Vec<Scene> {
    let mut thin = samples::random(seed, count, sh_degree);
    thin.log_scales.iter_mut().for_each(|scales| *scales = [scales[0], -7.0, 0.0]);
    [
        ("random", samples::random(seed, count, sh_degree)),
        ("thin", thin),
        ("huge", samples::huge(seed, count.min(60), sh_degree)),
        ("beyond the border", samples::beyond_the_border(seed, count, sh_degree)),
    ]
    .into_iter()
    .map(|(name, model)| Scene::new(name, model, 75, 53))
    .collect()
}

#[test]
fn pictures_of_disks_match_the_twin() {
    for gpu in layouts() {
        for scene in scenes(251, 300, 1) {
            let Compared { view, twin, decided, .. } = Compared::new(&gpu, &scene);
            let (image, range) = (view.image(), view.range_image());
            let targets = view.frame.targets().unwrap();
            let normals: Vec<[f32; 4]> =
                gpu.read(targets.normal_image.as_ref().unwrap(), 0, view.pixels()).unwrap();
            let share = decided.iter().filter(|decided| **decided).count() as f64 / decided.len() as f64;
            assert!(share > 0.5, "{}: {share} of the pixels are decided", scene.name);
            let loose = looseness(&scene);
            for i in (0..decided.len()).filter(|&i| decided[i]) {
                let (pixel, normal) = (image[i].map(f64::from), normals[i].map(f64::from));
                let pairs = (0..3)
                    .map(|c| (pixel[c], twin.raster.rgb[i][c], 1e-4))
                    .chain((0..3).map(|c| (normal[c], twin.normal[i][c], 1e-4)))
                    .chain([(normal[3], twin.mask[i], 1e-4)])
                    .chain([(pixel[3], twin.raster.alpha[i], 1e-4)])
                    .chain([(f64::from(range[i]), twin.raster.range[i], 5e-4)]);
                for (n, (kernel, twin, tolerance)) in pairs.enumerate() {
                    assert!(
                        (kernel - twin).abs() <= loose * tolerance,
                        "{}: number {n} of pixel {i}: kernel {kernel}, twin {twin}",
                        scene.name
                    );
                }
            }
        }
    }
}

#[test]
fn disks_that_the_backward_pass_needs_come_first_in_order() {
    for gpu in layouts() {
        // Opacity 0.9999: two layers end a ray, and most disks are hidden.
        let mut opaque = samples::random(55, 150, 0);
        opaque.opacity_logits.fill(9.2);
        let all = scenes(251, 40, 0).into_iter().chain([Scene::new("opaque", opaque, 75, 53)]);
        let (mut compared, mut hidden) = (0, 0);
        for scene in all {
            let Compared { view, disks, lists, rays, .. } = Compared::new(&gpu, &scene);
            let name = scene.name;
            let count = view.counter(counter::INTERSECTIONS);
            let mut slots: Vec<u32> =
                gpu.read(view.frame.sorted_slots(view.uniform.tile_count()), 0, count).unwrap();
            slots.sort_unstable();
            assert!(slots.iter().copied().eq(0..count as u32), "{name}: a slot is lost, or there twice");

            let ends: Vec<u32> = gpu
                .read(&view.frame.targets().unwrap().tile_ends, 0, view.uniform.tile_count() as usize)
                .unwrap();
            let (width, height) = (scene.camera.width, scene.camera.height);
            let (tile, across) = (gpu.tile(), view.uniform.tiles[0]);
            let mut rank = vec![u32::MAX; disks.len()];
            depth_order(&bounds_of(&disks))
                .iter()
                .zip(0..)
                .for_each(|(&id, place)| rank[id as usize] = place);
            for (at, (list, &end)) in view.tile_lists().iter().zip(&ends).enumerate() {
                let kept = &list[..end as usize];
                assert!(kept.is_sorted_by_key(|&id| rank[id]), "{name}: tile {at} is out of order");
                let corner = [at as u32 % across * tile, at as u32 / across * tile];
                let pixels = (corner[1]..height.min(corner[1] + tile))
                    .flat_map(|y| (corner[0]..width.min(corner[0] + tile)).map(move |x| y * width + x));
                let needed: Vec<_> =
                    pixels.map(|pixel| needed_at(&disks, &lists, &rays, width, pixel as usize)).collect();
                let kept: HashSet<_> = kept.iter().map(|&id| id as u32).collect();
                let wanted: HashSet<_> = needed.iter().flatten().flatten().copied().collect();
                assert!(wanted.is_subset(&kept), "{name}: tile {at} keeps {kept:?}, not {wanted:?}");
                if needed.iter().all(Option::is_some) {
                    assert_eq!(kept, wanted, "{name}: tile {at} keeps a disk that no pixel needs");
                    compared += 1;
                    hidden += list.len() - kept.len();
                }
            }
        }
        assert!(compared > 20 && hidden > 40, "{compared} tiles compared, {hidden} disks not needed");
    }
}

#[test]
fn disks_are_projected_as_the_twin_does() {
    for gpu in layouts() {
        for scene in scenes(252, 300, 2) {
            let view = View::render_disks(&gpu, &scene);
            let kernel = projected(&view, &Sight::straight(&scene.pose));
            let model = Gaussians64::from(&scene.model);
            let twin = project_disks(&model, &scene.camera, &scene.pose, 2, &RasterRules::HARD);
            let mut compared = 0;
            for (id, (kernel, twin)) in kernel.iter().zip(&twin).enumerate() {
                let (Some(kernel), Some(twin)) = (kernel, twin) else {
                    // What the kernel culls beyond the border, the twin's tiles do not touch.
                    assert!(kernel.is_none(), "{}: the twin culls disk {id}", scene.name);
                    continue;
                };
                compared += 1;
                let close = |a: f64, b: f64, size: f64| (a - b).abs() <= 1e-4 * size.max(1e-3);
                let along = |a: DVec3, b: DVec3| close((a - b).length(), 0.0, b.length());
                let [width, height] = twin.bound.half_size;
                assert!(
                    along(kernel.centre, twin.centre)
                        && along(kernel.axes[0], twin.axes[0])
                        && along(kernel.axes[1], twin.axes[1])
                        && along(kernel.normal, twin.normal)
                        && close(kernel.mask, twin.mask, 1.0)
                        && close(kernel.bound.mean2d[0], twin.bound.mean2d[0], 100.0 + width)
                        && close(kernel.bound.half_size[0], twin.bound.half_size[0], 10.0 * width)
                        && close(kernel.bound.half_size[1], twin.bound.half_size[1], 10.0 * height)
                        && close(kernel.bound.opacity, twin.bound.opacity, 1.0),
                    "{}: disk {id}: {kernel:?} instead of {twin:?}",
                    scene.name
                );
            }
            assert!(compared > 40, "{}: {compared} compared", scene.name);
        }
    }
}

/// Gradients of the decided pixels, for the kernels and for the twin.
struct Weights {
    images: ImageGradients,
    normal: Vec<[f32; 4]>,
    mask: Vec<f32>,
    twin: DiskRasterGradients,
}

/// At random.
fn weights(compared: &Compared) -> Weights {
    let pixels = compared.decided.len();
    let mut images = ImageGradients::random(253, pixels);
    let u = |i, c| 2.0 * uniform_at(254, Stream::Test, i, c) - 1.0;
    let mut normal: Vec<[f32; 4]> =
        (0..pixels as u32).map(|i| std::array::from_fn(|c| u(i, c as u32))).collect();
    let mut mask: Vec<f32> = (0..pixels as u32).map(|i| u(i, 4)).collect();
    for i in (0..pixels).filter(|&i| !compared.decided[i]) {
        (images.image[i], images.range[i]) = ([0.0; 4], 0.0);
        (normal[i], mask[i]) = ([0.0; 4], 0.0);
    }
    let twin = DiskRasterGradients {
        raster: images.in_f64(),
        normal: normal.iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect(),
        mask: mask.iter().map(|&v| v.into()).collect(),
    };
    Weights { images, normal, mask, twin }
}

/// Runs the backward pass, and returns the gradients of the slots.
fn backward(compared: &Compared, v: &Weights) -> Vec<[f32; 20]> {
    let (view, gpu) = (&compared.view, &compared.view.gpu);
    let [v_image, v_normal] = [&v.images.image, &v.normal].map(|rows| storage(gpu, rows));
    let [v_range, v_mask] = [&v.images.range, &v.mask].map(|rows| storage(gpu, rows));
    let step = gpu.uniform("step", &gradients_only());
    let intersections = view.counter(counter::INTERSECTIONS);
    let slots = gpu.buffer("slot gradients", 80 * (intersections as u64).max(1)).unwrap();
    let v_pixels = gpu.buffer("pixel gradients", 32 * view.pixels() as u64).unwrap();
    [&slots, &v_pixels].into_iter().for_each(|buffer| poison(gpu, buffer));
    let mut recorder = Recorder::new(gpu);
    let buffers = BackwardBuffers {
        v_image: &v_image,
        v_range: &v_range,
        slot_gradients: &slots,
        disks: Some(DiskBuffers { v_normal: &v_normal, v_pixels: &v_pixels, v_mask: &v_mask }),
        traced: None,
        step: &step,
        appearances: &[],
    };
    record_backward(gpu, &mut recorder, &view.frame, &view.blocks, &view.uniform, buffers).unwrap();
    recorder.submit();
    gpu.wait().unwrap();
    gpu.read(&slots, 0, intersections).unwrap()
}

pub fn numbers(g: &DiskGradient) -> [f64; 20] {
    let DiskGradient { uv, tau, products, tau_uv, centre2d, range, normal, rgb, mask, opacity, abs, .. } = g;
    [
        uv[0],
        uv[1],
        *tau,
        *opacity,
        products[0],
        products[1],
        products[2],
        products[3],
        tau_uv[0],
        tau_uv[1],
        centre2d[0],
        centre2d[1],
        normal[0],
        normal[1],
        *range,
        *abs,
        rgb[0],
        rgb[1],
        rgb[2],
        *mask,
    ]
}

pub fn from_numbers(g: [f64; 20]) -> DiskGradient {
    DiskGradient {
        uv: [g[0], g[1]],
        tau: g[2],
        opacity: g[3],
        products: [g[4], g[5], g[6], g[7]],
        tau_uv: [g[8], g[9]],
        centre2d: [g[10], g[11]],
        normal: [g[12], g[13]],
        range: g[14],
        abs: g[15],
        rgb: [g[16], g[17], g[18]],
        mask: g[19],
        contribution: 0.0,
    }
}

/// Sums of slots by Gaussian, and the sums of their absolute values.
pub fn sums(view: &View, slots: &[[f32; 20]]) -> Vec<([f64; 20], [f64; 20])> {
    let visible = view.visible();
    let segments: Vec<[u32; 2]> = view.gpu.read(&view.frame.segments, 0, visible.len()).unwrap();
    let mut sums = vec![([0.0; 20], [0.0; 20]); view.blocks.total() as usize];
    for (&id, &[first, count]) in visible.iter().zip(&segments) {
        for slot in &slots[first as usize..(first + count) as usize] {
            for (n, value) in slot.iter().map(|&value| f64::from(value)).enumerate() {
                sums[id].0[n] += value;
                sums[id].1[n] += value.abs();
            }
        }
    }
    sums
}

#[test]
fn gradients_of_disks_match_the_twin() {
    for gpu in layouts() {
        for scene in scenes(255, 250, 0) {
            let compared = Compared::new(&gpu, &scene);
            let v = weights(&compared);
            let Compared { view, disks, lists, rays, twin, .. } = &compared;
            let (camera, background) = (&scene.camera, scene.background64());
            let rules = RasterRules::HARD;
            let expected = trace_backward(disks, lists, rays, camera, twin, background, &rules, &v.twin);
            let kernel = sums(view, &backward(&compared, &v));
            let mut seen = 0;
            for (id, (expected, (kernel, sizes))) in expected.iter().zip(&kernel).enumerate() {
                seen += usize::from(expected.contribution > 0.01);
                for (n, expected) in numbers(expected).into_iter().enumerate() {
                    let tolerance = looseness(&scene) * 2e-3 * (sizes[n].max(expected.abs()) + 1.0);
                    assert!(
                        (kernel[n] - expected).abs() <= tolerance,
                        "{}: number {n} of disk {id}: kernel {:e}, twin {expected:e}, tolerance {tolerance:e}",
                        scene.name,
                        kernel[n]
                    );
                }
            }
            assert!(seen > 20, "{}: {seen} disks are seen", scene.name);
        }
    }
}

/// Asserts that gradients of parameters are those of the twin. Returns the number of disks that are seen.
pub fn assert_parameters(
    scene: &str,
    kernel: &Gaussians64,
    twin: &Gaussians64,
    disks: &[Option<Disk>],
    v_disks: &[DiskGradient],
) -> usize {
    let mut seen = 0;
    for (id, disk) in disks.iter().enumerate() {
        let Some(disk) = disk else { continue };
        seen += usize::from(v_disks[id].rgb != [0.0; 3]);
        for (kind, from, to) in [
            ("mean", 0, 3),
            ("quaternion", 3, 7),
            ("log scale", 7, 9),
            ("mask", 9, 10),
            ("opacity", 10, 11),
            ("colour", 11, twin.parameters()),
        ] {
            let length = |of: &dyn Fn(usize) -> f64| (from..to).map(|p| of(p).powi(2)).sum::<f64>().sqrt();
            let difference = length(&|p| kernel.parameter(id, p) - twin.parameter(id, p));
            // Sums that cancel, by the longer axis: the largest of what they are made of.
            let g = v_disks[id];
            let longest = disk.axes.map(|axis| axis.length());
            let steep = longest[0] * longest[1];
            let parts = match kind {
                "mean" => {
                    steep * g.tau.abs()
                        + longest[0] * g.uv[0].abs()
                        + longest[1] * g.uv[1].abs()
                        + 100.0 * (g.centre2d[0].abs() + g.centre2d[1].abs())
                        + g.range.abs()
                        + g.rgb.iter().map(|v| v.abs()).sum::<f64>()
                }
                "quaternion" | "log scale" => {
                    let ratio = (longest[0] / longest[1]).max(longest[1] / longest[0]);
                    ratio * g.products.iter().map(|v| v.abs()).sum::<f64>()
                        + longest[0].max(longest[1]) * (g.tau_uv[0].abs() + g.tau_uv[1].abs())
                        + g.normal[0].abs()
                        + g.normal[1].abs()
                }
                _ => 0.0,
            };
            let tolerance = 1e-4 * (length(&|p| twin.parameter(id, p)) + parts) + 1e-9;
            assert!(
                difference <= tolerance,
                "{scene}: {kind} of disk {id}: difference {difference:e}, tolerance {tolerance:e}"
            );
        }
    }
    seen
}

#[test]
fn parameters_of_disks_get_the_gradients_of_the_twin() {
    let Some(gpu) = device() else { return };
    for scene in scenes(256, 250, 3) {
        let compared = Compared::new(&gpu, &scene);
        let v = weights(&compared);
        let slots = sums(&compared.view, &backward(&compared, &v));
        let v_disks: Vec<_> = slots.iter().map(|(sums, _)| from_numbers(*sums)).collect();
        let model = Gaussians64::from(&scene.model);
        let disks = project_disks(&model, &scene.camera, &scene.pose, 3, &RasterRules::HARD);
        let twin = project_disks_backward(&model, &scene.camera, &scene.pose, 3, &disks, &v_disks);
        let kernel = compared.view.parameter_gradients();
        let seen = assert_parameters(&scene.name, &kernel, &twin, &disks, &v_disks);
        assert!(seen > 20, "{}: {seen} disks are seen", scene.name);
    }
}

#[test]
fn normal_consistency_matches_the_twin() {
    for gpu in layouts() {
        for scene in scenes(257, 300, 0) {
            let view = View::render_disks(&gpu, &scene);
            let pixels = view.pixels();
            let mut maps = DiskMaps::new(&gpu).unwrap();
            maps.prepare(&gpu, view.uniform.size).unwrap();
            [maps.buffers().v_normal, maps.buffers().v_pixels]
                .into_iter()
                .for_each(|buffer| poison(&gpu, buffer));
            // Other losses come first.
            let before = ImageGradients::random(258, pixels);
            let (v_image, v_range) = (storage(&gpu, &before.image), storage(&gpu, &before.range));
            let weight = 0.05;
            let mut recorder = Recorder::new(&gpu);
            maps.record(&gpu, &mut recorder, &view.frame, &view.uniform, weight, [&v_image, &v_range])
                .unwrap();
            recorder.submit();
            gpu.wait().unwrap();

            let (image, range) = (view.image(), view.range_image());
            let targets = view.frame.targets().unwrap();
            let normals: Vec<[f32; 4]> = gpu.read(targets.normal_image.as_ref().unwrap(), 0, pixels).unwrap();
            let of_pixels = |of: &dyn Fn(usize) -> f64| (0..pixels).map(of).collect::<Vec<f64>>();
            let raster = Raster {
                width: scene.camera.width,
                height: scene.camera.height,
                alpha: of_pixels(&|i| image[i][3].into()),
                range: of_pixels(&|i| range[i].into()),
                ..Raster::default()
            };
            let normal = normals.iter().map(|n| [n[0], n[1], n[2]].map(f64::from)).collect();
            let picture = DiskRaster { raster, normal, ..DiskRaster::default() };
            let rays = pinhole_rays(&scene.camera);
            let twin = normal_consistency(&picture, &rays, weight.into(), LEAST_ALPHA.into());
            let kernel: Vec<[f32; 4]> = gpu.read(maps.buffers().v_normal, 0, pixels).unwrap();
            let v_image: Vec<[f32; 4]> = gpu.read(&v_image, 0, pixels).unwrap();
            let v_range: Vec<f32> = gpu.read(&v_range, 0, pixels).unwrap();
            let surfaces = twin.v_normal.iter().filter(|v| **v != [0.0; 3]).count();
            assert!(
                surfaces > 50 || scene.name == "thin",
                "{}: {surfaces} pixels have a surface",
                scene.name
            );
            for i in 0..pixels {
                let close =
                    |kernel: f32, twin: f64, size: f64| (f64::from(kernel) - twin).abs() <= 1e-3 * size;
                let size = 1.0 + twin.v_range[i].abs() + twin.v_alpha[i].abs();
                assert!(
                    (0..3).all(|c| close(kernel[i][c], twin.v_normal[i][c], 1.0))
                        && close(v_range[i] - before.range[i], twin.v_range[i], size)
                        && close(v_image[i][3] - before.image[i][3], twin.v_alpha[i], size)
                        && v_image[i][..3] == before.image[i][..3],
                    "{}: pixel {i}: {:?}, {} and {} instead of {:?}, {} and {}",
                    scene.name,
                    kernel[i],
                    v_range[i] - before.range[i],
                    v_image[i][3] - before.image[i][3],
                    twin.v_normal[i],
                    twin.v_range[i],
                    twin.v_alpha[i]
                );
            }
        }
    }
}
