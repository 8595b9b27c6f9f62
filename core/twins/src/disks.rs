//! 2D Gaussians: disks, evaluated where the ray of a pixel meets their plane (Huang et al. 2024, "2DGS").
//!
//! A disk has a centre, two axes t_u, t_v of unit length and two scales. In place of a third scale it has the
//! logit of its mask. Let m be the centre and o + t d the ray, both in the camera's frame. With
//! a_u = t_u / s_u, a_v = t_v / s_v and N = a_u x a_v:
//!
//! ```text
//! t = N.(m - o) / (N.d),   p = o + t d - m,   u = a_u.p,   v = a_v.p
//! sigma = min(u^2 + v^2, |centre - pixel|^2 / DISK_BLUR) / 2   (eq. 11: never thinner than about a pixel)
//! range = t |d|, or |m| where the second term decides
//! ```
//!
//! Blending is that of `rasterize_forward`; normals and masks are blended as colours are. A ray that meets
//! the plane nearer than NEAR, or not at all, sees only the second term. Disks are sorted by the depth of
//! their centres.
//!
//! Which tiles a disk touches follows from its exact outline. The points m + r (s_u cos t_u + s_v sin t_v)
//! project to an ellipse as long as all of them lie in front of the camera. [`Disk::bound`] has it, widened
//! to hold the circle of the second term too. A disk that reaches behind the camera may be anywhere: its
//! bound is the whole image.

use glam::{DMat3, DVec2, DVec3};

use super::project_backward::quat_backward;
use super::project_forward::{active_coeffs, norm, rotation_matrix, sigmoid};
use super::{
    DISK_BLUR, Gaussians64, NEAR, Raster, RasterGradients, RasterRules, Sight, Splat, TILE, TileLists,
    sh_colour, sh_colour_backward,
};
use fathom_core::scene::{PinholeCamera, Pose};

/// A ray in the camera's frame, scene units. `direction` has z = 1 for a ray from the eye.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DiskRay {
    /// Where it begins.
    pub origin: DVec3,
    /// Where it goes; of any length.
    pub direction: DVec3,
    /// Parameter from which on it meets disks; infinite for a pixel without a ray.
    pub nearest: f64,
}

impl DiskRay {
    /// For a pixel without a ray: it shows the background.
    pub const NONE: Self = Self { origin: DVec3::ZERO, direction: DVec3::Z, nearest: f64::INFINITY };
}

/// The rays of the pixels of a camera, row-major.
pub fn pinhole_rays(camera: &PinholeCamera) -> Vec<DiskRay> {
    let ray = |i: u32| {
        let (x, y) = (f64::from(i % camera.width) + 0.5, f64::from(i / camera.width) + 0.5);
        let direction = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0);
        DiskRay { origin: DVec3::ZERO, direction, nearest: NEAR }
    };
    (0..camera.width * camera.height).map(ray).collect()
}

/// A disk in one camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disk {
    /// Centre, camera axes, scene units.
    pub centre: DVec3,
    /// a_u and a_v, camera axes, 1/scene unit.
    pub axes: [DVec3; 2],
    /// Unit normal towards the camera, camera axes.
    pub normal: DVec3,
    /// The projected centre, pixels from the top-left corner.
    pub centre2d: [f64; 2],
    /// 1 for a disk of the scene above a water surface, blended as a colour is.
    pub mask: f64,
    /// An ellipse that holds all pixels whose alpha reaches `min_alpha`, for `intersect`. It also has the
    /// colour, the opacity, the range of the centre and the depth.
    pub bound: Splat,
}

/// Projects every disk; `None` where it is culled.
pub fn project_disks(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    rules: &RasterRules,
) -> Vec<Option<Disk>> {
    project_seen(model, camera, &Sight::straight(pose), sh_degree, rules)
}

/// The same for disks that are seen straight, mirrored or refracted.
pub fn project_seen(
    model: &Gaussians64,
    camera: &PinholeCamera,
    sight: &Sight,
    sh_degree: u8,
    rules: &RasterRules,
) -> Vec<Option<Disk>> {
    (0..model.len()).map(|index| project(model, index, camera, sight, sh_degree, rules)).collect()
}

/// The bounds, as `intersect` takes them.
pub fn bounds_of(disks: &[Option<Disk>]) -> Vec<Option<Splat>> {
    disks.iter().map(|disk| disk.map(|disk| disk.bound)).collect()
}

