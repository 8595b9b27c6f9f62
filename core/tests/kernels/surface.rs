//! Scenes seen through a water surface: rays, projection of refracted disks, and pictures, against the twins.

use std::sync::Arc;

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Blocks, Frame, FrameUniform, Gpu, Recorder, SurfaceRays as Kind, SurfaceUniform};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::surface::{AIR, Surface, WATER};
use fathom_core::train::surface::{DeviceSurface, Frames};
use fathom_twins::{
    Disk, DiskRaster, DiskRay, Gaussians64, Pictures, Raster, RasterRules, Sight, SurfaceRays, TileLists,
    WaterSurface, bounds_of, compose, intersect, project_seen, refracted_outline, samples, surface_rays,
    trace_forward, trace_per_hit,
};
use glam::{DQuat, DVec3};

use crate::device::{device, layouts, poison};
use crate::disks::{is_decided, projected};
use crate::view::{BACKGROUND, Scene, View};

/// A camera and a surface.
#[derive(Clone)]
pub struct Pool {
    pub name: &'static str,
    pub camera: PinholeCamera,
    pub pose: Pose,
    pub uniform: SurfaceUniform,
    /// The same for the twins.
    pub water: WaterSurface,
}

impl Pool {
    fn new(name: &'static str, target: DVec3, schlick: bool, as_shown: bool) -> Self {
        let (width, height) = (75, 53);
        let camera = PinholeCamera { width, height, fx: 67.0, fy: 58.0, cx: 31.0, cy: 30.0 };
        let normal = DVec3::new(0.06, 1.0, -0.04).normalize().as_vec3();
        let uniform = SurfaceUniform {
            normal: normal.to_array(),
            offset: 0.15,
            eta: (AIR / WATER) as f32,
            schlick: schlick.into(),
            as_shown: as_shown.into(),
            over: (!as_shown).into(),
        };
        let plane = Surface {
            normal: normal.as_dvec3(),
            offset: uniform.offset.into(),
            ior: AIR / f64::from(uniform.eta),
        };
        let eye = DVec3::new(0.3, 1.9, -2.2);
        Self {
            name,
            camera,
            pose: Pose::looking_at(eye, target, DVec3::new(0.1, -1.0, 0.0)),
            uniform,
            water: WaterSurface { plane, schlick, as_shown, over: !as_shown },
        }
    }

    /// From above and towards the horizon, with both reflectances, ways of adding light, and joins.
    pub fn all() -> [Self; 2] {
        [
            Self::new("steep", DVec3::new(0.1, -0.2, 0.3), false, false),
            Self::new("flat", DVec3::new(0.1, 1.0, 1.5), true, true),
        ]
    }

    pub fn sights(&self) -> [Sight; 3] {
        let plane = &self.water.plane;
        [
            Sight::straight(&self.pose),
            Sight::reflected(&self.pose, plane),
            Sight::refracted(&self.pose, plane),
        ]
    }

    pub fn pivot(&self) -> [f32; 3] {
        let plane = &self.water.plane;
        (plane.offset * plane.normal + DVec3::new(0.2, 0.0, 0.1)).as_vec3().to_array()
    }

    pub fn scene(&self, model: Gaussians) -> Scene {
        Scene {
            name: self.name.to_owned(),
            sh_degree: model.sh_degree,
            model,
            camera: self.camera,
            pose: self.pose,
            background: BACKGROUND,
            mip_filter: false,
        }
    }
}

/// Disks of all sizes with heights `low` to `high`; masks of all strengths.
pub fn disks(seed: u32, count: usize, sh_degree: u8, [low, high]: [f32; 2]) -> Gaussians {
    let mut model = samples::random(seed, count, sh_degree);
    for (i, mean) in model.means.iter_mut().enumerate() {
        mean[1] = low + 0.5 * (mean[1] + 1.0) * (high - low);
        model.log_scales[i][2] = 6.0 * uniform_at(seed, Stream::Test, i as u32, 99) - 3.0;
    }
    model
}

/// The straight, the reflected and the refracted set. Some disks are on the wrong side of the surface.
pub fn sets(seed: u32, count: usize, sh_degree: u8) -> [Gaussians; 3] {
    [[-0.6, 0.9], [-0.1, 1.8], [-1.7, 0.3]]
        .map(|heights| disks(seed + 10 * (heights[1] * 10.0) as u32, count, sh_degree, heights))
}

