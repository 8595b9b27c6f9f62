//! The loss mask of a task: only pixels that show its own region count.
//!
//! A camera of a partition sees beyond the partition's box. There the render is that of the coarse model,
//! blurred and frozen. Gaussians at the border would deform to compensate for that error, and the merge would
//! keep them. So each pixel's surface is located by the expected range of the coarse model, without haze and
//! background Gaussians. Pixels whose surface lies outside the box do not count in the loss. Open-water
//! pixels have no surface and do count, so that floaters in front of them raise the loss.

use std::sync::Arc;

use fathom_core::Result;
use fathom_core::gpu::{Rendered, Renderer};
use fathom_core::seams::SURFACE_ALPHA;
use fathom_core::surface::Surface;
use fathom_core::views::{PackedImage, RayMap, TrainView, ViewSource};
use glam::DVec3;

/// A view with a smaller share of counted pixels is excluded: it costs as much as the others and contributes
/// almost nothing.
const LEAST_SHARE: f64 = 0.03;

/// The surface point of each pixel, row-major, in world axes: the point of its ray at the expected range.
/// `None` if there is no surface. `rendered` shows the scene without `water`, through which the camera looks.
pub fn surfaces<'a>(
    rendered: &'a Rendered,
    view: &'a TrainView,
    water: Option<&'a Surface>,
) -> impl Iterator<Item = Option<DVec3>> + use<'a> {
    let camera = &view.camera;
    let (to_world, centre) = (view.pose.rotation.inverse(), view.pose.centre());
    rendered.alpha.iter().zip(&rendered.range).enumerate().map(move |(index, (&alpha, &range))| {
        (alpha >= SURFACE_ALPHA && range > 0.0)
            .then(|| centre + to_world * camera.direction(index) * f64::from(range / alpha))
            .map(|point| water.map_or(point, |water| water.seen_instead(centre, point)))
    })
}

/// One bit per pixel, row-major: whether it counts.
struct Mask(Vec<u64>);

impl Mask {
    fn of(
        rendered: &Rendered,
        view: &TrainView,
        water: Option<&Surface>,
        inside: impl Fn(DVec3) -> bool,
    ) -> Self {
        let mut bits = vec![0; rendered.alpha.len().div_ceil(64)];
        for (index, surface) in surfaces(rendered, view, water).enumerate() {
            bits[index / 64] |= u64::from(surface.is_none_or(&inside)) << (index % 64);
        }
        Self(bits)
    }

    fn counted(&self) -> u32 {
        self.0.iter().map(|word| word.count_ones()).sum()
    }

    fn apply(&self, image: &mut PackedImage) {
        for (index, pixel) in image.pixels.iter_mut().enumerate() {
            if self.0[index / 64] >> (index % 64) & 1 == 0 {
                *pixel &= 0x00ff_ffff;
            }
        }
    }
}

/// Views with a mask of the pixels that show a region.
pub struct LossMask {
    source: Arc<dyn ViewSource>,
    views: Vec<TrainView>,
    /// Index in the source, and the mask, unless all pixels count.
    kept: Vec<(usize, Option<Mask>)>,
}