fn project(
    model: &Gaussians64,
    index: usize,
    camera: &PinholeCamera,
    sight: &Sight,
    sh_degree: u8,
    rules: &RasterRules,
) -> Option<Disk> {
    let finite = model.means[index].iter().all(|v| v.is_finite())
        && model.quats[index].iter().all(|v| v.is_finite())
        && model.log_scales[index].iter().all(|v| v.is_finite())
        && model.opacity_logits[index].is_finite();
    let quat_norm = norm(model.quats[index]);
    let opacity = sigmoid(model.opacity_logits[index]);
    let m = sight.transform(model.means[index].into());
    let seen = sight.apparent(m)?;
    if !(finite
        && quat_norm > 0.0
        && quat_norm.is_finite()
        && seen.z > NEAR
        && sight.reaches(model.means[index].into())
        && opacity > 0.0
        && opacity >= rules.min_alpha)
    {
        return None;
    }
    let scales = [0, 1].map(|k| model.log_scales[index][k].exp());
    let turned = sight.world_to_camera * rotation_matrix(model.quats[index]);
    let axes = [turned.x_axis / scales[0], turned.y_axis / scales[1]];
    let line = m - sight.start(m);
    let facing = turned.z_axis.dot(line);
    let centre2d = [camera.fx * seen.x / seen.z + camera.cx, camera.fy * seen.y / seen.z + camera.cy];
    let direction = (sight.world_to_camera.transpose() * line).normalize();
    let rgb = sh_colour(direction, active_coeffs(model, index, sh_degree));
    let extent = (opacity / rules.min_alpha).ln();
    let reach = (2.0 * extent).sqrt();
    let half = [0, 1].map(|k| turned.col(k) * scales[k]);
    let ellipse = if sight.is_bent() {
        sight.ellipse(m, half, reach, camera).map(|cov| (DVec2::ZERO, cov))
    } else {
        outline(m, half, reach, camera).or_else(|| {
            // Only the circle of the low-pass is left.
            is_beside(m, half, reach, camera).then_some((DVec2::ZERO, [DISK_BLUR, 0.0, DISK_BLUR]))
        })
    };
    let (offset, [xx, xy, yy]) = ellipse.unwrap_or_else(|| whole_image(camera, centre2d, reach));
    let determinant = xx * yy - xy * xy;
    let bound = Splat {
        mean2d: [centre2d[0] + offset.x, centre2d[1] + offset.y],
        conic: [yy / determinant, -xy / determinant, xx / determinant],
        rgb,
        opacity,
        range: line.length(),
        depth: sight.depth(m),
        extent,
        half_size: [(2.0 * extent * xx).sqrt(), (2.0 * extent * yy).sqrt()],
    };
    let finite = scales.iter().all(|scale| scale.is_finite())
        && axes.iter().all(|axis| axis.is_finite())
        && axes[0].cross(axes[1]).is_finite()
        && rgb.iter().chain(&bound.mean2d).chain(&bound.conic).all(|v| v.is_finite());
    (finite && determinant > 0.0).then_some(Disk {
        centre: m,
        axes,
        normal: if facing > 0.0 { -turned.z_axis } else { turned.z_axis },
        centre2d,
        mask: sigmoid(model.log_scales[index][2]),
        bound,
    })
}

/// As [`outline`], an ellipse that holds the image.
fn whole_image(camera: &PinholeCamera, centre2d: [f64; 2], reach: f64) -> (DVec2, [f64; 3]) {
    let half = 0.5 * DVec2::new(camera.width.into(), camera.height.into());
    let wide = (half.length() + 1.0) / if reach.is_finite() { reach.max(LEAST_REACH) } else { 1.0 };
    (half - DVec2::from(centre2d), [wide * wide, 0.0, wide * wide])
}

/// Whether all of a disk of radius `reach` (in standard deviations) lies behind one of the planes through the
/// eye and an edge of the image.
fn is_beside(m: DVec3, half: [DVec3; 2], reach: f64, camera: &PinholeCamera) -> bool {
    let least = [-camera.cx / camera.fx, -camera.cy / camera.fy];
    let most =
        [least[0] + f64::from(camera.width) / camera.fx, least[1] + f64::from(camera.height) / camera.fy];
    let planes = [
        DVec3::new(1.0, 0.0, -least[0]),
        DVec3::new(-1.0, 0.0, most[0]),
        DVec3::new(0.0, 1.0, -least[1]),
        DVec3::new(0.0, -1.0, most[1]),
    ];
    // Its nearest point is this far in front of the plane.
    planes.iter().any(|n| n.dot(m) + reach * DVec2::from(half.map(|axis| n.dot(axis))).length() < 0.0)
}

