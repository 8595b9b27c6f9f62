//! Priors on what is under water: the physics-aware dark channel (SMP-UWGS eq. 12 and 13) and depth
//! smoothness (eq. 14).
//!
//! Maps are `[H*W]` row-major. Both losses are means over all pixels of a picture, masked or not, like the
//! loss of the picture (`loss`). The weights w_c and the weights of edges are constants in the gradient.

use super::Blended;
use fathom_core::water::{LEAST_ALPHA, RangeModulation, Water};

/// Keeps the weight of a channel without attenuation finite (SMP-UWGS's code).
pub const LEAST_ATTENUATION: f64 = 1e-6;
/// Value at which the negative part changes from a parabola to a line, linear light (SeaSplat, SMP-UWGS's
/// code).
const BEND: f64 = 0.2;

/// The inputs of the priors for one picture.
#[derive(Clone, Copy, Debug)]
pub struct PriorView<'a> {
    /// Width and height, pixels.
    pub size: [usize; 2],
    /// Blended pixels.
    pub blended: &'a [Blended],
    /// Whether a pixel counts.
    pub mask: &'a [bool],
    /// The scene scale, scene units.
    pub unit: f64,
    /// How the coefficients depend on range, with DBDR (eq. 9).
    pub refinement: Option<&'a RangeModulation>,
}

impl PriorView<'_> {
    /// The water at `range`, and the factor on its `beta_b`.
    fn water_at(&self, water: &Water, range: f64) -> (Water, f64) {
        self.refinement.map_or((*water, 1.0), |by| (by.at(water, range), by.factors(range)[1]))
    }
}

/// Weights and patch of the dark channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DarkChannel {
    /// lambda_dcp of eq. 13.
    pub weight: f64,
    /// lambda_neg of eq. 13.
    pub negative: f64,
    /// Pixels of the patch on either side of its centre.
    pub radius: usize,
}

/// A prior's value and gradients.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PriorLoss {
    /// The loss, times its weight.
    pub total: f64,
    /// Gradient with respect to the light of the dark channel, `[H*W]`; empty for depth smoothness.
    pub v_light: Vec<[f64; 3]>,
    /// Direct gradient with respect to alpha, without the part through the light.
    pub v_alpha: Vec<f64>,
    /// The same for the blended range.
    pub v_range: Vec<f64>,
    /// The same for the water parameters.
    pub v_water: [f64; 9],
    /// The same for the four parameters of eq. 9, in the order of [`RangeModulation::to_array`].
    pub v_refinement: [f64; 4],
}

/// w_c of eq. 12: 1 / `beta_d`, scaled so that the largest is 1 (SMP-UWGS's code).
pub fn channel_weights(water: &Water, unit: f64) -> [f64; 3] {
    let raw = water.beta_d.map(|beta| 1.0 / (beta * unit + LEAST_ATTENUATION));
    let largest = raw.iter().copied().fold(0.0, f64::max);
    raw.map(|w| w / largest)
}

/// Smallest w_c (I^c - B^c) and its channel, the first of equal ones; 0 in open water. `None` where the pixel
/// does not count or the value is not finite.
fn signal(
    weights: [f64; 3],
    water: &Water,
    light: [f64; 3],
    pixel: &Blended,
    counts: bool,
) -> Option<(f64, usize)> {
    let Blended { alpha, range, .. } = *pixel;
    let mut least = (0.0, 0);
    if alpha >= LEAST_ALPHA {
        let r = range / alpha;
        let m: [f64; 3] = std::array::from_fn(|c| {
            weights[c] * (light[c] - water.b_inf[c] * (1.0 - alpha * (-water.beta_b[c] * r).exp()))
        });
        least = (m[0], 0);
        for (c, &m) in m.iter().enumerate().skip(1) {
            if m < least.0 {
                least = (m, c);
            }
        }
    }
    (counts && least.0.is_finite()).then_some(least)
}

/// Index of the smallest value in the patch around each pixel, the first in reading order of equal ones.
/// `None` where the patch has no value.
pub fn patch_minima(values: &[Option<f64>], size: [usize; 2], radius: usize) -> Vec<Option<usize>> {
    let [width, height] = size;
    let around = |at: usize, end: usize| at.saturating_sub(radius)..(at + radius + 1).min(end);
    let least = |centre: usize| {
        let mut least: Option<(f64, usize)> = None;
        for y in around(centre / width, height) {
            for x in around(centre % width, width) {
                let at = y * width + x;
                if let Some(value) = values[at]
                    && least.is_none_or(|(smallest, _)| value < smallest)
                {
                    least = Some((value, at));
                }
            }
        }
        least.map(|(_, at)| at)
    };
    (0..width * height).map(least).collect()
}

