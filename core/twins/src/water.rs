//! Water between Gaussians and camera (SMP-UWGS eq. 7), its backward pass, and Adam on the water parameters
//! (eq. 8).
//!
//! Colours of Gaussians are J in sRGB. They are blended in sRGB or, decoded, in linear light. Water on
//! Gaussians acts on the decoded colour at the Gaussian's own range, before blending. Water on pixels acts
//! after blending. The sRGB curve continues above 1, and as a straight line below 0.

use super::{SplatGradient, adam_update_with};
use fathom_core::config::{Blend, Medium};
use fathom_core::water::{LEAST_ALPHA, Water};

/// Largest factor on the rate of a colour under water.
pub const MAX_COLOUR_LR_SCALE: f64 = 8.0;

/// Linear light of an sRGB value, clamped to at least 0 (IEC 61966-2-1), and its derivative.
pub fn decode(s: f64) -> (f64, f64) {
    let s = s.max(0.0);
    if s <= 0.040_45 {
        (s / 12.92, 1.0 / 12.92)
    } else {
        let base = (s + 0.055) / 1.055;
        (base.powf(2.4), 2.4 / 1.055 * base.powf(1.4))
    }
}

/// sRGB value of linear light, and its derivative, which is at most 12.92.
pub fn encode(l: f64) -> (f64, f64) {
    if l <= 0.003_130_8 {
        (12.92 * l, 12.92)
    } else {
        (1.055 * l.powf(1.0 / 2.4) - 0.055, 1.055 / 2.4 * l.powf(1.0 / 2.4 - 1.0))
    }
}

/// Linear light of a Gaussian of colour `rgb` (sRGB, not below 0) seen at `range`. Where the water acts on
/// Gaussians, this light is blended: as it is or, with [`Blend::Srgb`], encoded.
pub fn in_water(water: &Water, rgb: [f64; 3], range: f64) -> [f64; 3] {
    std::array::from_fn(|c| {
        decode(rgb[c]).0 * (-water.beta_d[c] * range).exp()
            + water.b_inf[c] * (1.0 - (-water.beta_b[c] * range).exp())
    })
}

/// Factors on the learning rates of the constant colour under water, per channel. Each is the inverse slope
/// of the visible sRGB value with respect to the colour, between 1 and [`MAX_COLOUR_LR_SCALE`]. Higher bands
/// keep their rate (bench/history.jsonl).
pub fn lr_scale_under_water(water: &Water, rgb: [f64; 3], range: f64) -> [f64; 3] {
    let seen = in_water(water, rgb, range);
    std::array::from_fn(|c| {
        let slope = (-water.beta_d[c] * range).exp() * decode(rgb[c]).1 * encode(seen[c]).1;
        1.0 / slope.clamp(1.0 / MAX_COLOUR_LR_SCALE, 1.0)
    })
}

/// Backward pass of [`in_water`]. Replaces the gradient with respect to the blended light by that with
/// respect to the colour. Adds to the gradient of the splat's range, and adds the gradient of the water
/// parameters to `v_water`.
pub fn in_water_backward(
    water: &Water,
    blend: Blend,
    rgb: [f64; 3],
    range: f64,
    v: &mut SplatGradient,
    v_water: &mut [f64; 9],
) {
    let light = in_water(water, rgb, range);
    for c in 0..3 {
        let (clear, slope) = decode(rgb[c]);
        let through = (-water.beta_d[c] * range).exp();
        let veil = (-water.beta_b[c] * range).exp();
        let by_blended = match blend {
            Blend::Srgb | Blend::OverBlack => v.rgb[c] * encode(light[c]).1,
            Blend::Linear => v.rgb[c],
        };
        v_water[c] -= by_blended * range * clear * through;
        v_water[c + 3] += by_blended * range * water.b_inf[c] * veil;
        v_water[c + 6] += by_blended * (1.0 - veil);
        v.range += by_blended * (water.b_inf[c] * water.beta_b[c] * veil - water.beta_d[c] * clear * through);
        v.rgb[c] = by_blended * through * slope;
    }
}

/// A pixel after `rasterize_forward`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blended {
    /// Colour blended over black.
    pub rgb: [f64; 3],
    /// 1 - transmittance.
    pub alpha: f64,
    /// Blended range.
    pub range: f64,
}

/// For water on pixels: J of a pixel times its alpha, in linear light, from the blended value of a channel.
/// Also its derivatives with respect to the blended value and to alpha.
fn own_light(blend: Blend, blended: f64, alpha: f64) -> (f64, f64, f64) {
    match blend {
        Blend::Linear => (blended, 1.0, 0.0),
        Blend::Srgb => {
            let shown = blended / alpha;
            let (light, slope) = decode(shown);
            (alpha * light, slope, light - slope * shown)
        }
        Blend::OverBlack => {
            let (light, slope) = decode(blended);
            (light, slope, 0.0)
        }
    }
}

