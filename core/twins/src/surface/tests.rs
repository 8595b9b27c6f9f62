//! Geometry of the rays at a surface, and gradients of three sets and the plane against central differences.

use super::*;
use crate::finite_differences::{assert_close, derivative};
use crate::{
    DISK_BLUR, Disk, DiskGradient, DiskRasterGradients, Gaussians64, RasterGradients, RasterRules, TileLists,
    bounds_of, intersect, pinhole_rays, project_seen, project_seen_backward, trace_backward_along,
    trace_forward,
};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::surface::WATER;

const WIDTH: u32 = 12;
const HEIGHT: u32 = 9;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;
const BACKGROUND: [f64; 3] = [0.3, 0.5, 0.4];
const PIVOT: DVec3 = DVec3::new(0.2, 0.1, -0.1);

/// From `low` to `high`.
fn number(seed: u32, i: u32, j: u32, low: f64, high: f64) -> f64 {
    low + (high - low) * f64::from(uniform_at(seed, Stream::Test, i, j))
}

/// A camera above the surface that looks down at it, slantwise.
fn view() -> (PinholeCamera, Pose) {
    let camera = PinholeCamera { width: WIDTH, height: HEIGHT, fx: 10.8, fy: 9.9, cx: 5.2, cy: 4.7 };
    (
        camera,
        Pose::looking_at(DVec3::new(0.3, 1.9, -2.2), DVec3::new(0.1, 0.0, 0.2), DVec3::new(0.1, -1.0, 0.0)),
    )
}

fn water(schlick: bool, as_shown: bool) -> WaterSurface {
    // The two that the kernels are tested with.
    let over = !as_shown;
    let normal = DVec3::new(0.06, 1.0, -0.04).normalize();
    WaterSurface { plane: Surface { normal, offset: 0.15, ior: WATER }, schlick, as_shown, over }
}

/// Disks of about a unit in a box of heights `low` to `high` around the view's target, roughly at right
/// angles to `facing`.
fn disks(seed: u32, count: u32, sh_degree: u8, [low, high]: [f64; 2], facing: DVec3) -> Gaussians64 {
    let mut model = Gaussians64::zeros(count as usize, sh_degree);
    for i in 0..count {
        let u = |j, low, high| number(seed, i, j, low, high);
        let tilt =
            glam::DQuat::from_euler(glam::EulerRot::XYZ, u(0, -0.4, 0.4), u(1, -0.4, 0.4), u(2, -3.0, 3.0));
        let turn = glam::DQuat::from_rotation_arc(DVec3::Z, facing.normalize()) * tilt;
        let row = i as usize;
        model.quats[row] = [turn.w, turn.x, turn.y, turn.z].map(|v| 1.3 * v);
        model.means[row] = [u(3, -0.9, 0.9), u(4, low, high), u(5, -0.8, 1.0)];
        model.log_scales[row] = [u(6, -0.8, 0.0), u(7, -0.8, 0.0), u(8, -1.5, 1.5)];
        model.opacity_logits[row] = u(9, -1.5, 0.5);
        let coeffs = model.coeffs();
        for k in 0..coeffs {
            let size = if k == 0 { 0.8 } else { 0.2 };
            model.sh_coeffs[row * coeffs + k] = [10, 11, 12].map(|j| u(j + 3 * k as u32, -size, size));
        }
    }
    model
}

/// The straight, the reflected and the refracted set.
fn sets(sh_degree: u8) -> [Gaussians64; 3] {
    let slant = DVec3::new(0.1, 1.0, -1.1);
    [
        disks(501, 3, sh_degree, [0.0, 0.8], slant),
        disks(502, 3, sh_degree, [0.8, 1.6], DVec3::new(0.1, -1.0, -1.1)),
        disks(503, 4, sh_degree, [-1.4, -0.6], slant),
    ]
}