/// The ellipse that a disk of radius `reach` (in standard deviations) fills, with the circle of the low-pass.
/// Its offset from the projected centre is in pixels, and its covariance (xx, xy, yy) in px^2. `None` where
/// the disk reaches behind the camera, and without an edge.
///
/// The dual conic of the outline is H diag(r^2, r^2, -1) H^T with H = (s_u t_u, s_v t_v, m). A shear that
/// moves m onto the optical axis keeps the image up to a shift and leaves no difference of large numbers.
fn outline(m: DVec3, half: [DVec3; 2], reach: f64, camera: &PinholeCamera) -> Option<(DVec2, [f64; 3])> {
    let squared = reach * reach;
    let left = m.z * m.z - squared * (half[0].z * half[0].z + half[1].z * half[1].z);
    if !(reach.is_finite() && left > LEAST_IN_FRONT * m.z * m.z) {
        return None;
    }
    let focal = DVec2::new(camera.fx, camera.fy);
    let sheared = half.map(|axis| focal * (axis.truncate() - axis.z / m.z * m.truncate()));
    let offset = -(squared / left) * (sheared[0] * half[0].z + sheared[1] * half[1].z);
    let share = |a: f64, b: f64, c: f64, d: f64| (a * b + c * d) / left;
    let [p, q] = sheared;
    // Of one standard deviation: `reach` of them are the outline.
    let from_centre = offset / reach.max(LEAST_REACH);
    let pad = (DISK_BLUR.sqrt() + offset.length() / reach.max(LEAST_REACH)).powi(2);
    Some((
        offset,
        [
            share(p.x, p.x, q.x, q.x) + from_centre.x * from_centre.x + pad,
            share(p.x, p.y, q.x, q.y) + from_centre.x * from_centre.y,
            share(p.y, p.y, q.y, q.y) + from_centre.y * from_centre.y + pad,
        ],
    ))
}

/// Share of the squared depth that the nearest point of a disk must keep for its outline to be an ellipse of
/// moderate size.
const LEAST_IN_FRONT: f64 = 1e-2;
/// Opacities of almost 1/255 reach nowhere; no division by that.
const LEAST_REACH: f64 = 1e-3;

/// A rendered view of disks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DiskRaster {
    /// Colour, alpha, range.
    pub raster: Raster,
    /// Sum of alpha T normal, camera axes, `[H*W]`.
    pub normal: Vec<[f64; 3]>,
    /// Sum of alpha T mask, `[H*W]`.
    pub mask: Vec<f64>,
}

/// Gradient of the loss with respect to a [`DiskRaster`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DiskRasterGradients {
    /// With respect to colour, alpha and range.
    pub raster: RasterGradients,
    /// With respect to the normals, `[H*W]`.
    pub normal: Vec<[f64; 3]>,
    /// With respect to the masks, `[H*W]`.
    pub mask: Vec<f64>,
}

/// One disk at one pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Contribution {
    /// (u, v) and the parameter of the ray; `None` where the low-pass decides.
    pub hit: Option<(f64, f64, f64)>,
    falloff: f64,
    pub alpha: f64,
    capped: bool,
    range: f64,
}

pub(super) fn contribution(
    disk: &Disk,
    pixel: [f64; 2],
    ray: &DiskRay,
    rules: &RasterRules,
) -> Option<Contribution> {
    if !ray.nearest.is_finite() {
        return None;
    }
    let [a_u, a_v] = disk.axes;
    let normal = a_u.cross(a_v);
    let t = normal.dot(disk.centre - ray.origin) / normal.dot(ray.direction);
    let p = ray.origin + t * ray.direction - disk.centre;
    let (u, v) = (a_u.dot(p), a_v.dot(p));
    let delta = DVec2::from(disk.centre2d) - DVec2::from(pixel);
    let (solid, thin) = (u * u + v * v, delta.length_squared() / DISK_BLUR);
    let is_hit = t > ray.nearest && solid <= thin;
    let falloff = (-0.5 * if is_hit { solid } else { thin }).exp();
    let full = disk.bound.opacity * falloff;
    let alpha = full.min(rules.max_alpha);
    (alpha >= rules.min_alpha).then_some(Contribution {
        hit: is_hit.then_some((u, v, t)),
        falloff,
        alpha,
        capped: full > rules.max_alpha,
        range: if is_hit { t * ray.direction.length() } else { disk.bound.range },
    })
}