/// The three sets of a pool, rendered by the kernels.
pub struct Seen {
    pub pool: Pool,
    pub device: DeviceSurface,
    pub views: [View; 3],
}

impl Seen {
    pub fn new(gpu: &Arc<Gpu>, pool: &Pool, models: [Gaussians; 3]) -> Self {
        let mut device = DeviceSurface::new(gpu, pool.uniform, pool.pivot()).unwrap();
        device.prepare(gpu, [pool.camera.width, pool.camera.height]).unwrap();
        let [straight, reflected, refracted] = models.map(|model| pool.scene(model));
        let views = [
            set(gpu, &straight, None, &device),
            set(gpu, &reflected, Some(Kind::Reflected), &device),
            set(gpu, &refracted, Some(Kind::Refracted), &device),
        ];
        let mut seen = Self { pool: pool.clone(), device, views };
        seen.views[0].forward();
        let mut recorder = Recorder::new(gpu);
        seen.device.record_rays(&mut recorder, seen.frames(), seen.pixels() as u32).unwrap();
        recorder.submit();
        seen.views[1].forward();
        seen.views[2].forward();
        seen
    }

    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.views[0].gpu
    }

    pub fn frames(&self) -> Frames<'_> {
        let [straight, reflected, refracted] = self.views.each_ref().map(|view| &view.frame);
        Frames { straight, reflected, refracted }
    }

    pub fn pixels(&self) -> usize {
        self.views[0].pixels()
    }

    /// Blended masks of the straight set.
    pub fn masks(&self) -> Vec<f64> {
        let normals = self.views[0].frame.targets().unwrap().normal_image.as_ref().unwrap();
        let normals: Vec<[f32; 4]> = self.gpu().read(normals, 0, self.pixels()).unwrap();
        normals.iter().map(|normal| normal[3].into()).collect()
    }

    /// By how much the straight picture covers the water.
    pub fn cover(&self) -> Vec<f64> {
        self.pool.water.cover(&self.pictures()[0]).to_vec()
    }

    /// The rays as the kernel wrote them.
    pub fn rays(&self) -> SurfaceRays {
        let of = |view: &View| -> Vec<[[f32; 4]; 2]> {
            self.gpu().read(view.frame.targets().unwrap().rays.as_ref().unwrap(), 0, self.pixels()).unwrap()
        };
        let ray = |[origin, direction]: &[[f32; 4]; 2]| {
            let vector = |v: &[f32; 4]| DVec3::new(v[0].into(), v[1].into(), v[2].into());
            assert!(origin[3] == 0.0 || origin[3] == 1.0, "{origin:?}");
            if origin[3] == 0.0 {
                return DiskRay::NONE;
            }
            DiskRay { origin: vector(origin), direction: vector(direction), nearest: 0.0 }
        };
        let [reflected, refracted] = [of(&self.views[1]), of(&self.views[2])];
        assert!(reflected.iter().zip(&refracted).all(|(a, b)| a[1][3] == b[1][3] && a[0] == b[0]));
        SurfaceRays {
            share: refracted.iter().map(|ray| ray[1][3].into()).collect(),
            reflected: reflected.iter().map(ray).collect(),
            refracted: refracted.iter().map(ray).collect(),
        }
    }

    /// The three pictures as the kernels wrote them, as far as the composition reads them.
    pub fn pictures(&self) -> [DiskRaster; 3] {
        let masks = self.masks();
        self.views.each_ref().map(|view| {
            let image = view.image();
            let rgb = image.iter().map(|p| [p[0], p[1], p[2]].map(f64::from)).collect();
            let alpha = image.iter().map(|p| p[3].into()).collect();
            let (width, height) = (self.pool.camera.width, self.pool.camera.height);
            let raster = Raster { width, height, rgb, alpha, ..Raster::default() };
            DiskRaster { raster, mask: masks.clone(), ..DiskRaster::default() }
        })
    }

    /// A set that is seen at the surface, beside the twin's picture of the same disks and rays.
    pub fn traced(&self, set: usize) -> Traced {
        let (view, rays) = (&self.views[set], self.rays());
        let rays = if set == 1 { rays.reflected } else { rays.refracted };
        let disks = projected(view, &self.pool.sights()[set]);
        let size = [self.pool.camera.width, self.pool.camera.height];
        let lists = intersect(&bounds_of(&disks), size[0], size[1]);
        let background = view.scene.background64();
        let twin = trace_forward(&disks, &lists, &rays, size, background, &RasterRules::HARD);
        let decided = (0..rays.len())
            .map(|i| !rays[i].nearest.is_finite() || is_decided(&disks, &lists, &rays, size[0], i))
            .collect();
        Traced { disks, lists, rays, twin, decided }
    }
}