impl LossMask {
    /// Renders every view and keeps the pixels whose surface is `inside`, through the surface of `water` if
    /// there is one. Calls `go_on` between views and
    /// returns `None` once it returns false. If no view shows the region, all pixels are kept.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(
        renderer: Renderer,
        water: Option<&Surface>,
        source: Arc<dyn ViewSource>,
        inside: impl Fn(DVec3) -> bool,
        go_on: impl Fn() -> bool,
    ) -> Result<Option<Self>> {
        let shown = |mask: &Mask, _: &Rendered, _: &TrainView| mask.counted() as usize;
        let own = Self::choose(renderer, water, source, inside, shown, go_on)?;
        Ok(own.map(|own| if own.kept.is_empty() { Self::all_of(own.source) } else { own }))
    }

    /// The same for views that show `what`: its surfaces fill at least [`LEAST_SHARE`] of their pixels. Open
    /// water does not count here, and there may be no such views.
    ///
    /// # Errors
    /// When the device fails.
    pub fn showing(
        what: impl Fn(DVec3) -> bool,
        renderer: Renderer,
        water: Option<&Surface>,
        source: Arc<dyn ViewSource>,
        inside: impl Fn(DVec3) -> bool,
        go_on: impl Fn() -> bool,
    ) -> Result<Option<Self>> {
        let shown = |_: &Mask, rendered: &Rendered, view: &TrainView| {
            surfaces(rendered, view, water).filter(|surface| surface.is_some_and(&what)).count()
        };
        Self::choose(renderer, water, source, inside, shown, go_on)
    }

    /// The views in which `shown` counts enough pixels, without the pixels whose surface is not `inside`.
    fn choose(
        mut renderer: Renderer,
        water: Option<&Surface>,
        source: Arc<dyn ViewSource>,
        inside: impl Fn(DVec3) -> bool,
        shown: impl Fn(&Mask, &Rendered, &TrainView) -> usize,
        go_on: impl Fn() -> bool,
    ) -> Result<Option<Self>> {
        let mut kept = Vec::new();
        for (index, view) in source.views().iter().enumerate() {
            if !go_on() {
                return Ok(None);
            }
            let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
            let mask = Mask::of(&rendered, view, water, &inside);
            let pixels = rendered.alpha.len();
            if shown(&mask, &rendered, view) as f64 >= LEAST_SHARE * pixels as f64 {
                kept.push((index, (mask.counted() as usize != pixels).then_some(mask)));
            }
        }
        tracing::debug!(views = kept.len(), of = source.views().len(), "views that show the region");
        let views = kept.iter().map(|(index, _)| source.views()[*index].clone()).collect();
        Ok(Some(Self { source, views, kept }))
    }

    /// All views with all their pixels.
    fn all_of(source: Arc<dyn ViewSource>) -> Self {
        let views = source.views().to_vec();
        Self { kept: (0..views.len()).map(|index| (index, None)).collect(), views, source }
    }
}

impl ViewSource for LossMask {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        let (at, mask) = &self.kept[index];
        let image = self.source.load(*at)?;
        let Some(mask) = mask else { return Ok(image) };
        let mut image = PackedImage::clone(&image);
        mask.apply(&mut image);
        Ok(Arc::new(image))
    }

    fn map(&self, index: usize) -> Option<&RayMap> {
        self.source.map(self.kept[index].0)
    }
}

#[cfg(test)]
mod tests {
    use fathom_core::gaussians::Gaussians;
    use fathom_core::gpu::device_for_test;
    use fathom_core::scene::{PinholeCamera, Pose};
    use fathom_core::views::InMemory;

    use super::*;

