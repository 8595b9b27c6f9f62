//! Surfaces that must stay covered although the photographs hardly constrain them. They are sparse points
//! that several training views saw, all from so far away that the water has taken half of the light.
//!
//! A fog of faint Gaussians around such a surface looks the same in views along the surface, because they
//! look through much of the fog. A view from above looks through little of it and shows a hole. No loss of a
//! view detects that, so the Gaussians are checked directly. Around each of these points their opacities must
//! add up to a cover, from any direction.

use std::collections::HashMap;

use glam::{DVec3, Mat3, Quat, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::MediumRun;
use super::init::{gaussians_from_points, searchable};
use crate::Result;
use crate::config::TrainConfig;
use crate::gaussians::{Gaussians, Transform};
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::scene::Points;
use crate::views::TrainView;
use crate::water::Water;

/// Smallest number of views that must have seen a point.
const LEAST_VIEWS: usize = 2;
/// Opacity of a Gaussian that covers a point.
const OPACITY: f32 = 0.9;
/// Distance of a sparse point from its surface, as a share of the distance to its neighbours.
const OFF: f32 = 0.5;
/// Largest standard deviation of a covering Gaussian, relative to their median.
const WIDEST: f32 = 2.0;
/// Distance beyond which a Gaussian covers nothing, in standard deviations.
const REACH: f32 = 3.0;
/// Gaussians with less alpha at a point are ignored.
const LEAST: f32 = 0.01;
/// At most one point per this many Gaussians of the cap.
const SHARE_OF_CAP: u32 = 2;
/// Noise of a point's colour, relative to the spread of the colours of a scene.
const NOISE: f64 = 0.05;
/// Gaussians whose cover one thread adds up.
const CHUNK: usize = 8192;

/// Gaussians that cover surfaces which the photographs hardly constrain. There is one for each sparse point
/// that at least two of the views saw, all from farther than [`crate::water::Water::half_distance`]. In clear
/// water there are none.
///
/// `points` have the colours of J; points that are not `inside` are left out. `scene_views` as
/// [`crate::water::observe`] takes them.
///
/// # Errors
/// When a position is not finite.
pub fn surface_points(
    points: &Points,
    views: &[TrainView],
    scene_views: &[u32],
    config: &TrainConfig,
    medium: Option<&MediumRun>,
    inside: impl Fn([f32; 3]) -> bool,
) -> Result<Gaussians> {
    let none = Gaussians::empty(config.sh_degree);
    let Some(medium) = medium.filter(|medium| medium.least_cover() > 0.0) else { return Ok(none) };
    let half = medium.water.half_distance();
    let centres: HashMap<u32, DVec3> =
        scene_views.iter().zip(views).map(|(index, view)| (*index, view.pose.centre())).collect();
    let nearest = |point: usize| -> Option<f64> {
        let position = DVec3::from(points.positions[point].map(f64::from));
        let tracked = points.tracks.of(point);
        let seen_from: Vec<&DVec3> = match points.tracks.is_empty() {
            true => centres.values().collect(),
            false => tracked.iter().filter_map(|view| centres.get(view)).collect(),
        };
        let nearest = seen_from.iter().map(|centre| centre.distance(position)).fold(f64::INFINITY, f64::min);
        (seen_from.len() >= LEAST_VIEWS).then_some(nearest)
    };
    let nearest: Vec<Option<f64>> = (0..points.len()).into_par_iter().map(nearest).collect();
    let usual = UsualColour::of(points, &nearest, &medium.water);
    let kept: Vec<(usize, f64)> = nearest
        .into_iter()
        .enumerate()
        .filter_map(|(point, nearest)| nearest.map(|range| (point, range)))
        .filter(|(point, range)| *range > half && inside(points.positions[*point]))
        .collect();
    let most = (config.max_gaussians / SHARE_OF_CAP) as usize;
    let step = kept.len().div_ceil(most.max(1)).max(1);
    let kept: Vec<(usize, f64)> = kept.into_iter().step_by(step).collect();
    if kept.is_empty() {
        return Ok(none);
    }
    let chosen = Points {
        positions: kept.iter().map(|&(point, _)| points.positions[point]).collect(),
        colours: kept.iter().map(|&(point, range)| usual.lead(points.colours[point], range)).collect(),
        ..Points::default()
    };
    let mut model = gaussians_from_points(&chosen, OPACITY, config.sh_degree)?;
    // The Gaussian of an isolated point would be as wide as the scene.
    let mut widths: Vec<f32> = model.log_scales.iter().map(|scale| scale[0]).collect();
    let at = widths.len() / 2;
    let widest = *widths.select_nth_unstable_by(at, f32::total_cmp).1 + WIDEST.ln();
    model.log_scales.iter_mut().for_each(|scale| *scale = scale.map(|log| log.min(widest)));
    Ok(model)
}

/// Mean colour of the points of a scene: the estimate for a colour whose light does not arrive.
struct UsualColour<'a> {
    water: &'a Water,
    /// J, linear light.
    mean: [f64; 3],
}