pub struct Traced {
    pub disks: Vec<Option<Disk>>,
    pub lists: TileLists,
    pub rays: Vec<DiskRay>,
    pub twin: DiskRaster,
    pub decided: Vec<bool>,
}

/// A set before its forward pass, with rubbish in its buffers.
fn set(gpu: &Arc<Gpu>, scene: &Scene, rays: Option<Kind>, device: &DeviceSurface) -> View {
    let mut blocks = Blocks::new(gpu, scene.model.sh_degree).unwrap();
    blocks.push_trainable(gpu, &scene.model, scene.model.len() as u32, Moments::F32).unwrap();
    let mut view = View::prepare(gpu, scene, blocks);
    let (visible, intersections) = view.frame.capacities();
    let mut frame = Frame::new(gpu, view.blocks.total(), visible, intersections).unwrap();
    frame = frame.of_disks(gpu).unwrap();
    if let Some(rays) = rays {
        frame = frame.at_surface(gpu, rays, device.plane()).unwrap();
    }
    view.frame = frame;
    view.frame.prepare_targets(gpu, view.uniform.size).unwrap();
    view.frame.scratch().into_iter().for_each(|buffer| poison(gpu, buffer));
    view
}

#[test]
fn rays_at_the_surface_match_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(601, 120, 0));
            let (kernel, cover) = (seen.rays(), seen.cover());
            let twin = surface_rays(&pool.water, &pool.camera, &pool.pose, &cover);
            let n = pool.water.plane.normal;
            let mut hits = 0;
            for (i, covered) in cover.iter().enumerate() {
                let cosine = -n.dot(pool.pose.rotation.inverse() * pool.camera.direction(i));
                // Rounding decides whether a ray grazes the surface.
                if (cosine - 1e-3).abs() < 1e-5 || (covered - 0.999).abs() < 1e-6 {
                    continue;
                }
                assert_eq!(kernel.is_hit(i), twin.is_hit(i), "{}: pixel {i}, cosine {cosine}", pool.name);
                if !twin.is_hit(i) {
                    continue;
                }
                hits += 1;
                // The distance is the height over the cosine, which is off by some 1e-7.
                let loose = 1e-6 / cosine;
                for (kernel, twin) in
                    [(kernel.reflected[i], twin.reflected[i]), (kernel.refracted[i], twin.refracted[i])]
                {
                    let far = twin.origin.length();
                    assert!(
                        (kernel.origin - twin.origin).length() <= loose * far
                            && (kernel.direction - twin.direction).length() <= 2e-6,
                        "{}: pixel {i}: {kernel:?} instead of {twin:?}",
                        pool.name
                    );
                }
                let off = (kernel.share[i] - twin.share[i]).abs();
                assert!(off < 1e-5, "{}: pixel {i}: F is {off} off", pool.name);
            }
            let share = hits as f64 / cover.len() as f64;
            assert!(if pool.name == "flat" { (0.2..0.8).contains(&share) } else { share > 0.9 }, "{share}");
        }
    }
}

#[test]
fn a_reflected_frame_has_the_view_of_the_mirrored_camera() {
    let Some(gpu) = device() else { return };
    for pool in Pool::all() {
        let seen = Seen::new(&gpu, &pool, sets(602, 20, 0));
        let [straight, mirrored, _] = pool.sights();
        for (set, sight) in [(1, mirrored), (2, straight)] {
            let frame: Vec<FrameUniform> = gpu.read(&seen.views[set].frame.uniform, 0, 1).unwrap();
            let at = DVec3::new(0.3, -0.8, 0.6);
            let expected = sight.transform(at);
            let row = |r: [f32; 4]| r.map(f64::from);
            for (k, r) in [frame[0].view_x, frame[0].view_y, frame[0].view_z].map(row).iter().enumerate() {
                let found = r[0] * at.x + r[1] * at.y + r[2] * at.z + r[3];
                assert!((found - expected[k]).abs() < 2e-6, "set {set}, row {k}: {found}, {expected}");
            }
            let eye = DVec3::from_array(frame[0].eye.map(f64::from));
            assert!((eye - sight.eye).length() < 1e-6, "set {set}: {eye} instead of {}", sight.eye);
        }
    }
}