struct Traced {
    sight: Sight,
    disks: Vec<Option<Disk>>,
    lists: TileLists,
    rays: Vec<DiskRay>,
    forward: DiskRaster,
}

impl Traced {
    fn new(model: &Gaussians64, sight: Sight, rays: Vec<DiskRay>) -> Self {
        let rules = RasterRules::SMOOTH;
        let disks = project_seen(model, &view().0, &sight, model.sh_degree, &rules);
        let lists = intersect(&bounds_of(&disks), WIDTH, HEIGHT);
        let forward = trace_forward(&disks, &lists, &rays, [WIDTH, HEIGHT], BACKGROUND, &rules);
        Self { sight, disks, lists, rays, forward }
    }

    /// Whether the low-pass decides at a pixel, or nearly, or a disk begins near the ray's origin.
    fn is_near_a_kink(&self, pixel: usize) -> bool {
        let ray = &self.rays[pixel];
        let at = [pixel as u32 % WIDTH, pixel as u32 / WIDTH].map(|i| f64::from(i) + 0.5);
        ray.nearest.is_finite()
            && self.disks.iter().flatten().any(|disk| {
                let [a_u, a_v] = disk.axes;
                let normal = a_u.cross(a_v);
                let t = normal.dot(disk.centre - ray.origin) / normal.dot(ray.direction);
                let p = ray.origin + t * ray.direction - disk.centre;
                let solid = a_u.dot(p).powi(2) + a_v.dot(p).powi(2);
                let thin = (0..2).map(|c| (disk.centre2d[c] - at[c]).powi(2)).sum::<f64>() / DISK_BLUR;
                t < 0.05 || solid > 0.95 * thin - 0.02
            })
    }

    fn backward(
        &self,
        v: &[[f64; 3]],
        [v_alpha, v_mask]: [&[f64]; 2],
    ) -> (Vec<DiskGradient>, Vec<RayGradient>) {
        let v = DiskRasterGradients {
            raster: RasterGradients { rgb: v.to_vec(), alpha: v_alpha.to_vec(), range: vec![0.0; PIXELS] },
            normal: vec![[0.0; 3]; PIXELS],
            mask: v_mask.to_vec(),
        };
        let (camera, rules) = (&view().0, RasterRules::SMOOTH);
        let of = (&self.disks, &self.lists, &self.rays);
        trace_backward_along(of.0, of.1, of.2, camera, &self.forward, BACKGROUND, &rules, &v)
    }

    fn pulled(&self, model: &Gaussians64, v: &[DiskGradient]) -> Gaussians64 {
        project_seen_backward(model, &view().0, &self.sight, model.sh_degree, &self.disks, v)
    }
}

struct Rendered {
    straight: Traced,
    reflected: Traced,
    refracted: Traced,
    rays: SurfaceRays,
    picture: Vec<[f64; 3]>,
}

impl Rendered {
    fn pictures(&self) -> Pictures<'_> {
        Pictures {
            straight: &self.straight.forward,
            reflected: &self.reflected.forward.raster,
            refracted: &self.refracted.forward.raster,
        }
    }
}

fn render(water: &WaterSurface, [straight, reflected, refracted]: &[Gaussians64; 3]) -> Rendered {
    let (camera, pose) = view();
    let straight = Traced::new(straight, Sight::straight(&pose), pinhole_rays(&camera));
    let rays = surface_rays(water, &camera, &pose, water.cover(&straight.forward));
    let mut out = Rendered {
        straight,
        reflected: Traced::new(reflected, Sight::reflected(&pose, &water.plane), rays.reflected.clone()),
        refracted: Traced::new(refracted, Sight::refracted(&pose, &water.plane), rays.refracted.clone()),
        rays,
        picture: Vec::new(),
    };
    out.picture = compose(water, &out.rays, out.pictures());
    out
}