    /// A camera at the origin that looks along z; its pixels see x/z from -0.75 to 0.75 in steps of a half.
    fn view() -> TrainView {
        let camera = PinholeCamera { width: 4, height: 1, fx: 2.0, fy: 2.0, cx: 2.0, cy: 0.5 };
        TrainView {
            name: "v".into(),
            camera,
            pose: Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]),
            clear_range: 0.0,
        }
    }

    fn wall(alpha: f32) -> Rendered {
        // A wall at z = 10, seen through `alpha`: range is the sum of weight times distance.
        let range = [-0.75_f32, -0.25, 0.25, 0.75].map(|x| alpha * 10.0 * (1.0 + x * x).sqrt());
        Rendered { width: 4, height: 1, rgb: vec![[0.0; 3]; 4], alpha: vec![alpha; 4], range: range.into() }
    }

    /// An opaque wall at z = 5 from x = -8 to 8.
    fn wall_of_gaussians() -> Gaussians {
        let mut wall = Gaussians::empty(0);
        for (x, y) in (-16..=16).flat_map(|x| (-6..=6).map(move |y| (x, y))) {
            wall.means.push([x as f32 / 2.0, y as f32 / 2.0, 5.0]);
            wall.quats.push([1.0, 0.0, 0.0, 0.0]);
            wall.log_scales.push([0.4_f32.ln(), 0.4_f32.ln(), 0.01_f32.ln()]);
            wall.opacity_logits.push(4.0);
            wall.sh_coeffs.push([0.0; 3]);
        }
        wall
    }

    #[test]
    fn views_of_another_region_are_excluded() {
        let Some(gpu) = device_for_test("the masks of a partition") else { return };
        // Looks at x from -2 to 2 around its own x: on the wall in steps of an eighth.
        let camera = PinholeCamera { width: 32, height: 24, fx: 40.0, fy: 40.0, cx: 16.0, cy: 12.0 };
        let at = |name: &str, x: f64| {
            let pose = Pose::looking_at(DVec3::X * x, DVec3::new(x, 0.0, 5.0), DVec3::Y);
            TrainView { name: name.into(), camera, pose, clear_range: 0.0 }
        };
        let views = vec![at("left", -4.0), at("middle", 0.0), at("right", 4.0)];
        let numbered =
            |index: u32| PackedImage { width: 32, height: 24, pixels: vec![0xff00_0000 + index; 32 * 24] };
        let source: Arc<dyn ViewSource> =
            Arc::new(InMemory { views, images: (0..3).map(|index| Arc::new(numbered(index))).collect() });
        let renderer = || Renderer::new(Arc::clone(&gpu), &wall_of_gaussians()).unwrap();
        let masks = |inside: fn(DVec3) -> bool| {
            LossMask::new(renderer(), None, Arc::clone(&source), inside, || true).unwrap().unwrap()
        };

        let right = masks(|point| point.x > 0.0);
        let names: Vec<&str> = right.views().iter().map(|view| view.name.as_str()).collect();
        assert_eq!(names, ["middle", "right"]);
        assert!(right.load(1).unwrap().pixels.iter().all(|&pixel| pixel == 0xff00_0002));
        let middle = right.load(0).unwrap();
        for (index, &pixel) in middle.pixels.iter().enumerate() {
            let column = index % 32;
            // At the border, the range is blended across it.
            if !(13..19).contains(&column) {
                let expected = if column < 16 { 0x0000_0001 } else { 0xff00_0001 };
                assert_eq!(pixel, expected, "pixel {index}");
            }
        }

        let nowhere = masks(|_| false);
        assert_eq!(nowhere.views().len(), 3, "a region that no view shows keeps all views");
        assert!(nowhere.load(0).unwrap().pixels.iter().all(|&pixel| pixel == 0xff00_0000));
        // Views of the strip beside the border learn from everything right of it.
        let strip = |point: DVec3| point.x > 0.0 && point.x < 1.0;
        let showing = |what: fn(DVec3) -> bool| {
            LossMask::showing(what, renderer(), None, Arc::clone(&source), |p| p.x > 0.0, || true)
                .unwrap()
                .unwrap()
        };
        let beside = showing(strip);
        assert_eq!(beside.views().iter().map(|view| view.name.as_str()).collect::<Vec<_>>(), ["middle"]);
        assert_eq!(beside.load(0).unwrap().pixels, middle.pixels);
        assert!(showing(|_| false).views().is_empty(), "a view shows nothing of it");

        let stopped = LossMask::new(renderer(), None, source, |_| true, || false).unwrap();
        assert!(stopped.is_none(), "it did not stop when asked to");
    }

    #[test]
    fn a_pixel_counts_where_the_surface_behind_it_is_inside() {
        for alpha in [1.0, 0.6] {
            // The pixels look at x = -7.5, -2.5, 2.5 and 7.5 on the wall.
            let mask = Mask::of(&wall(alpha), &view(), None, |point| {
                assert!((point.z - 10.0).abs() < 1e-5, "{point}");
                point.x < 0.0 && point.x > -5.0
            });
            assert_eq!(mask.0, [0b0010], "at alpha {alpha}");
        }
        let turned =
            TrainView { pose: Pose::looking_at([3.0, 0.0, 0.0].into(), DVec3::X * 9.0, DVec3::Y), ..view() };
        // Now the camera is at x = 3 and looks along x: picture x is world -z.
        let mask = Mask::of(&wall(1.0), &turned, None, |p| (p.x - 13.0).abs() < 1e-5 && p.z < 0.0);
        assert_eq!(mask.0, [0b1100]);
    }

    #[test]
    fn open_water_counts() {
        assert_eq!(Mask::of(&wall(0.4), &view(), None, |_| false).0, [0b1111]);
    }

    #[test]
    fn uncounted_pixels_keep_their_colour_and_lose_their_mask() {
        let views = vec![view(), view()];
        let kept = vec![(1, Some(Mask(vec![0b0101]))), (0, None)];
        let own = LossMask { source: Arc::new(InMemory::plain(views.clone(), u32::MAX)), views, kept };
        assert_eq!(own.load(0).unwrap().pixels, [u32::MAX, 0x00ff_ffff, u32::MAX, 0x00ff_ffff]);
        assert_eq!(own.load(1).unwrap().pixels, [u32::MAX; 4]);
    }
}