/// Share of a pixel that contains water, and its derivative with respect to alpha. Over black, only the part
/// that alpha covers; else the whole pixel.
fn watery_share(blend: Blend, alpha: f64) -> (f64, f64) {
    if blend == Blend::OverBlack { (alpha, 1.0) } else { (1.0, 0.0) }
}

/// A pixel under water. With water on Gaussians, it is in the light of the blending, else in linear light.
pub fn form(water: &Water, medium: Medium, blend: Blend, pixel: &Blended) -> [f64; 3] {
    let Blended { rgb, alpha, range } = *pixel;
    std::array::from_fn(|c| match medium {
        Medium::PerGaussian => rgb[c] + (1.0 - alpha) * open(water, blend, c).0,
        _ if alpha < LEAST_ALPHA => water.b_inf[c] * watery_share(blend, 0.0).0,
        _ => {
            let r = range / alpha;
            let share = watery_share(blend, alpha).0;
            own_light(blend, rgb[c], alpha).0 * (-water.beta_d[c] * r).exp()
                + water.b_inf[c] * (share - alpha * (-water.beta_b[c] * r).exp())
        }
    })
}

/// Channel `c` of open water in the light of the blending, and its derivative with respect to `b_inf`.
fn open(water: &Water, blend: Blend, c: usize) -> (f64, f64) {
    match blend {
        Blend::Srgb | Blend::OverBlack => encode(water.b_inf[c]),
        Blend::Linear => (water.b_inf[c], 1.0),
    }
}

/// Backward pass of [`form`]: returns the gradient with respect to the pixel, from the gradient `v` with
/// respect to the formed colour; adds to `v_water`.
pub fn form_backward(
    water: &Water,
    medium: Medium,
    blend: Blend,
    pixel: &Blended,
    v: [f64; 3],
    v_water: &mut [f64; 9],
) -> Blended {
    let Blended { rgb, alpha, range } = *pixel;
    let mut by = Blended { rgb: [0.0; 3], alpha: 0.0, range: 0.0 };
    for c in 0..3 {
        match medium {
            Medium::PerGaussian => {
                by.rgb[c] = v[c];
                let (open, slope) = open(water, blend, c);
                by.alpha -= v[c] * open;
                v_water[c + 6] += v[c] * slope * (1.0 - alpha);
            }
            _ if alpha < LEAST_ALPHA => v_water[c + 6] += v[c] * watery_share(blend, 0.0).0,
            _ => {
                let r = range / alpha;
                let through = (-water.beta_d[c] * r).exp();
                let veil = (-water.beta_b[c] * r).exp();
                let (own, by_blended, by_alpha) = own_light(blend, rgb[c], alpha);
                let v_r = v[c]
                    * (alpha * water.b_inf[c] * water.beta_b[c] * veil - water.beta_d[c] * own * through);
                by.rgb[c] = v[c] * through * by_blended;
                by.range += v_r / alpha;
                let (share, share_slope) = watery_share(blend, alpha);
                by.alpha +=
                    v[c] * (through * by_alpha + water.b_inf[c] * (share_slope - veil)) - v_r * r / alpha;
                v_water[c] -= v[c] * r * own * through;
                v_water[c + 3] += v[c] * r * alpha * water.b_inf[c] * veil;
                v_water[c + 6] += v[c] * (share - alpha * veil);
            }
        }
    }
    by
}

/// The unconstrained water parameters with Adam's state.
#[derive(Clone, Debug, PartialEq)]
pub struct WaterState {
    /// Unconstrained parameters of eq. 8.
    pub raw: [f64; 9],
    first: [f64; 9],
    second: [f64; 9],
    steps: u32,
}

impl WaterState {
    /// Starts at `water`. `unit` is the scene scale: coefficients are multiplied by it.
    pub fn new(water: &Water, unit: f64) -> Self {
        Self { raw: water.to_raw(unit), first: [0.0; 9], second: [0.0; 9], steps: 0 }
    }

    /// Takes one step of Adam (decay 0.9 and 0.999) with the gradient of the water parameters. `decay` is the
    /// weight of their squares (eq. 16), with coefficients multiplied by `unit`.
    pub fn step(&mut self, v_water: &[f64; 9], unit: f64, rate: f64, decay: f64) {
        self.steps += 1;
        let v_raw = self.v_raw(v_water, unit, decay);
        for (i, v) in v_raw.into_iter().enumerate() {
            let moments = (&mut self.first[i], &mut self.second[i]);
            adam_update_with(&mut self.raw[i], v, moments, self.steps, rate, [0.9, 0.999]);
        }
    }