/// One weight for each number of the picture and of the blended mask, with zeros where a step may change what
/// decides.
fn weights(at: &Rendered) -> (Vec<[f64; 3]>, Vec<f64>, usize) {
    let mut v: Vec<[f64; 3]> =
        (0..PIXELS as u32).map(|i| [0, 1, 2].map(|c| number(504, i, c, -1.0, 1.0))).collect();
    let mut v_mask: Vec<f64> = (0..PIXELS as u32).map(|i| number(504, i, 3, -1.0, 1.0)).collect();
    let mut kept = 0;
    for i in 0..PIXELS {
        if [&at.straight, &at.reflected, &at.refracted].into_iter().any(|set| set.is_near_a_kink(i)) {
            (v[i], v_mask[i]) = ([0.0; 3], 0.0);
        } else {
            kept += 1;
        }
    }
    (v, v_mask, kept)
}

fn loss(at: &Rendered, v: &[[f64; 3]], v_mask: &[f64]) -> f64 {
    let colours = at.picture.iter().flatten().zip(v.iter().flatten()).map(|(a, b)| a * b).sum::<f64>();
    colours + at.straight.forward.mask.iter().zip(v_mask).map(|(a, b)| a * b).sum::<f64>()
}

/// The backward pass: gradients of the three sets, and of normal and offset.
fn backward(
    water: &WaterSurface,
    models: &[Gaussians64; 3],
    at: &Rendered,
    v: &[[f64; 3]],
    v_mask: &[f64],
) -> ([Gaussians64; 3], [f64; 4]) {
    let (camera, pose) = view();
    let pictures = compose_backward(water, &at.rays, at.pictures(), v);
    let masks: Vec<f64> = pictures.mask.iter().zip(v_mask).map(|(a, b)| a + b).collect();
    let none = vec![0.0; PIXELS];
    let (v_straight, _) = at.straight.backward(&pictures.straight, [&pictures.alpha, &masks]);
    let (v_reflected, reflected) = at.reflected.backward(&pictures.reflected, [&none, &none]);
    let (v_refracted, refracted) = at.refracted.backward(&pictures.refracted, [&none, &none]);
    let v = RayGradients { reflected: &reflected, refracted: &refracted, share: &pictures.share };
    let plane = plane_gradients(water, &camera, &pose, &at.rays, v, PIVOT);
    let sum = plane.iter().fold([0.0; 4], |sum, v| std::array::from_fn(|k| sum[k] + v[k]));
    let models = [
        at.straight.pulled(&models[0], &v_straight),
        at.reflected.pulled(&models[1], &v_reflected),
        at.refracted.pulled(&models[2], &v_refracted),
    ];
    (models, sum)
}

#[test]
fn gradients_of_three_sets_are_central_differences() {
    for (sh_degree, as_shown) in [(0, false), (2, true)] {
        let (water, models) = (water(false, as_shown), sets(sh_degree));
        let at = render(&water, &models);
        let (v, v_mask, kept) = weights(&at);
        let hits = (0..PIXELS).filter(|&i| at.rays.is_hit(i) && v[i] != [0.0; 3]).count();
        assert!(kept > 50 && hits > 40, "{kept} pixels without a kink, {hits} of them at the surface");
        let (analytic, _) = backward(&water, &models, &at, &v, &v_mask);
        for set in 0..3 {
            for id in 0..models[set].len() {
                let mut size = 0.0;
                for parameter in 0..models[set].parameters() {
                    let numeric = derivative(|h| {
                        let mut moved = models.clone();
                        *moved[set].parameter_mut(id, parameter) += 0.1 * h;
                        loss(&render(&water, &moved), &v, &v_mask)
                    }) / 0.1;
                    let name = Gaussians64::parameter_name(parameter);
                    let value = analytic[set].parameter(id, parameter);
                    assert_close(&format!("{name} of disk {id} of set {set}"), value, numeric, 10.0);
                    size += value.abs();
                }
                assert!(size > 1e-3, "disk {id} of set {set} is not seen");
            }
        }
    }
}