pub(super) fn pixel_at(x: u32, y: u32) -> [f64; 2] {
    [f64::from(x) + 0.5, f64::from(y) + 0.5]
}

/// Blends the disks of `lists` along `rays`, over `background`.
pub fn trace_forward(
    disks: &[Option<Disk>],
    lists: &TileLists,
    rays: &[DiskRay],
    [width, height]: [u32; 2],
    background: [f64; 3],
    rules: &RasterRules,
) -> DiskRaster {
    let pixels = rays.len();
    let mut out = DiskRaster {
        raster: Raster {
            width,
            height,
            rgb: vec![[0.0; 3]; pixels],
            alpha: vec![0.0; pixels],
            range: vec![0.0; pixels],
            transmittance: vec![1.0; pixels],
            last: vec![0; pixels],
        },
        normal: vec![[0.0; 3]; pixels],
        mask: vec![0.0; pixels],
    };
    for (pixel, ray) in rays.iter().enumerate() {
        let (x, y) = (pixel as u32 % width, pixel as u32 / width);
        let (mut rgb, mut range, mut normal, mut mask) = (DVec3::ZERO, 0.0, DVec3::ZERO, 0.0);
        let (mut transmittance, mut last) = (1.0, 0);
        for (&id, seen) in lists.of_tile(x / TILE, y / TILE).iter().zip(1..) {
            let Some(disk) = &disks[id as usize] else { continue };
            let Some(at) = contribution(disk, pixel_at(x, y), ray, rules) else { continue };
            let next = transmittance * (1.0 - at.alpha);
            if next < rules.min_transmittance {
                break;
            }
            let weight = at.alpha * transmittance;
            rgb += weight * DVec3::from(disk.bound.rgb);
            range += weight * at.range;
            normal += weight * disk.normal;
            mask += weight * disk.mask;
            transmittance = next;
            last = seen;
        }
        let raster = &mut out.raster;
        raster.rgb[pixel] = (rgb + transmittance * DVec3::from(background)).into();
        raster.alpha[pixel] = 1.0 - transmittance;
        raster.range[pixel] = range;
        raster.transmittance[pixel] = transmittance;
        raster.last[pixel] = last;
        out.normal[pixel] = normal.into();
        out.mask[pixel] = mask;
    }
    out
}

/// Gradient of the loss with respect to one [`Disk`], and its statistics for density control. All numbers are
/// sums over pixels in the coordinates of the disk. tau is the gradient with respect to t, divided by N.d.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DiskGradient {
    /// With respect to u and v.
    pub uv: [f64; 2],
    /// tau.
    pub tau: f64,
    /// With respect to u times u, u times v, v times u, v times v.
    pub products: [f64; 4],
    /// tau u and tau v.
    pub tau_uv: [f64; 2],
    /// With respect to the projected centre, per pixel, where the low-pass decides.
    pub centre2d: [f64; 2],
    /// With respect to the range of the centre, where the low-pass decides.
    pub range: f64,
    /// With respect to the normal, along t_u and t_v.
    pub normal: [f64; 2],
    /// With respect to the colour.
    pub rgb: [f64; 3],
    /// With respect to the mask.
    pub mask: f64,
    /// With respect to the opacity (after the sigmoid).
    pub opacity: f64,
    /// Sum of the absolute gradients with respect to the position on the image, x and y, per pixel; as
    /// [`SplatGradient::abs`](super::SplatGradient::abs). Not a gradient.
    pub abs: f64,
    /// Sum of alpha T. Not a gradient.
    pub contribution: f64,
}

/// Gradient of the loss with respect to a [`DiskRay`], where disks decide and not the low-pass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayGradient {
    /// With respect to where it begins.
    pub origin: DVec3,
    /// With respect to where it goes.
    pub direction: DVec3,
}

/// Backward pass of [`trace_forward`]; see `rasterize_backward` for the gradient through alpha.
pub fn trace_backward(
    disks: &[Option<Disk>],
    lists: &TileLists,
    rays: &[DiskRay],
    camera: &PinholeCamera,
    forward: &DiskRaster,
    background: [f64; 3],
    rules: &RasterRules,
    v: &DiskRasterGradients,
) -> Vec<DiskGradient> {
    trace_backward_along(disks, lists, rays, camera, forward, background, rules, v).0
}