#[test]
fn disks_at_the_surface_are_projected_as_the_twin_does() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(603, 300, 2));
            for set in [1, 2] {
                let (view, sight) = (&seen.views[set], &pool.sights()[set]);
                let kernel = projected(view, sight);
                let model = Gaussians64::from(&view.scene.model);
                let twin = project_seen(&model, &pool.camera, sight, 2, &RasterRules::HARD);
                let (mut compared, mut missed) = (0, vec![None; twin.len()]);
                for (id, (kernel, twin)) in kernel.iter().zip(&twin).enumerate() {
                    let what = format!("{}, set {set}: disk {id}", pool.name);
                    let (Some(kernel), Some(twin)) = (kernel, twin) else {
                        let height = pool.water.plane.height(DVec3::from_array(model.means[id]));
                        assert!(kernel.is_none() || height.abs() < 1e-6, "{what} is culled by the twin");
                        missed[id] = *twin;
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
                            && (0..2).all(|k| close(kernel.centre2d[k], twin.centre2d[k], 20.0))
                            && close(kernel.bound.mean2d[0], twin.bound.mean2d[0], 100.0 + width)
                            && close(kernel.bound.half_size[0], twin.bound.half_size[0], 10.0 * width)
                            && close(kernel.bound.half_size[1], twin.bound.half_size[1], 10.0 * height)
                            && close(kernel.bound.range, twin.bound.range, 1.0)
                            && close(kernel.bound.opacity, twin.bound.opacity, 1.0)
                            && (0..3).all(|c| close(kernel.bound.rgb[c], twin.bound.rgb[c], 1.0)),
                        "{what}: {kernel:?} instead of {twin:?}"
                    );
                }
                assert!(compared > 40, "{}, set {set}: {compared} compared", pool.name);
                // No pixel sees what the kernel culls.
                let rays = seen.rays();
                let rays = if set == 1 { &rays.reflected } else { &rays.refracted };
                let (width, background) = (pool.camera.width, view.scene.background64());
                let left = trace_per_hit(&missed, rays, width, background, &RasterRules::HARD);
                let shown = left.iter().position(|rgb| *rgb != background);
                assert_eq!(shown, None, "{}, set {set}: a disk that is seen is culled", pool.name);
            }
        }
    }
}

/// Disks below the surface of up to `most` of their distance.
fn below(pool: &Pool, seed: u32, count: usize, most: f32) -> Gaussians {
    let mut model = disks(seed, count, 0, [-1.7, -0.15]);
    for (i, scales) in model.log_scales.iter_mut().enumerate() {
        let m = Sight::straight(&pool.pose).transform(DVec3::from_array(model.means[i].map(f64::from)));
        let u = |j| uniform_at(seed, Stream::Test, i as u32, j);
        let size = (m.length() as f32 * most).ln();
        scales[0] = size - 2.0 * u(100) * u(100);
        scales[1] = size - 3.0 * u(101);
    }
    model
}

#[test]
fn the_ellipse_of_a_refracted_disk_holds_its_outline() {
    let Some(gpu) = device() else { return };
    for pool in Pool::all() {
        let mut models = sets(604, 4, 0);
        models[2] = below(&pool, 604, 300, 0.13);
        let seen = Seen::new(&gpu, &pool, models);
        let sight = &pool.sights()[2];
        let (mut most, mut count) = (0.0_f64, 0);
        for (id, disk) in projected(&seen.views[2], sight).iter().enumerate() {
            let Some(disk) = disk else { continue };
            count += 1;
            let [a, b, c] = disk.bound.conic;
            let reach = (2.0 * disk.bound.extent).sqrt();
            for [x, y] in refracted_outline(disk, sight, &pool.camera, reach, 200) {
                let share = (0.5 * (a * x * x + c * y * y) + b * x * y) / disk.bound.extent;
                most = most.max(share);
                assert!(share <= 1.0, "{}: disk {id}: {share}", pool.name);
            }
        }
        println!("{}: outlines of {count} disks reach {:.3} of their ellipse", pool.name, most.sqrt());
        assert!(count > 100, "{count}");
    }
}