impl<'a> UsualColour<'a> {
    /// `nearest`: range of the nearest view that saw each point.
    fn of(points: &Points, nearest: &[Option<f64>], water: &'a Water) -> Self {
        let (mut sums, mut weights) = ([0.0; 3], [f64::MIN_POSITIVE; 3]);
        for (colour, range) in points.colours.iter().zip(nearest) {
            let Some(range) = range else { continue };
            for (c, through) in through(water, *range).into_iter().enumerate() {
                let weight = through * through;
                sums[c] += weight * srgb_to_linear(f64::from(colour[c]) / 255.0);
                weights[c] += weight;
            }
        }
        Self { water, mean: std::array::from_fn(|c| sums[c] / weights[c]) }
    }

    /// `colour`, moved towards the mean by the ratio of variances, given its noise at `range`.
    fn lead(&self, colour: [u8; 3], range: f64) -> [u8; 3] {
        let through = through(self.water, range);
        std::array::from_fn(|c| {
            let (known, noise) = (through[c].powi(2), NOISE.powi(2));
            let own = srgb_to_linear(f64::from(colour[c]) / 255.0);
            let led = self.mean[c] + known / (known + noise) * (own - self.mean[c]);
            (linear_to_srgb(led) * 255.0).round() as u8
        })
    }
}

/// Share of the light of each channel that arrives from `range`.
fn through(water: &Water, range: f64) -> [f64; 3] {
    water.beta_d.map(|beta| (-beta * range).exp())
}

/// The surfaces of a run, with a search tree.
pub(super) struct Surfaces {
    /// The Gaussians of [`surface_points`], one per point.
    pub(super) model: Gaussians,
    tree: ImmutableKdTree<f32, 3>,
    /// Largest distance of a point from its surface, scene units.
    farthest_off: f32,
    /// Optical depth of the frozen Gaussians around each point.
    frozen: Vec<f32>,
}

impl Surfaces {
    /// `None` if there are none.
    pub(super) fn new(model: Gaussians, context: &Gaussians) -> Result<Option<Self>> {
        if model.is_empty() {
            return Ok(None);
        }
        let tree = searchable(&model.means)?;
        let widest = model.log_scales.iter().map(|scale| scale[0]).fold(f32::MIN, f32::max);
        let mut surfaces = Self { model, tree, farthest_off: OFF * widest.exp(), frozen: Vec::new() };
        surfaces.frozen = surfaces.cover(context.len(), |index| context.transform(index));
        Ok(Some(surfaces))
    }

    /// Points whose optical depth over all Gaussians is below `least`, the barest first.
    pub(super) fn bare(&self, trained: &[Transform], least: f32) -> Vec<u32> {
        let mut bare: Vec<(f32, u32)> = self
            .cover(trained.len(), |index| trained[index])
            .into_iter()
            .zip(&self.frozen)
            .enumerate()
            .map(|(point, (trained, frozen))| (trained + frozen, point as u32))
            .filter(|(cover, _)| *cover < least)
            .collect();
        bare.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        bare.into_iter().map(|(_, point)| point).collect()
    }