#[test]
fn gradients_of_the_plane_are_central_differences() {
    // Of degree 0: a colour that depends on the direction has no part in these gradients.
    let models = sets(0);
    for (schlick, as_shown) in [(false, false), (true, false), (false, true)] {
        let water = water(schlick, as_shown);
        let at = render(&water, &models);
        let (v, v_mask, _) = weights(&at);
        let (_, analytic) = backward(&water, &models, &at, &v, &v_mask);
        let with = |plane: Surface| loss(&render(&WaterSurface { plane, ..water }, &models), &v, &v_mask);
        let plane = water.plane;
        let by_offset = derivative(|h| with(Surface { offset: plane.offset + 0.1 * h, ..plane })) / 0.1;
        assert_close("offset", analytic[3], by_offset, 10.0);
        let tilt = DVec3::new(analytic[0], analytic[1], analytic[2]);
        let first = plane.normal.any_orthonormal_vector();
        for (name, along) in [("first tilt", first), ("second tilt", first.cross(plane.normal))] {
            let numeric = derivative(|h| {
                let normal = (plane.normal + 0.1 * h * along).normalize();
                let offset = plane.offset + (normal - plane.normal).dot(PIVOT);
                with(Surface { normal, offset, ..plane })
            }) / 0.1;
            assert_close(name, tilt.dot(along), numeric, 10.0);
            assert!(numeric.abs() > 0.005 && by_offset.abs() > 0.005, "{name}: {numeric}, {by_offset}");
        }
    }
}

#[test]
fn the_ray_of_a_centre_passes_through_it() {
    let (camera, pose) = view();
    let plane = water(false, false).plane;
    let [_, reflected, refracted] = sets(0);
    let straight = Sight::straight(&pose);
    for (model, sight) in
        [(&reflected, Sight::reflected(&pose, &plane)), (&refracted, Sight::refracted(&pose, &plane))]
    {
        for (id, disk) in project_seen(model, &camera, &sight, 0, &RasterRules::HARD).iter().enumerate() {
            let disk = disk.as_ref().expect("it is on the right side");
            let [x, y] = disk.centre2d;
            let seen = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0).normalize();
            let d = straight.world_to_camera.transpose() * seen;
            let at = pose.centre() + plane.meets(pose.centre(), d).expect("it meets the surface") * d;
            let split = plane.split(d);
            let along = if sight.is_bent() { split.refracted } else { split.reflected };
            let apart = (DVec3::from(model.means[id]) - at).cross(along).length();
            // The crossing is exact to about the square root of rounding for steep rays.
            assert!(apart < 1e-7, "disk {id}: {apart}");
        }
    }
}

#[test]
fn mirrored_rays_go_straight_on() {
    let (camera, pose) = view();
    let water = water(false, false);
    let rays = surface_rays(&water, &camera, &pose, &[0.0; PIXELS]);
    let hits = (0..PIXELS).filter(|&i| rays.is_hit(i)).count();
    assert!(hits > 80, "{hits}");
    for i in (0..PIXELS).filter(|&i| rays.is_hit(i)) {
        let (up, down) = (rays.reflected[i], rays.refracted[i]);
        assert!((up.direction - camera.direction(i)).length() < 1e-12);
        assert!((up.origin - down.origin).length() < 1e-12 && (down.direction.length() - 1.0).abs() < 1e-12);
        assert!(up.origin.cross(up.direction).length() < 1e-12);
    }
    let dry = surface_rays(&water, &camera, &pose, &[0.9995; PIXELS]);
    assert!((0..PIXELS).all(|i| !dry.is_hit(i)));
}

#[test]
fn disks_on_the_other_side_of_the_surface_are_culled() {
    let (camera, pose) = view();
    let plane = water(false, false).plane;
    let [_, above, below] = sets(0);
    for (model, sight) in
        [(&below, Sight::reflected(&pose, &plane)), (&above, Sight::refracted(&pose, &plane))]
    {
        let disks = project_seen(model, &camera, &sight, 0, &RasterRules::HARD);
        assert!(disks.iter().all(Option::is_none));
    }
}