/// ReLU(d) + negative SmoothL1(ReLU(-d)) of eq. 13, and its derivative.
fn penalty(d: f64, negative: f64) -> (f64, f64) {
    let below = (-d).max(0.0);
    if d > 0.0 {
        (d, 1.0)
    } else if below < BEND {
        (negative * 0.5 * below * below / BEND, -negative * below / BEND)
    } else {
        (negative * (below - 0.5 * BEND), -negative)
    }
}

/// Loss of the dark channel of `light`: the picture under water or the photograph, in linear light. Its
/// gradient with respect to `light` is separate from the direct gradients.
pub fn dark_channel(
    water: &Water,
    view: &PriorView<'_>,
    light: &[[f64; 3]],
    config: &DarkChannel,
) -> PriorLoss {
    let pixels = view.blended.len();
    let weights = channel_weights(water, view.unit);
    let signal_of = |i: usize| {
        let pixel = &view.blended[i];
        let (here, _) = view.water_at(water, pixel.range / pixel.alpha.max(LEAST_ALPHA));
        signal(weights, &here, light[i], pixel, view.mask[i])
    };
    let signals: Vec<Option<(f64, usize)>> = (0..pixels).map(signal_of).collect();
    let values: Vec<Option<f64>> = signals.iter().map(|signal| signal.map(|(m, _)| m)).collect();
    let mut loss = PriorLoss {
        v_light: vec![[0.0; 3]; pixels],
        v_alpha: vec![0.0; pixels],
        v_range: vec![0.0; pixels],
        ..PriorLoss::default()
    };
    let by_pixel = config.weight / pixels as f64;
    for (centre, at) in patch_minima(&values, view.size, config.radius).into_iter().enumerate() {
        let Some((at, (m, c))) = at.and_then(|at| Some((at, signals[at]?))).filter(|_| view.mask[centre])
        else {
            continue;
        };
        let (value, slope) = penalty(m, config.negative);
        loss.total += by_pixel * value;
        let Blended { alpha, range, .. } = view.blended[at];
        if alpha >= LEAST_ALPHA {
            let v = by_pixel * slope * weights[c];
            let r = range / alpha;
            let (here, factor) = view.water_at(water, r);
            let through = (-here.beta_b[c] * r).exp();
            let veil = water.b_inf[c] * through;
            let v_beta = -v * alpha * r * veil;
            loss.v_light[at][c] += v;
            loss.v_range[at] -= v * veil * here.beta_b[c];
            loss.v_alpha[at] += v * veil * (1.0 + here.beta_b[c] * r);
            loss.v_water[3 + c] += factor * v_beta;
            loss.v_water[6 + c] -= v * (1.0 - alpha * through);
            if let Some(by) = view.refinement {
                let v_x = v_beta * water.beta_b[c] * factor * (1.0 - factor / by.scale);
                let v_r = v_x * by.backscatter[0] / by.unit;
                loss.v_range[at] += v_r / alpha;
                loss.v_alpha[at] -= v_r * r / alpha;
                loss.v_refinement[2] += v_x * r / by.unit;
                loss.v_refinement[3] += v_x;
            }
        }
    }
    loss
}