/// The same, and the gradients of the rays.
pub fn trace_backward_along(
    disks: &[Option<Disk>],
    lists: &TileLists,
    rays: &[DiskRay],
    camera: &PinholeCamera,
    forward: &DiskRaster,
    background: [f64; 3],
    rules: &RasterRules,
    v: &DiskRasterGradients,
) -> (Vec<DiskGradient>, Vec<RayGradient>) {
    let mut v_disks = vec![DiskGradient::default(); disks.len()];
    let mut v_rays = vec![RayGradient::default(); rays.len()];
    let background = DVec3::from(background);
    for (pixel, ray) in rays.iter().enumerate() {
        let (x, y) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
        let [v_rgb, v_normal] = [v.raster.rgb[pixel], v.normal[pixel]].map(DVec3::from);
        let (v_alpha, v_range, v_mask) = (v.raster.alpha[pixel], v.raster.range[pixel], v.mask[pixel]);
        let behind_all = forward.raster.transmittance[pixel] * (background.dot(v_rgb) - v_alpha);
        let ids = &lists.of_tile(x / TILE, y / TILE)[..forward.raster.last[pixel] as usize];
        let seen = ids.iter().filter_map(|&id| {
            let disk = disks[id as usize].as_ref()?;
            let at = contribution(disk, pixel_at(x, y), ray, rules)?;
            let value = v_rgb.dot(disk.bound.rgb.into())
                + at.range * v_range
                + v_normal.dot(disk.normal)
                + disk.mask * v_mask;
            Some((id as usize, disk, at, value))
        });
        let seen: Vec<_> = seen.collect();
        let (mut behind, mut transmittance) = (0.0, 1.0);
        for (_, _, at, value) in &seen {
            behind += at.alpha * transmittance * value;
            transmittance *= 1.0 - at.alpha;
        }
        transmittance = 1.0;
        for (id, disk, at, value) in seen {
            let weight = at.alpha * transmittance;
            behind -= weight * value;
            let v_this = transmittance * value - (behind + behind_all) / (1.0 - at.alpha);
            transmittance *= 1.0 - at.alpha;
            let v_pixel = PixelGradient {
                rgb: weight * v_rgb,
                normal: weight * v_normal,
                range: weight * v_range,
                opacity: if at.capped { 0.0 } else { at.falloff * v_this },
                sigma: if at.capped { 0.0 } else { -at.alpha * v_this },
            };
            let sum = &mut v_disks[id];
            sum.contribution += weight;
            sum.mask += weight * v_mask;
            add(sum, &mut v_rays[pixel], disk, &at, ray, pixel_at(x, y), camera, &v_pixel);
        }
    }
    (v_disks, v_rays)
}

/// Gradients at one pixel, of what a disk adds there.
struct PixelGradient {
    rgb: DVec3,
    normal: DVec3,
    range: f64,
    opacity: f64,
    sigma: f64,
}

fn add(
    sum: &mut DiskGradient,
    v_ray: &mut RayGradient,
    disk: &Disk,
    at: &Contribution,
    ray: &DiskRay,
    pixel: [f64; 2],
    camera: &PinholeCamera,
    v: &PixelGradient,
) {
    let [a_u, a_v] = disk.axes;
    (0..3).for_each(|c| sum.rgb[c] += v.rgb[c]);
    sum.opacity += v.opacity;
    sum.normal[0] += v.normal.dot(a_u) / a_u.length();
    sum.normal[1] += v.normal.dot(a_v) / a_v.length();
    let on_image = match at.hit {
        Some((u, w, t)) => {
            let d = ray.direction;
            let steep = a_u.cross(a_v).dot(d);
            let (v_u, v_w) = (v.sigma * u, v.sigma * w);
            let v_p = v_u * a_u + v_w * a_v;
            let tau = (v_p.dot(d) + v.range * d.length()) / steep;
            sum.uv[0] += v_u;
            sum.uv[1] += v_w;
            sum.tau += tau;
            for (product, value) in sum.products.iter_mut().zip([v_u * u, v_u * w, v_w * u, v_w * w]) {
                *product += value;
            }
            sum.tau_uv[0] += tau * u;
            sum.tau_uv[1] += tau * w;
            let v_met = v_p - tau * a_u.cross(a_v);
            v_ray.origin += v_met;
            v_ray.direction += t * v_met + v.range * t / d.length() * d;
            // How sigma changes when the pixel moves over the plane.
            let slope = a_u.cross(a_v) * (v_p.dot(d) / steep);
            let depth = ray.origin.z + t * d.z;
            depth * (v_p - slope).truncate() / DVec2::new(camera.fx, camera.fy)
        }
        None => {
            let v_centre = v.sigma / DISK_BLUR * (DVec2::from(disk.centre2d) - DVec2::from(pixel));
            sum.centre2d[0] += v_centre.x;
            sum.centre2d[1] += v_centre.y;
            sum.range += v.range;
            v_centre
        }
    };
    sum.abs += on_image.x.abs() + on_image.y.abs();
}