#[test]
fn the_per_hit_tracer_agrees_where_disks_do_not_cross() {
    let (camera, pose) = view();
    let plane = water(false, false).plane;
    let models = sets(0);
    let rays = surface_rays(&water(false, false), &camera, &pose, &[0.0; PIXELS]);
    let sight = Sight::refracted(&pose, &plane);
    let mut one = Gaussians64::zeros(1, 0);
    for p in 0..one.parameters() {
        *one.parameter_mut(0, p) = models[2].parameter(0, p);
    }
    let disks = project_seen(&one, &camera, &sight, 0, &RasterRules::HARD);
    let lists = intersect(&bounds_of(&disks), WIDTH, HEIGHT);
    let size = [WIDTH, HEIGHT];
    let tiled = trace_forward(&disks, &lists, &rays.refracted, size, BACKGROUND, &RasterRules::HARD);
    let whole = trace_per_hit(&disks, &rays.refracted, WIDTH, BACKGROUND, &RasterRules::HARD);
    for (i, (tiled, whole)) in tiled.raster.rgb.iter().zip(&whole).enumerate() {
        assert!((0..3).all(|c| (tiled[c] - whole[c]).abs() < 1e-12), "pixel {i}: {tiled:?}, {whole:?}");
    }
}

#[test]
fn an_outline_lies_in_its_ellipse() {
    let (camera, pose) = view();
    let sight = Sight::refracted(&pose, &water(false, false).plane);
    let mut model = disks(505, 60, 0, [-1.4, -0.6], DVec3::new(0.1, 1.0, -1.1));
    model.log_scales.iter_mut().for_each(|scales| *scales = [scales[0] - 1.0, scales[1] - 2.0, 0.0]);
    for (id, disk) in project_seen(&model, &camera, &sight, 0, &RasterRules::HARD).iter().enumerate() {
        let disk = disk.as_ref().expect("it is below the surface");
        let [a, b, c] = disk.bound.conic;
        for [x, y] in refracted_outline(disk, &sight, &camera, (2.0 * disk.bound.extent).sqrt(), 60) {
            let sigma = 0.5 * (a * x * x + c * y * y) + b * x * y;
            assert!(sigma <= disk.bound.extent, "disk {id}: {sigma} of {}", disk.bound.extent);
        }
    }
}

#[test]
fn the_plane_keeps_its_pivot_when_it_turns() {
    let mut plane = water(false, false).plane;
    let pivot = plane.offset * plane.normal + 0.7 * plane.normal.any_orthonormal_vector();
    let mut state = PlaneState::default();
    for step in 0..5 {
        state.step(&mut plane, [0.3, -0.2, f64::from(step), 0.0], [0.01, 0.0], pivot);
        assert!(plane.height(pivot).abs() < 1e-12 && (plane.normal.length() - 1.0).abs() < 1e-12);
    }
    let before = plane.offset;
    state.step(&mut plane, [0.0, 0.0, 0.0, 2.0], [0.0, 0.01], pivot);
    assert!(
        (before
            - plane.offset
            - 0.01 * 0.1 * 2.0
                / (1.0 - 0.9_f64.powi(6))
                / (0.001_f64 * 4.0 / (1.0 - 0.999_f64.powi(6))).sqrt())
        .abs()
            < 1e-12
    );
}

#[test]
fn a_mask_loss_has_the_gradient_of_its_squares() {
    let masks = [0.2, 0.9, 0.5];
    let (value, v) = mask_loss(&masks, |i| i == 0, 3.0);
    assert!((value - (0.04 + 0.01 + 0.25)).abs() < 1e-12, "{value}");
    for (v, expected) in v.into_iter().zip([0.4, -0.2, -1.0]) {
        assert!((v - expected).abs() < 1e-12, "{v} instead of {expected}");
    }
}
