//! Adam (Kingma and Ba 2015) for the Gaussians that a view sees.
//!
//! A Gaussian outside the view keeps its parameters, its moments and its step count, so its bias correction
//! counts its own updates. The dense variant also decays the moments of unseen Gaussians. eps is 1e-15 as in
//! 3DGS, because gradients are means over an image and small.

use super::Gaussians64;

/// Decay of the first moment. Lower than the usual 0.9: see [`BETA_2`].
pub const BETA_1: f64 = 0.8;
/// Decay of the second moment. The usual 0.999 averages over a thousand updates. A Gaussian that is only
/// updated when it is seen has a few hundred in a whole run. The large gradients of its first updates would
/// keep its steps small until the end.
pub const BETA_2: f64 = 0.99;
/// Avoids 0 / 0 for a parameter without gradient.
pub const EPSILON: f64 = 1e-15;

/// Learning rate of each kind of parameter at one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRates {
    /// Means, scene units.
    pub means: f64,
    /// Quaternions.
    pub quats: f64,
    /// Log scales.
    pub log_scales: f64,
    /// Opacity logits.
    pub opacity_logits: f64,
    /// Coefficient 0.
    pub sh_dc: f64,
    /// All other coefficients.
    pub sh_rest: f64,
}

impl LearningRates {
    /// The rates of a view, scaled by [`lr_scale`]. Scales and higher bands keep their rates. Short runs set
    /// these so high that a larger step per view would do harm. Larger rates of higher bands would make the
    /// colour of a Gaussian that few views see depend too much on direction (bench/history.jsonl).
    pub fn scaled(&self, lr_scale: f64) -> Self {
        Self {
            means: lr_scale * self.means,
            quats: lr_scale * self.quats,
            log_scales: self.log_scales,
            opacity_logits: lr_scale * self.opacity_logits,
            sh_dc: lr_scale * self.sh_dc,
            sh_rest: self.sh_rest,
        }
    }

    /// The rate of a parameter in the order of [`Gaussians64::parameter`].
    pub fn of_parameter(&self, parameter: usize) -> f64 {
        match parameter {
            0..3 => self.means,
            3..7 => self.quats,
            7..10 => self.log_scales,
            10 => self.opacity_logits,
            11..14 => self.sh_dc,
            _ => self.sh_rest,
        }
    }
}

/// Moments and step counts.
#[derive(Clone, Debug, PartialEq)]
pub struct AdamState {
    /// First moments.
    pub first: Gaussians64,
    /// Second moments.
    pub second: Gaussians64,
    /// Number of updates of each Gaussian.
    pub steps: Vec<u32>,
}

impl AdamState {
    /// The state before the first update of `count` Gaussians.
    pub fn new(count: usize, sh_degree: u8) -> Self {
        let zeros = Gaussians64::zeros(count, sh_degree);
        Self { first: zeros.clone(), second: zeros, steps: vec![0; count] }
    }
}

/// Largest factor on the rates of a view that sees little of the model.
pub const MAX_LR_SCALE: f64 = 8.0;

/// The factor on the rates of a view that sees `seen` of `trainable` Gaussians: 1 / sqrt(p), where p is the
/// visible share.
///
/// Dense Adam updates all Gaussians in every iteration. If a share p of the views sees a Gaussian, its second
/// moment also averages zeros. Its steps are larger by this factor in each view that sees it.
pub fn lr_scale(trainable: usize, seen: usize) -> f64 {
    (trainable as f64 / seen.max(1) as f64).sqrt().min(MAX_LR_SCALE)
}

/// One update of the Gaussians for which `visible` holds; the others stay as they are.
pub fn adam(
    model: &mut Gaussians64,
    v_model: &Gaussians64,
    state: &mut AdamState,
    visible: &[bool],
    rates: &LearningRates,
) {
    for index in (0..model.len()).filter(|&index| visible[index]) {
        state.steps[index] += 1;
        for parameter in 0..model.parameters() {
            adam_update(
                model.parameter_mut(index, parameter),
                v_model.parameter(index, parameter),
                state.first.parameter_mut(index, parameter),
                state.second.parameter_mut(index, parameter),
                state.steps[index],
                rates.of_parameter(parameter),
            );
        }
    }
}

/// The same with one second moment per colour channel: all coefficients of a channel use that of coefficient
/// 0.
///
/// The gradient of coefficient k is `basis_k(direction)` times the gradient of the channel's colour. In every
/// direction, the squares of the functions of band l add up to (2l + 1) / 4 pi. So the mean square over each
/// band equals that of coefficient 0.
pub fn adam_compact(
    model: &mut Gaussians64,
    v_model: &Gaussians64,
    state: &mut AdamState,
    visible: &[bool],
    rates: &LearningRates,
) {
    const COLOUR: usize = 11;
    for index in (0..model.len()).filter(|&index| visible[index]) {
        state.steps[index] += 1;
        for parameter in 0..model.parameters() {
            let gradient = v_model.parameter(index, parameter);
            let first = state.first.parameter_mut(index, parameter);
            *first = BETA_1 * *first + (1.0 - BETA_1) * gradient;
            let owner = if parameter < COLOUR { parameter } else { COLOUR + (parameter - COLOUR) % 3 };
            let second = state.second.parameter_mut(index, owner);
            if owner == parameter {
                *second = BETA_2 * *second + (1.0 - BETA_2) * gradient * gradient;
            }
            *model.parameter_mut(index, parameter) -= rates.of_parameter(parameter)
                * unbiased_ratio(*first, *second, state.steps[index], [BETA_1, BETA_2]);
        }
    }
}