#[test]
fn traced_pictures_match_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(605, 250, 1));
            for set in [1, 2] {
                let Traced { rays, twin, decided, .. } = seen.traced(set);
                let image = seen.views[set].image();
                let share = decided.iter().filter(|decided| **decided).count() as f64 / decided.len() as f64;
                assert!(share > 0.5, "{}, set {set}: {share} of the pixels are decided", pool.name);
                let mut shown = 0;
                for i in (0..decided.len()).filter(|&i| decided[i]) {
                    shown += usize::from(rays[i].nearest.is_finite() && twin.raster.alpha[i] > 0.1);
                    let pixel = image[i].map(f64::from);
                    let pairs = (0..3).map(|c| (pixel[c], twin.raster.rgb[i][c], 1e-4)).chain([(
                        pixel[3],
                        twin.raster.alpha[i],
                        1e-4,
                    )]);
                    for (n, (kernel, twin, tolerance)) in pairs.enumerate() {
                        assert!(
                            (kernel - twin).abs() <= tolerance,
                            "{}, set {set}: number {n} of pixel {i}: kernel {kernel}, twin {twin}",
                            pool.name
                        );
                    }
                }
                assert!(shown > 150, "{}, set {set}: {shown} pixels show disks", pool.name);
            }
        }
    }
}

#[test]
fn only_tiles_with_a_ray_have_lists() {
    for gpu in layouts() {
        // The sky above the horizon has no rays.
        let horizon = Pool::new("horizon", DVec3::new(0.1, 1.7, 1.5), true, true);
        let mut without = 0;
        for pool in Pool::all().into_iter().chain([horizon]) {
            let seen = Seen::new(&gpu, &pool, sets(606, 250, 1));
            let rays = seen.rays();
            let size = seen.views[0].uniform.size;
            let tiles = seen.views[0].uniform.tiles;
            let mut has_ray = vec![false; (tiles[0] * tiles[1]) as usize];
            for i in (0..seen.pixels() as u32).filter(|&i| rays.is_hit(i as usize)) {
                has_ray[(i / size[0] / gpu.tile() * tiles[0] + i % size[0] / gpu.tile()) as usize] = true;
            }
            assert!(has_ray.contains(&true), "{}: no tile has a ray", pool.name);
            without += has_ray.iter().filter(|&&has| !has).count();
            for view in &seen.views[1..] {
                let targets = view.frame.targets().unwrap();
                let flags = targets.tile_rays.as_ref().unwrap();
                let flags: Vec<u32> = gpu.read(flags, 0, has_ray.len()).unwrap();
                assert_eq!(flags, has_ray.iter().map(|&has| u32::from(has)).collect::<Vec<_>>());
                let ranges: Vec<[u32; 2]> = gpu.read(&targets.ranges, 0, has_ray.len()).unwrap();
                for (tile, [first, last]) in ranges.iter().enumerate() {
                    let most = if has_ray[tile] { u32::MAX } else { 0 };
                    assert!(last - first <= most, "{}: tile {tile} lists {first}..{last}", pool.name);
                }
                assert!(ranges.iter().any(|[first, last]| last > first), "{}: no list", pool.name);
            }
        }
        assert!(without > 0, "every tile of every pool has a ray");
    }
}

/// A floor and a boulder with a smooth texture, of small disks along their faces, as training leaves them.
fn floor(seed: u32, count: usize, scale: f32) -> Gaussians {
    let mut model = disks(seed, count, 0, [0.0, 0.0]);
    for i in 0..count {
        let u = |j| f64::from(uniform_at(seed, Stream::Test, i as u32, j));
        let (mean, normal) = if i % 4 == 0 {
            let turn = std::f64::consts::TAU * u(102);
            let up = 0.2 + 0.8 * u(103);
            let side = (1.0 - up * up).sqrt();
            let normal = DVec3::new(side * turn.cos(), up, side * turn.sin());
            (DVec3::new(0.1, -0.9, 0.3) + 0.35 * normal, normal)
        } else {
            let at = DVec3::new(2.4 * u(102) - 1.1, 0.0, 2.6 * u(103) - 0.9);
            (
                at + DVec3::new(0.0, -0.9 + 0.1 * (2.0 * at.x).sin(), 0.0),
                DVec3::new(-0.2 * (2.0 * at.x).cos(), 1.0, 0.0),
            )
        };
        let turn = DQuat::from_rotation_arc(DVec3::Z, normal.normalize());
        model.quats[i] = [turn.w, turn.x, turn.y, turn.z].map(|v| v as f32);
        model.means[i] = mean.as_vec3().to_array();
        model.log_scales[i] = [scale + 0.5 * u(104) as f32, scale + 0.5 * u(105) as f32, 0.0];
        model.opacity_logits[i] = 3.0 * u(106) as f32;
        model.sh_coeffs[i] = [1.0, 2.0, 3.0].map(|k| (k + 3.0 * mean.x + (2.0 + k) * mean.z).sin() as f32);
    }
    model
}