    /// Optical depth of `count` Gaussians at each point: the sum of -ln(1 - alpha). Each Gaussian is widened
    /// by the distance of the point from its surface. The sum runs in the order of the Gaussians, for any
    /// number of threads.
    fn cover(&self, count: usize, gaussian: impl Fn(usize) -> Transform + Sync) -> Vec<f32> {
        let of_chunks: Vec<HashMap<u32, f32>> = (0..count.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let mut covers = HashMap::new();
                let own = chunk * CHUNK..count.min((chunk + 1) * CHUNK);
                own.for_each(|index| self.add_cover(&gaussian(index), &mut covers));
                covers
            })
            .collect();
        let mut cover = vec![0.0; self.model.len()];
        for (point, more) in of_chunks.into_iter().flatten() {
            cover[point as usize] += more;
        }
        cover
    }

    /// Adds the cover that a Gaussian (centre and logit of opacity, quaternion, log scales) gives each point
    /// around it.
    fn add_cover(&self, [centre, quat, log_scale]: &Transform, covers: &mut HashMap<u32, f32>) {
        let opacity = 1.0 / (1.0 + (-centre[3]).exp());
        let scale = Vec3::new(log_scale[0], log_scale[1], log_scale[2]).exp();
        let mean = [centre[0], centre[1], centre[2]];
        if !(opacity > LEAST && scale.is_finite() && mean.iter().all(|value| value.is_finite())) {
            return;
        }
        let reach = REACH * scale.max_element().hypot(self.farthest_off);
        let [w, x, y, z] = *quat;
        let to_own = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize()).transpose();
        for found in
            self.tree.query(&mean).within::<SquaredEuclidean<f32>>(reach * reach).unsorted().execute()
        {
            let point = found.item;
            let at = point as usize;
            let off = to_own * (Vec3::from(self.model.means[at]) - Vec3::from(mean));
            let slack = OFF * self.model.log_scales[at][0].exp();
            let wide = scale * scale + Vec3::splat(slack * slack);
            let alpha = opacity * (-0.5 * (off * off / wide).element_sum()).exp();
            // False for NaN, which a quaternion of zeros gives.
            if alpha > LEAST {
                *covers.entry(point).or_insert(0.0) -= (1.0 - alpha.min(0.99)).ln();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Composition, WaterConfig};
    use crate::scene::{PinholeCamera, Pose, Tracks};

    fn murky() -> MediumRun {
        MediumRun {
            water: Water::COASTAL,
            ..MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, 5.0)
        }
    }

    /// A floor of 20 x 20 points at a spacing of 1, each seen by `views`.
    fn floor(views: impl Fn(usize) -> Vec<u32>) -> Points {
        let positions: Vec<[f32; 3]> = (0..400).map(|i| [(i % 20) as f32, 0.0, (i / 20) as f32]).collect();
        let mut tracks = Tracks::default();
        (0..400).for_each(|point| tracks.set_last(point, &mut views(point)));
        Points { colours: vec![[128; 3]; positions.len()], positions, tracks }
    }

    /// Three views from above the middle of the floor, `high` above it.
    fn views(high: f64) -> [TrainView; 3] {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        [0.0, 0.1, 0.2].map(|aside| {
            let middle = DVec3::new(9.5, 0.0, 9.5);
            let pose = Pose::looking_at(middle + DVec3::new(aside, -high, 0.0), middle, DVec3::Z);
            TrainView { name: String::new(), camera, pose, clear_range: 0.0 }
        })
    }

    /// Farther than the range at which half of the light of the clearest channel is left.
    const FAR: f64 = 60.0;

    fn config() -> TrainConfig {
        TrainConfig { sh_degree: 1, max_gaussians: 1000, ..TrainConfig::default() }
    }

    /// A Gaussian over each of the points, `off` above it.
    fn over(surfaces: &Surfaces, off: f32, opacity: f32, deviation: f32) -> Vec<Transform> {
        let logit = (opacity / (1.0 - opacity)).ln();
        let at = |[x, y, z]: &[f32; 3]| {
            [
                [*x, y - off, *z, logit],
                [1.0, 0.0, 0.0, 0.0],
                [deviation.ln(), deviation.ln(), deviation.ln(), 0.0],
            ]
        };
        surfaces.model.means.iter().map(at).collect()
    }

    fn ready(points: &Points) -> Surfaces {
        let model =
            surface_points(points, &views(FAR), &[0, 1, 2], &config(), Some(&murky()), |_| true).unwrap();
        Surfaces::new(model, &Gaussians::empty(1)).unwrap().unwrap()
    }

    #[test]
    fn points_that_two_views_saw_from_far_must_be_covered() {
        // Point 0 is seen by one view of the run, 1 by one and a held-out one, 2 by none.
        let points = floor(|point| match point {
            0 => vec![1],
            1 => vec![0, 7],
            2 => vec![],
            _ => vec![0, 2],
        });
        let of = |high: f64, medium: Option<&MediumRun>, inside: fn([f32; 3]) -> bool| {
            surface_points(&points, &views(high), &[0, 1, 2], &config(), medium, inside).unwrap()
        };
        assert_eq!(of(FAR, Some(&murky()), |_| true).means, points.positions[3..]);
        assert_eq!(of(FAR, Some(&murky()), |at| at[0] > 9.0).len(), 200);
        let clear = MediumRun { water: Water { beta_d: [1e-4; 3], ..Water::COASTAL }, ..murky() };
        let no_cover = WaterConfig { least_cover: 0.0, ..WaterConfig::default() };
        let off = MediumRun::fixed(&no_cover, Composition::PixelsSrgb, 5.0);
        for none in [None, Some(&clear), Some(&off)] {
            assert!(of(FAR, none, |_| true).is_empty());
        }
        assert!(of(0.5, Some(&murky()), |_| true).len() < 400, "the photographs constrain near points");
        let untracked = Points { tracks: Tracks::default(), ..points.clone() };
        let all =
            surface_points(&untracked, &views(FAR), &[0, 1, 2], &config(), Some(&murky()), |_| true).unwrap();
        assert_eq!(all.len(), 400, "without tracks, all points count");
        let few = TrainConfig { max_gaussians: 200, ..config() };
        let thinned =
            surface_points(&points, &views(FAR), &[0, 1, 2], &few, Some(&murky()), |_| true).unwrap();
        assert!((50..=100).contains(&thinned.len()), "{} of a cap of 200", thinned.len());
    }

    #[test]
    fn a_colour_without_light_becomes_the_mean_and_others_stay() {
        let points =
            Points { colours: vec![[200, 100, 50], [100, 100, 50], [255, 10, 60]], ..Points::default() };
        let water = Water { beta_d: [0.5, 0.05, 0.01], ..Water::COASTAL };
        let usual = UsualColour::of(&points, &[Some(1.0), Some(1.0), Some(30.0)], &water);
        let far = usual.lead([255, 10, 60], 30.0);
        let red = srgb_to_linear(f64::from(far[0]) / 255.0);
        let both = [200.0, 100.0].map(|code: f64| srgb_to_linear(code / 255.0));
        assert!((red - both.iter().sum::<f64>() / 2.0).abs() < 0.01, "{far:?}");
        assert!((11..30).contains(&far[1]), "a fifth of the green arrives: {far:?}");
        assert!(far[2].abs_diff(60) <= 1, "{far:?}");
        assert_eq!(usual.lead([255, 10, 60], 0.1)[0].abs_diff(255), 0, "a near point keeps its colour");
    }

    #[test]
    fn an_isolated_point_gets_no_gaussian_as_wide_as_the_scene() {
        let mut points = floor(|_| vec![0, 1]);
        points.positions[7] = [500.0, 0.0, 0.0];
        let model =
            surface_points(&points, &views(FAR), &[0, 1, 2], &config(), Some(&murky()), |_| true).unwrap();
        assert!(model.log_scales.iter().flatten().all(|log| log.exp() < 2.01), "{:?}", model.log_scales[7]);
    }

    #[test]
    fn a_floor_is_bare_unless_opaque_gaussians_are_near() {
        let surfaces = ready(&floor(|_| vec![0, 1]));
        let opaque = over(&surfaces, 0.1, 0.95, 0.5);
        assert!(surfaces.bare(&opaque, 2.0).is_empty());
        let mut without_rotation = opaque.clone();
        without_rotation.iter_mut().for_each(|[_, quat, _]| *quat = [0.0; 4]);
        for (what, gaussians) in [
            ("nothing", Vec::new()),
            ("Gaussians without a rotation", without_rotation),
            ("a fog", over(&surfaces, 0.1, 0.1, 0.5)),
            ("Gaussians far above", over(&surfaces, 6.0, 0.95, 0.5)),
            ("Gaussians that are not finite", over(&surfaces, f32::NAN, 0.95, 0.5)),
        ] {
            assert_eq!(surfaces.bare(&gaussians, 2.0).len(), 400, "{what}");
        }
        let mut with_a_hole = opaque;
        with_a_hole.retain(|[centre, ..]| (centre[0] - 10.0).hypot(centre[2] - 10.0) > 2.5);
        let hole = surfaces.bare(&with_a_hole, 2.0);
        assert_eq!(surfaces.model.means[hole[0] as usize], [10.0, 0.0, 10.0], "the barest first");
        assert!((9..30).contains(&hole.len()), "{} points", hole.len());
    }

    #[test]
    fn frozen_gaussians_cover_too_and_faint_ones_add_up() {
        let points = floor(|_| vec![0, 1]);
        let model =
            surface_points(&points, &views(FAR), &[0, 1, 2], &config(), Some(&murky()), |_| true).unwrap();
        let covered = Surfaces::new(model.clone(), &model).unwrap().unwrap();
        assert!(covered.bare(&[], 2.0).is_empty());
        let surfaces = ready(&points);
        let faint = over(&surfaces, 0.0, 0.2, 0.5);
        let many: Vec<Transform> = (0..12).flat_map(|_| faint.clone()).collect();
        assert_eq!([surfaces.bare(&faint, 2.0).len(), surfaces.bare(&many, 2.0).len()], [400, 0]);
    }
}