/// Depth smoothness with this weight; the edges come from `photograph`, in sRGB.
pub fn depth_smoothness(view: &PriorView<'_>, photograph: &[[f64; 3]], weight: f64) -> PriorLoss {
    let [width, height] = view.size;
    let pixels = width * height;
    let mut loss =
        PriorLoss { v_alpha: vec![0.0; pixels], v_range: vec![0.0; pixels], ..PriorLoss::default() };
    let counts = |i: usize| view.mask[i] && view.blended[i].alpha >= LEAST_ALPHA;
    let depth = |i: usize| view.blended[i].range / view.blended[i].alpha / view.unit;
    let by_pixel = weight / pixels as f64;
    for i in (0..pixels).filter(|&i| counts(i)) {
        let right = (i % width + 1 < width).then_some(i + 1);
        let below = (i / width + 1 < height).then_some(i + width);
        for j in [right, below].into_iter().flatten().filter(|&j| counts(j)) {
            let edge = (0..3).map(|c| (photograph[i][c] - photograph[j][c]).abs()).sum::<f64>() / 3.0;
            let difference = depth(i) - depth(j);
            let v = by_pixel * (-edge).exp();
            loss.total += v * difference.abs();
            for (k, v) in [(i, v * difference.signum()), (j, -v * difference.signum())] {
                if difference != 0.0 {
                    let Blended { alpha, range, .. } = view.blended[k];
                    loss.v_range[k] += v / (alpha * view.unit);
                    loss.v_alpha[k] -= v * range / (alpha * alpha * view.unit);
                }
            }
        }
    }
    loss
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use fathom_core::rng::{Stream, uniform_at};

    const WATER: Water =
        Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.3, 0.41, 0.49] };
    const SIZE: [usize; 2] = [9, 7];
    const UNIT: f64 = 3.2;

    fn number(i: usize, j: u32) -> f64 {
        f64::from(uniform_at(131, Stream::Test, i as u32, j))
    }

    struct Maps {
        blended: Vec<Blended>,
        mask: Vec<bool>,
        light: Vec<[f64; 3]>,
    }

    impl Maps {
        /// Some pixels are open water, some masked; direct signals have both signs.
        fn new(masked: f64) -> Self {
            let pixels = SIZE[0] * SIZE[1];
            let alpha = |i: usize| if i.is_multiple_of(6) { 0.0 } else { 0.05 + 0.95 * number(i, 0) };
            let blended =
                |i| Blended { rgb: [0.0; 3], alpha: alpha(i), range: alpha(i) * 9.0 * number(i, 1) };
            Self {
                blended: (0..pixels).map(blended).collect(),
                mask: (0..pixels).map(|i| number(i, 2) >= masked).collect(),
                light: (0..pixels).map(|i| std::array::from_fn(|c| 0.2 + number(i, 3 + c as u32))).collect(),
            }
        }

        fn view(&self) -> PriorView<'_> {
            PriorView { size: SIZE, blended: &self.blended, mask: &self.mask, unit: UNIT, refinement: None }
        }
    }

    const CONFIG: DarkChannel = DarkChannel { weight: 0.7, negative: 30.0, radius: 2 };

    #[test]
    fn dark_channel_gradients_hold_its_weights_constant() {
        for masked in [0.0, 0.3] {
            for radius in [0, 1, 2, 20] {
                let config = DarkChannel { radius, ..CONFIG };
                let maps = Maps::new(masked);
                let loss = dark_channel(&WATER, &maps.view(), &maps.light, &config);
                assert!(loss.total > 0.0);
                let along = |change: &dyn Fn(&mut Maps, f64)| {
                    derivative(|h| {
                        let mut moved = Maps::new(masked);
                        change(&mut moved, h);
                        dark_channel(&WATER, &moved.view(), &moved.light, &config).total
                    })
                };
                for i in 0..maps.light.len() {
                    let what = format!("radius {radius}, masked {masked}, pixel {i}");
                    for c in 0..3 {
                        let numeric = along(&|maps, h| maps.light[i][c] += h);
                        assert_close(&format!("{what}, light {c}"), loss.v_light[i][c], numeric, 1e-3);
                    }
                    // At alpha 0, a step would turn open water into a surface.
                    if maps.blended[i].alpha > 0.0 {
                        let by_alpha = along(&|maps, h| maps.blended[i].alpha += h);
                        assert_close(&format!("{what}, alpha"), loss.v_alpha[i], by_alpha, 1e-3);
                        let by_range = along(&|maps, h| maps.blended[i].range += h);
                        assert_close(&format!("{what}, range"), loss.v_range[i], by_range, 1e-3);
                    }
                }
                for k in 0..9 {
                    let numeric = derivative(|h| {
                        let mut values = WATER.to_array();
                        values[k] += h;
                        let water = Water::from_array(values);
                        dark_channel(&water, &maps.view(), &maps.light, &config).total
                    });
                    if k < 3 {
                        assert_eq!(loss.v_water[k], 0.0, "the weights must be constants");
                    } else {
                        assert_close(&format!("radius {radius}: water {k}"), loss.v_water[k], numeric, 1e-3);
                    }
                }
            }
        }
    }

    #[test]
    fn dark_channel_gradients_with_dbdr_are_central_differences() {
        let refinement = RangeModulation::identity(2.0, UNIT).with_array([0.3, -0.2, -0.7, 0.4]);
        let maps = Maps::new(0.1);
        let of = |maps: &Maps, refinement: &RangeModulation, water: &Water| {
            let view = PriorView { refinement: Some(refinement), ..maps.view() };
            dark_channel(water, &view, &maps.light, &CONFIG)
        };
        let loss = of(&maps, &refinement, &WATER);
        assert!(loss.total != dark_channel(&WATER, &maps.view(), &maps.light, &CONFIG).total);
        for i in (0..maps.light.len()).filter(|&i| maps.blended[i].alpha > 0.0) {
            let along = |change: &dyn Fn(&mut Blended, f64)| {
                derivative(|h| {
                    let mut moved = Maps::new(0.1);
                    change(&mut moved.blended[i], h);
                    of(&moved, &refinement, &WATER).total
                })
            };
            let by_alpha = along(&|pixel, h| pixel.alpha += h);
            assert_close(&format!("pixel {i}, alpha"), loss.v_alpha[i], by_alpha, 1e-3);
            let by_range = along(&|pixel, h| pixel.range += h);
            assert_close(&format!("pixel {i}, range"), loss.v_range[i], by_range, 1e-3);
        }
        for k in 0..4 {
            let numeric = derivative(|h| {
                let mut values = refinement.to_array();
                values[k] += h;
                of(&maps, &refinement.with_array(values), &WATER).total
            });
            assert_close(&format!("parameter {k} of eq. 9"), loss.v_refinement[k], numeric, 1e-3);
        }
        for k in 3..9 {
            let numeric = derivative(|h| {
                let mut values = WATER.to_array();
                values[k] += h;
                of(&maps, &refinement, &Water::from_array(values)).total
            });
            assert_close(&format!("water {k}"), loss.v_water[k], numeric, 1e-3);
        }
    }

    #[test]
    fn gradients_of_depth_smoothness_are_central_differences() {
        for masked in [0.0, 0.3] {
            let maps = Maps::new(masked);
            let loss = depth_smoothness(&maps.view(), &maps.light, 2.0);
            assert!(loss.total > 0.0);
            let along = |change: &dyn Fn(&mut Maps, f64)| {
                derivative(|h| {
                    let mut moved = Maps::new(masked);
                    change(&mut moved, h);
                    depth_smoothness(&moved.view(), &moved.light, 2.0).total
                })
            };
            for i in (0..maps.light.len()).filter(|&i| maps.blended[i].alpha > 0.0) {
                let what = format!("masked {masked}, pixel {i}");
                let by_alpha = along(&|maps, h| maps.blended[i].alpha += h);
                assert_close(&format!("{what}, alpha"), loss.v_alpha[i], by_alpha, 1e-2);
                let by_range = along(&|maps, h| maps.blended[i].range += h);
                assert_close(&format!("{what}, range"), loss.v_range[i], by_range, 1e-2);
            }
        }
    }

    #[test]
    fn an_edge_of_either_sign_smooths_less_than_a_flat_photograph() {
        let view = |photograph: [[f64; 3]; 2]| {
            let blended = [1.0, 2.0].map(|range| Blended { rgb: [0.0; 3], alpha: 1.0, range });
            let view =
                PriorView { size: [2, 1], blended: &blended, mask: &[true; 2], unit: 1.0, refinement: None };
            depth_smoothness(&view, &photograph, 1.0).total
        };
        let flat = view([[0.5; 3]; 2]);
        let (up, down) = (view([[0.2; 3], [0.8; 3]]), view([[0.8; 3], [0.2; 3]]));
        assert_eq!(up, down);
        assert!(up < flat, "{up} and {flat}");
    }

    #[test]
    fn the_most_attenuated_channels_weigh_least() {
        let weights = channel_weights(&WATER, UNIT);
        assert!(weights[0] < weights[1] && weights[1] < weights[2]);
        assert_eq!(weights[2], 1.0);
        let clear = Water { beta_d: [0.0; 3], ..WATER };
        assert_eq!(channel_weights(&clear, UNIT), [1.0; 3]);
    }

    #[test]
    fn the_first_of_equal_pixels_and_channels_is_the_darkest() {
        let size = [5, 4];
        let values = [Some(1.0); 20];
        let minima = patch_minima(&values, size, 1);
        // The upper left corner of the patch, clipped to the picture.
        for (i, at) in minima.iter().enumerate() {
            let (x, y) = ((i % 5).saturating_sub(1), (i / 5).saturating_sub(1));
            assert_eq!(*at, Some(5 * y + x), "{i}");
        }
        assert_eq!(patch_minima(&[None; 20], size, 1), [None; 20]);
        let grey = Water { beta_d: [0.2; 3], beta_b: [0.2; 3], b_inf: [0.1; 3] };
        let pixel = Blended { rgb: [0.0; 3], alpha: 1.0, range: 2.0 };
        assert_eq!(signal([1.0; 3], &grey, [0.5; 3], &pixel, true).map(|(_, channel)| channel), Some(0));
    }

    #[test]
    fn open_water_and_masked_pictures_have_no_dark_channel() {
        let maps = Maps::new(0.0);
        let nothing = vec![Blended { rgb: [0.0; 3], alpha: 0.0, range: 0.0 }; maps.light.len()];
        let open = PriorView { blended: &nothing, ..maps.view() };
        let masked = vec![false; maps.light.len()];
        for view in [open, PriorView { mask: &masked, ..maps.view() }] {
            let dark = dark_channel(&WATER, &view, &maps.light, &CONFIG);
            assert_eq!((dark.total, dark.v_water), (0.0, [0.0; 9]));
            assert!(dark.v_light.iter().flatten().chain(&dark.v_alpha).all(|v| *v == 0.0));
            assert_eq!(depth_smoothness(&view, &maps.light, 2.0).total, 0.0);
        }
    }
}