    /// Gradient of the unconstrained parameters from that of the water parameters; arguments as in
    /// [`WaterState::step`].
    pub fn v_raw(&self, v_water: &[f64; 9], unit: f64, decay: f64) -> [f64; 9] {
        std::array::from_fn(|i| {
            let sigmoid = 1.0 / (1.0 + (-self.raw[i]).exp());
            if i < 6 {
                let softplus = self.raw[i].exp().ln_1p();
                (v_water[i] / unit + 2.0 * decay * softplus) * sigmoid
            } else {
                (v_water[i] + 2.0 * decay * sigmoid) * sigmoid * (1.0 - sigmoid)
            }
        })
    }

    /// The water parameters.
    pub fn water(&self, unit: f64) -> Water {
        Water::from_raw(self.raw, unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use fathom_core::picture::{linear_to_srgb, srgb_to_linear};
    use fathom_core::rng::{Stream, uniform_at};

    const WATER: Water =
        Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };

    const COMPOSITIONS: [(Medium, Blend); 5] = [
        (Medium::PerGaussian, Blend::Srgb),
        (Medium::PerGaussian, Blend::Linear),
        (Medium::PerPixel, Blend::Linear),
        (Medium::PerPixel, Blend::Srgb),
        (Medium::PerPixel, Blend::OverBlack),
    ];

    fn moved(at: usize, by: f64) -> Water {
        let mut values = WATER.to_array();
        values[at] += by;
        Water::from_array(values)
    }

    fn number(i: u32, j: u32) -> f64 {
        f64::from(uniform_at(91, Stream::Test, i, j))
    }

    #[test]
    fn the_curve_and_its_slope_match_srgb() {
        for i in 1..200 {
            let x = f64::from(i) / 100.0;
            assert!((decode(x).0 - srgb_to_linear(x)).abs() < 1e-15);
            assert!((encode(x).0 - linear_to_srgb(x)).abs() < 1e-15);
            // Both curves have a bend; 0.03 and 0.04 are on either side of one.
            assert_close(&format!("decode at {x}"), decode(x).1, derivative(|h| decode(x + h).0), 1e-6);
            assert_close(&format!("encode at {x}"), encode(x).1, derivative(|h| encode(x + h).0), 1e-6);
        }
        assert_eq!(encode(-0.01), (-0.01 * 12.92, 12.92), "values below 0 must keep a gradient");
        assert_eq!(decode(-0.5), decode(0.0));
    }

    #[test]
    fn gradients_through_water_on_gaussians_are_central_differences() {
        for i in 0..20 {
            let blend = [Blend::Srgb, Blend::Linear][(i % 2) as usize];
            let rgb = [number(i, 0), number(i, 1), 1.3 * number(i, 2)];
            let range = 0.3 + 12.0 * number(i, 3);
            let weights = [number(i, 4) - 0.5, number(i, 5), -number(i, 6)];
            let value = |water: &Water, rgb, range| -> f64 {
                let light = in_water(water, rgb, range);
                let blended = if blend == Blend::Srgb { light.map(|l| encode(l).0) } else { light };
                blended.iter().zip(weights).map(|(x, w)| x * w).sum()
            };
            let mut v = SplatGradient { rgb: weights, ..SplatGradient::default() };
            let mut v_water = [0.0; 9];
            in_water_backward(&WATER, blend, rgb, range, &mut v, &mut v_water);
            for c in 0..3 {
                let numeric = derivative(|h| {
                    let mut rgb = rgb;
                    rgb[c] += h;
                    value(&WATER, rgb, range)
                });
                assert_close(&format!("{i}: colour {c}"), v.rgb[c], numeric, 1e-5);
            }
            let numeric = derivative(|h| value(&WATER, rgb, range + h));
            assert_close(&format!("{i}: range"), v.range, numeric, 1e-5);
            for (k, found) in v_water.iter().enumerate() {
                let numeric = derivative(|h| value(&moved(k, h), rgb, range));
                assert_close(&format!("{i}: water {k}"), *found, numeric, 1e-5);
            }
        }
    }

    #[test]
    fn gradients_through_water_on_pixels_are_central_differences() {
        for (medium, blend) in COMPOSITIONS {
            for i in 0..20 {
                let alpha = 0.05 + 0.95 * number(i, 3);
                let rgb = [alpha * number(i, 0), alpha * number(i, 1), alpha * number(i, 2)];
                let pixel = Blended { rgb, alpha, range: alpha * 9.0 * number(i, 7) };
                let weights = [number(i, 4) - 0.5, number(i, 5), -number(i, 6)];
                let value = |water: &Water, pixel: &Blended| -> f64 {
                    form(water, medium, blend, pixel).iter().zip(weights).map(|(x, w)| x * w).sum()
                };
                let mut v_water = [0.0; 9];
                let v = form_backward(&WATER, medium, blend, &pixel, weights, &mut v_water);
                let along = |change: &dyn Fn(&mut Blended, f64)| {
                    derivative(|h| {
                        let mut pixel = pixel;
                        change(&mut pixel, h);
                        value(&WATER, &pixel)
                    })
                };
                for c in 0..3 {
                    assert_close(&format!("{i}: {c}"), v.rgb[c], along(&|p, h| p.rgb[c] += h), 1e-5);
                }
                assert_close(&format!("{i}: alpha"), v.alpha, along(&|p, h| p.alpha += h), 1e-5);
                assert_close(&format!("{i}: range"), v.range, along(&|p, h| p.range += h), 1e-5);
                for (k, found) in v_water.iter().enumerate() {
                    let numeric = derivative(|h| value(&moved(k, h), &pixel));
                    assert_close(&format!("{medium:?}, {i}: water {k}"), *found, numeric, 1e-5);
                }
            }
        }
    }

    #[test]
    fn an_opaque_layer_looks_the_same_under_every_composition() {
        let (rgb, range) = ([0.6, 0.4, 0.3], 5.0);
        let layer = |colour| Blended { rgb: colour, alpha: 1.0, range };
        let light = in_water(&WATER, rgb, range);
        let by_gaussian = form(&WATER, Medium::PerGaussian, Blend::Linear, &layer(light));
        let in_srgb = form(&WATER, Medium::PerGaussian, Blend::Srgb, &layer(light.map(|l| encode(l).0)));
        let by_pixel = form(&WATER, Medium::PerPixel, Blend::Linear, &layer(rgb.map(|s| decode(s).0)));
        let as_shown = form(&WATER, Medium::PerPixel, Blend::Srgb, &layer(rgb));
        let over_black = form(&WATER, Medium::PerPixel, Blend::OverBlack, &layer(rgb));
        let truth = WATER.apply(glam::DVec3::from(rgb.map(|s| decode(s).0)), range);
        for c in 0..3 {
            for found in [by_gaussian[c], by_pixel[c], as_shown[c], over_black[c], decode(in_srgb[c]).0] {
                assert!((found - truth[c]).abs() < 1e-14, "{found} and {}", truth[c]);
            }
        }
        let nothing = Blended { rgb: [0.0; 3], alpha: 0.0, range: 0.0 };
        for (medium, blend) in COMPOSITIONS {
            let is_encoded = (medium, blend) == (Medium::PerGaussian, Blend::Srgb);
            let open = WATER.b_inf.map(|l| if is_encoded { encode(l).0 } else { l });
            let open = if blend == Blend::OverBlack { [0.0; 3] } else { open };
            assert_eq!(form(&WATER, medium, blend, &nothing), open);
        }
    }

    #[test]
    fn adam_finds_the_water_at_any_scene_scale() {
        for unit in [0.01, 1.0, 300.0] {
            let scaled = |water: &Water| {
                let [d, b] = [water.beta_d, water.beta_b].map(|beta| beta.map(|value| value * 7.0 / unit));
                Water { beta_d: d, beta_b: b, b_inf: water.b_inf }
            };
            let goal = scaled(&WATER);
            let mut state = WaterState::new(&scaled(&Water::COASTAL), unit);
            for k in 0..2000 {
                let now = state.water(unit).to_array();
                let v = std::array::from_fn(|i| {
                    let size = if i < 6 { unit } else { 1.0 };
                    2.0 * (now[i] - goal.to_array()[i]) * size * size
                });
                state.step(&v, unit, 0.02 * 0.998_f64.powi(k), 0.0);
            }
            for (found, goal) in state.water(unit).to_array().iter().zip(goal.to_array()) {
                assert!((found / goal - 1.0).abs() < 1e-3, "{found} and {goal} at scene scale {unit}");
            }
        }
    }

    #[test]
    fn the_l2_weight_shrinks_the_water_parameters() {
        let mut state = WaterState::new(&WATER, 7.0);
        (0..50).for_each(|_| state.step(&[0.0; 9], 7.0, 0.01, 1e-4));
        let pairs = state.water(7.0).to_array().into_iter().zip(WATER.to_array());
        assert!(pairs.into_iter().all(|(after, before)| after < before));
    }
}