/// Updates one number; `step` counts from 1 and includes this update.
pub fn adam_update(value: &mut f64, gradient: f64, first: &mut f64, second: &mut f64, step: u32, rate: f64) {
    adam_update_with(value, gradient, (first, second), step, rate, [BETA_1, BETA_2]);
}

/// The same with other decay rates than those of the Gaussians.
pub fn adam_update_with(
    value: &mut f64,
    gradient: f64,
    (first, second): (&mut f64, &mut f64),
    step: u32,
    rate: f64,
    betas: [f64; 2],
) {
    *first = betas[0] * *first + (1.0 - betas[0]) * gradient;
    *second = betas[1] * *second + (1.0 - betas[1]) * gradient * gradient;
    *value -= rate * unbiased_ratio(*first, *second, step, betas);
}

fn unbiased_ratio(first: f64, second: f64, step: u32, betas: [f64; 2]) -> f64 {
    let unbiased_first = first / (1.0 - betas[0].powf(f64::from(step)));
    let unbiased_second = second / (1.0 - betas[1].powf(f64::from(step)));
    unbiased_first / (unbiased_second.sqrt() + EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATES: LearningRates = LearningRates {
        means: 1e-2,
        quats: 2e-2,
        log_scales: 3e-2,
        opacity_logits: 4e-2,
        sh_dc: 5e-2,
        sh_rest: 6e-2,
    };

    #[test]
    fn three_updates_match_those_worked_out_by_hand() {
        // Gradients 1, -2, 0.5 at rate 0.1:
        //   m  0.2      -0.24         -0.092
        //   v  0.01      0.0499        0.051901
        //   m' 1        -0.24/0.36    -0.092/0.488
        //   v' 1         0.0499/0.0199   0.051901/0.029701
        let expected = [
            3.0 - 0.1,
            3.0 - 0.1 + 0.1 * (0.24 / 0.36) / (0.0499_f64 / 0.0199).sqrt(),
            3.0 - 0.1
                + 0.1 * (0.24 / 0.36) / (0.0499_f64 / 0.0199).sqrt()
                + 0.1 * (0.092 / 0.488) / (0.051_901_f64 / 0.029_701).sqrt(),
        ];
        let (mut value, mut first, mut second) = (3.0, 0.0, 0.0);
        for (step, gradient) in [1.0, -2.0, 0.5].into_iter().enumerate() {
            adam_update(&mut value, gradient, &mut first, &mut second, step as u32 + 1, 0.1);
            // 1e-12: 1 - BETA_2^t loses three digits of sixteen.
            assert!((value - expected[step]).abs() < 1e-12, "step {step}: {value} != {}", expected[step]);
        }
    }

    #[test]
    fn compact_adam_shares_one_second_moment_per_colour_channel() {
        let (mut own, mut shared) = (Gaussians64::zeros(1, 1), Gaussians64::zeros(1, 1));
        let (mut own_state, mut state) = (AdamState::new(1, 1), AdamState::new(1, 1));
        for step in 1..=4 {
            let mut v = Gaussians64::zeros(1, 1);
            for parameter in 0..v.parameters() {
                *v.parameter_mut(0, parameter) = 1e-4 * (0.7 * f64::from(step) + parameter as f64).sin();
            }
            adam(&mut own, &v, &mut own_state, &[true], &RATES);
            adam_compact(&mut shared, &v, &mut state, &[true], &RATES);
        }
        for parameter in 0..own.parameters() {
            let (a, b) = (own.parameter(0, parameter), shared.parameter(0, parameter));
            if parameter < 14 {
                assert_eq!(a, b, "{}", Gaussians64::parameter_name(parameter));
            } else {
                // The same first moments, divided by another second moment.
                assert_ne!(a, b, "{}", Gaussians64::parameter_name(parameter));
                assert_eq!(own_state.first.parameter(0, parameter), state.first.parameter(0, parameter));
            }
        }
    }

    #[test]
    fn a_parameter_without_gradient_stays() {
        let (mut value, mut first, mut second) = (3.0, 0.0, 0.0);
        adam_update(&mut value, 0.0, &mut first, &mut second, 1, 0.1);
        assert_eq!((value, first, second), (3.0, 0.0, 0.0));
    }

    #[test]
    fn each_parameter_moves_by_its_rate_where_the_view_sees_it() {
        let mut model = Gaussians64::zeros(3, 1);
        let mut v_model = Gaussians64::zeros(3, 1);
        for index in 0..3 {
            for parameter in 0..v_model.parameters() {
                *v_model.parameter_mut(index, parameter) = 1e-6 * (parameter as f64 + 1.0);
            }
        }
        let mut state = AdamState::new(3, 1);
        adam(&mut model, &v_model, &mut state, &[true, false, true], &RATES);
        adam(&mut model, &v_model, &mut state, &[true, false, false], &RATES);
        assert_eq!(state.steps, [2, 0, 1]);
        for parameter in 0..model.parameters() {
            // A constant gradient of any size moves the parameter by its rate at every step.
            let rate = RATES.of_parameter(parameter);
            for (index, updates) in [(0, 2.0), (1, 0.0), (2, 1.0)] {
                let value = model.parameter(index, parameter);
                let name = Gaussians64::parameter_name(parameter);
                // 1e-8: EPSILON against a gradient of 1e-6 is 1e-9 of the step.
                assert!((value + updates * rate).abs() < 1e-8 * rate, "{name} of {index}: {value}");
            }
        }
    }
}