#[test]
fn pictures_are_near_those_of_a_per_hit_tracer() {
    let Some(gpu) = device() else { return };
    let pool = &Pool::all()[0];
    // Disks are sorted by their centres. Neighbours on a face that overlap far are in no certain order.
    for (name, scale, least) in [("neighbours touch", -3.0, 45.0), ("neighbours overlap twice", -2.3, 30.0)] {
        let mut models = sets(606, 4, 0);
        models[2] = floor(606, 200, scale);
        let seen = Seen::new(&gpu, pool, models);
        let view = &seen.views[2];
        let model = Gaussians64::from(&view.scene.model);
        let disks = project_seen(&model, &pool.camera, &pool.sights()[2], 0, &RasterRules::HARD);
        let rays = surface_rays(&pool.water, &pool.camera, &pool.pose, &seen.cover());
        let (size, background) = ([pool.camera.width, pool.camera.height], view.scene.background64());
        let lists = intersect(&bounds_of(&disks), size[0], size[1]);
        let ordered = trace_forward(&disks, &lists, &rays.refracted, size, background, &RasterRules::HARD);
        let traced = trace_per_hit(&disks, &rays.refracted, size[0], background, &RasterRules::HARD);
        let image = view.image();
        let hits: Vec<usize> = (0..image.len()).filter(|&i| rays.is_hit(i)).collect();
        let psnr = |traced: &[[f64; 3]]| {
            let squares = hits.iter().flat_map(|&i| (0..3).map(move |c| (i, c)));
            let sum: f64 = squares.map(|(i, c)| (f64::from(image[i][c]) - traced[i][c]).powi(2)).sum();
            -10.0 * (sum / (3.0 * hits.len() as f64)).log10()
        };
        let (by_hit, by_centre) = (psnr(&traced), psnr(&ordered.raster.rgb));
        println!("{name}: {by_hit:.1} dB against a per-hit tracer, {by_centre:.1} dB in the same order");
        assert!(by_hit > least && by_centre > 110.0, "{name}: {by_hit:.1} dB and {by_centre:.1} dB");
    }
}

#[test]
fn the_picture_of_a_surface_matches_the_twin() {
    for gpu in layouts() {
        for pool in Pool::all() {
            let seen = Seen::new(&gpu, &pool, sets(608, 200, 1));
            poison(&gpu, seen.device.picture());
            let mut recorder = Recorder::new(&gpu);
            seen.device.record_compose(&mut recorder, seen.frames(), seen.pixels() as u32).unwrap();
            recorder.submit();
            let kernel: Vec<[f32; 4]> = gpu.read(seen.device.picture(), 0, seen.pixels()).unwrap();
            let [straight, reflected, refracted] = &seen.pictures();
            let of = Pictures { straight, reflected: &reflected.raster, refracted: &refracted.raster };
            let (rays, straight) = (seen.rays(), seen.views[0].image());
            let mixed =
                (0..seen.pixels()).filter(|&i| rays.is_hit(i) && (0.1..0.9).contains(&of.straight.mask[i]));
            assert!(mixed.count() > 200, "{}", pool.name);
            for (i, twin) in compose(&pool.water, &rays, of).iter().enumerate() {
                if !rays.is_hit(i) {
                    assert_eq!(kernel[i], straight[i], "{}: pixel {i} has no ray", pool.name);
                    continue;
                }
                for c in 0..3 {
                    let off = (f64::from(kernel[i][c]) - twin[c]).abs();
                    assert!(off < 5e-6, "{}: channel {c} of pixel {i}: {off} off", pool.name);
                }
            }
        }
    }
}