/// Gradient of the model from the gradient of its disks, both by Gaussian; culled ones get zeros. That of the
/// third scale is the gradient of the logit of the mask.
pub fn project_disks_backward(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    disks: &[Option<Disk>],
    v_disks: &[DiskGradient],
) -> Gaussians64 {
    project_seen_backward(model, camera, &Sight::straight(pose), sh_degree, disks, v_disks)
}

/// The same for disks that are seen straight, mirrored or refracted. Only in the first case they have ranges
/// and normals with gradients.
pub fn project_seen_backward(
    model: &Gaussians64,
    camera: &PinholeCamera,
    sight: &Sight,
    sh_degree: u8,
    disks: &[Option<Disk>],
    v_disks: &[DiskGradient],
) -> Gaussians64 {
    let mut v_model = Gaussians64::zeros(model.len(), model.sh_degree);
    let camera_to_world = sight.world_to_camera.transpose();
    for (index, (disk, v)) in disks.iter().zip(v_disks).enumerate() {
        let Some(disk) = disk else { continue };
        let [a_u, a_v] = disk.axes;
        let m = disk.centre;
        let normal = a_u.cross(a_v);
        let half = [a_u, a_v].map(|axis| axis / axis.length_squared());
        // u = a_u.p with p = u s_u t_u + v s_v t_v; t = N.(m - o) / (N.d).
        let v_normal = -(v.tau_uv[0] * half[0] + v.tau_uv[1] * half[1]);
        let v_u = v.products[0] * half[0] + v.products[1] * half[1] + a_v.cross(v_normal);
        let v_v = v.products[2] * half[0] + v.products[3] * half[1] + v_normal.cross(a_u);
        let v_mask = v.mask * disk.mask * (1.0 - disk.mask);
        v_model.log_scales[index] = [-v_u.dot(a_u), -v_v.dot(a_v), v_mask];

        let unit = half.map(DVec3::normalize);
        let side = if disk.normal.dot(normal) < 0.0 { -1.0 } else { 1.0 };
        let v_facing = side * (v.normal[0] * unit[0] + v.normal[1] * unit[1]);
        let v_turned = DMat3::from_cols(v_u * a_u.length(), v_v * a_v.length(), v_facing);
        v_model.quats[index] = quat_backward(model.quats[index], camera_to_world * v_turned);

        let seen = sight.apparent(m).unwrap_or(m);
        let inv_z = 1.0 / seen.z;
        let v_centre = DVec2::from(v.centre2d) * DVec2::new(camera.fx, camera.fy);
        let v_seen = DVec3::new(v_centre.x, v_centre.y, -v_centre.dot(seen.truncate()) * inv_z) * inv_z;
        let mut v_m = v.tau * normal - v.uv[0] * a_u - v.uv[1] * a_v + sight.pulled(m, v_seen);
        if !sight.is_bent() {
            v_m += v.range / m.length() * m;
        }

        let line = m - sight.start(m);
        let distance = line.length();
        let direction = camera_to_world * line / distance;
        let coeffs = active_coeffs(model, index, sh_degree);
        let first = index * model.coeffs();
        let v_coeffs = &mut v_model.sh_coeffs[first..first + coeffs.len()];
        let v_direction = sh_colour_backward(direction, coeffs, v.rgb, v_coeffs);
        let v_line = (v_direction - direction * direction.dot(v_direction)) / distance;
        v_m += sight.offset_pulled(m, sight.world_to_camera * v_line);
        v_model.means[index] = (camera_to_world * v_m).into();
        let opacity = disk.bound.opacity;
        v_model.opacity_logits[index] = v.opacity * opacity * (1.0 - opacity);
    }
    v_model
}

#[cfg(test)]
mod tests;
