//! Tests of layers against plain loops and central differences.

use super::random;
use crate::nets::attention::{AttentionGate, SeResidual, SqueezeExcite};
use crate::nets::layers::{
    Conv, GROUPS, GroupNorm, Image, Linear, MeanConv, UpConv, VARIANCE_FLOOR, halve, halve_backward, relu,
    relu_backward,
};
use crate::nets::parameters::{Layout, Parameters, Place};

/// Layers in f64 with random weights.
struct Fixture {
    weights: Vec<f64>,
    places: Vec<Place>,
}

impl Fixture {
    fn new(layout: Layout) -> Self {
        let places = layout.places();
        let count = Parameters::new(layout, 0).values().len();
        Self { weights: random(21, count), places }
    }

    fn array(&self, place: Place) -> &[f64] {
        place.of(&self.weights)
    }
}

/// An image [channels,height,width] of `values`.
fn picture(values: &[f64], [channels, height, width]: [usize; 3]) -> Image<f64> {
    assert_eq!(values.len(), channels * height * width);
    Image { channels, height, width, values: values.to_vec() }
}

#[track_caller]
fn assert_same(what: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (at, (a, b)) in found.iter().zip(expected).enumerate() {
        // Both are f64; sums of a few hundred terms of size 1.
        assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{what}, element {at}: {a} {b}");
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[test]
fn group_norm_matches_plain_loops() {
    let size @ [channels, height, width] = [8, 4, 5];
    let mut layout = Layout::default();
    let norm = GroupNorm::new(&mut layout, channels);
    let fixture = Fixture::new(layout);
    let x = random(22, channels * height * width);
    let pixels = height * width;
    let in_group = channels / GROUPS * pixels;
    let mut expected = x.clone();
    for (group, values) in expected.chunks_mut(in_group).enumerate() {
        let mean = values.iter().sum::<f64>() / in_group as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / in_group as f64;
        for (i, value) in values.iter_mut().enumerate() {
            let channel = group * (channels / GROUPS) + i / pixels;
            let normal = (*value - mean) / (variance + VARIANCE_FLOOR).sqrt();
            *value = normal * fixture.array(norm.scale)[channel] + fixture.array(norm.shift)[channel];
        }
    }
    assert_same("norm", &norm.forward(&fixture.weights, picture(&x, size)).0.values, &expected);
}

#[test]
fn squeeze_and_excitation_matches_plain_loops() {
    let size @ [channels, height, width] = [8, 4, 6];
    let mut layout = Layout::default();
    let block = SqueezeExcite::new(&mut layout, channels);
    let fixture = Fixture::new(layout);
    let arrays: Vec<&[f64]> = fixture.places.iter().map(|place| fixture.array(*place)).collect();
    let [squeeze, squeeze_bias, excite, excite_bias] = arrays.as_slice() else { panic!("four arrays") };
    let x = random(23, channels * height * width);
    let pixels = height * width;
    let means: Vec<f64> =
        x.chunks(pixels).map(|channel| channel.iter().sum::<f64>() / pixels as f64).collect();
    let inner = squeeze_bias.len();
    let hidden: Vec<f64> = (0..inner)
        .map(|j| {
            let sum: f64 = means.iter().enumerate().map(|(c, mean)| mean * squeeze[c * inner + j]).sum();
            (sum + squeeze_bias[j]).max(0.0)
        })
        .collect();
    let gain = |c: usize| {
        let sum: f64 = hidden.iter().enumerate().map(|(j, h)| h * excite[j * channels + c]).sum();
        sigmoid(sum + excite_bias[c])
    };
    assert!(hidden.iter().any(|h| *h > 0.0) && hidden.contains(&0.0), "both sides of the ReLU");
    let expected: Vec<f64> = x.iter().enumerate().map(|(i, x)| x * gain(i / pixels)).collect();
    assert_same("squeeze", &block.forward(&fixture.weights, picture(&x, size)).0.values, &expected);
}

#[test]
fn attention_gate_matches_plain_loops() {
    let size @ [channels, height, width] = [8, 4, 6];
    let mut layout = Layout::default();
    let gate = AttentionGate::new(&mut layout, channels);
    let fixture = Fixture::new(layout);
    let pixels = height * width;
    let (gating, skip) = (random(24, channels * pixels), random(25, channels * pixels));
    let pointwise = |conv: &Conv, x: &[f64], pixel: usize| -> Vec<f64> {
        let (to, from) = (conv.to, conv.from);
        let weight = fixture.array(conv.weight);
        (0..to)
            .map(|o| {
                let sum: f64 = (0..from).map(|i| weight[o * from + i] * x[i * pixels + pixel]).sum();
                sum + fixture.array(conv.bias)[o]
            })
            .collect()
    };
    let gains: Vec<f64> = (0..pixels)
        .map(|pixel| {
            let joint: Vec<f64> = pointwise(&gate.gating, &gating, pixel)
                .iter()
                .zip(pointwise(&gate.skip, &skip, pixel))
                .map(|(a, b)| (a + b).max(0.0))
                .collect();
            let psi: f64 = joint.iter().zip(fixture.array(gate.psi.weight)).map(|(j, w)| j * w).sum();
            sigmoid(psi + fixture.array(gate.psi.bias)[0])
        })
        .collect();
    let expected: Vec<f64> = skip.iter().enumerate().map(|(i, x)| x * gains[i % pixels]).collect();
    let (found, _) = gate.forward(&fixture.weights, &picture(&gating, size), &picture(&skip, size));
    assert_same("gate", &found.values, &expected);
}

#[test]
fn convolution_and_its_mean_match_plain_loops() {
    // Including odd sizes and counts, so that blocks of the inner loops are not full.
    for (size @ [from, height, width], to) in
        [([16, 8, 12], 8), ([1, 8, 12], 8), ([3, 5, 7], 5), ([2, 2, 2], 1), ([4, 23, 19], 6)]
    {
        let mut layout = Layout::default();
        let mean = MeanConv::new(&mut layout, from, to);
        let conv = &mean.0;
        let fixture = Fixture::new(layout);
        let x = random(26, from * height * width);
        let mut expected = Vec::new();
        for o in 0..to {
            for (y, column) in (0..height).flat_map(|y| (0..width).map(move |column| (y, column))) {
                let mut sum = fixture.array(conv.bias)[o];
                for (i, ky, kx) in (0..from * 9).map(|tap| (tap / 9, tap / 3 % 3, tap % 3)) {
                    let (row, at) = ((y + ky).wrapping_sub(1), (column + kx).wrapping_sub(1));
                    if row < height && at < width {
                        let weight = fixture.array(conv.weight)[((o * 3 + ky) * 3 + kx) * from + i];
                        sum += weight * x[(i * height + row) * width + at];
                    }
                }
                expected.push(sum);
            }
        }
        assert_same("conv", &conv.forward(&fixture.weights, &picture(&x, size)).values, &expected);
        let means: Vec<f64> = expected
            .chunks(height * width)
            .map(|channel| channel.iter().sum::<f64>() / (height * width) as f64)
            .collect();
        assert_same("mean", &mean.forward(&fixture.weights, &picture(&x, size)).0, &means);
    }
}

#[test]
fn transposed_convolution_matches_plain_loops() {
    let (size @ [from, height, width], to) = ([6, 4, 5], 3);
    let mut layout = Layout::default();
    let up = UpConv::new(&mut layout, from, to);
    let fixture = Fixture::new(layout);
    let x = random(29, from * height * width);
    let mut expected = Vec::new();
    for (o, y, column) in (0..to * 4 * height * width)
        .map(|i| (i / (4 * height * width), i / (2 * width) % (2 * height), i % (2 * width)))
    {
        let sum: f64 = (0..from)
            .map(|i| {
                let weight = fixture.array(up.weight)[((o * 2 + y % 2) * 2 + column % 2) * from + i];
                weight * x[(i * height + y / 2) * width + column / 2]
            })
            .sum();
        expected.push(sum + fixture.array(up.bias)[o]);
    }
    assert_same("up", &up.forward(&fixture.weights, &picture(&x, size)).values, &expected);
}

/// Compares the result of `backward(weights, x, v_y, v_weights)` with central differences of
/// `forward(weights, x)`, at all weights and inputs.
#[track_caller]
fn check_gradients(
    what: &str,
    weights: &[f64],
    x: &[f64],
    forward: impl Fn(&[f64], &[f64]) -> Vec<f64>,
    backward: impl Fn(&[f64], &[f64], &[f64], &mut [f64]) -> Vec<f64>,
) {
    let v_y = random(31, forward(weights, x).len());
    let loss = |weights: &[f64], x: &[f64]| -> f64 {
        forward(weights, x).iter().zip(&v_y).map(|(y, v)| y * v).sum()
    };
    // Gradients are added to existing values.
    let mut v_weights = vec![1.0; weights.len()];
    let v_x = backward(weights, x, &v_y, &mut v_weights);
    v_weights.iter_mut().for_each(|v| *v -= 1.0);
    assert_eq!(v_x.len(), x.len(), "{what}");
    let h = 1e-5;
    for (by, analytic, values) in [("weight", &v_weights, weights), ("input", &v_x, x)] {
        assert!(values.is_empty() || analytic.iter().any(|v| v.abs() > 1e-3), "{what}: no gradient by {by}");
        let mut moved = values.to_vec();
        for at in 0..values.len() {
            let mut at_step = |h: f64| {
                moved[at] = values[at] + h;
                let loss = if by == "weight" { loss(&moved, x) } else { loss(weights, &moved) };
                moved[at] = values[at];
                loss
            };
            let numeric = (at_step(h) - at_step(-h)) / (2.0 * h);
            // Rounding is 1e-14 / 1e-5; curvature adds h^2.
            let error = (analytic[at] - numeric).abs();
            assert!(error < 1e-7 * (1.0 + numeric.abs()), "{what}, {by} {at}: {} {numeric}", analytic[at]);
        }
    }
}

#[test]
fn gradients_of_convolutions_match_central_differences() {
    for (size @ [from, ..], to, kernel) in [
        ([2, 5, 7], 5, 3),
        ([1, 4, 4], 4, 3),
        ([9, 3, 4], 3, 3),
        ([5, 6, 3], 1, 1),
        ([16, 4, 4], 8, 1),
        ([4, 9, 4], 1, 3),
    ] {
        let mut layout = Layout::default();
        let conv = Conv::new(&mut layout, from, to, kernel);
        let fixture = Fixture::new(layout);
        let y_size = [to, size[1], size[2]];
        check_gradients(
            &format!("{kernel}x{kernel} from {size:?} to {to}"),
            &fixture.weights,
            &random(32, size.iter().product()),
            |w, x| conv.forward(w, &picture(x, size)).values,
            |w, x, v_y, v_w| conv.backward(w, &picture(x, size), &picture(v_y, y_size), v_w).values,
        );
        if kernel == 3 {
            let mean = MeanConv(conv);
            check_gradients(
                &format!("mean from {size:?} to {to}"),
                &fixture.weights,
                &random(33, size.iter().product()),
                |w, x| mean.forward(w, &picture(x, size)).0,
                |w, x, v_y, v_w| mean.backward(w, &mean.forward(w, &picture(x, size)).1, v_y, v_w).values,
            );
        }
    }
    let (size, to) = ([5, 3, 4], 3);
    let mut layout = Layout::default();
    let up = UpConv::new(&mut layout, size[0], to);
    check_gradients(
        "transposed",
        &Fixture::new(layout).weights,
        &random(34, 60),
        |w, x| up.forward(w, &picture(x, size)).values,
        |w, x, v_y, v_w| up.backward(w, &picture(x, size), &picture(v_y, [to, 6, 8]), v_w).values,
    );
}

#[test]
fn gradients_of_the_other_layers_match_central_differences() {
    let size = [8, 3, 4];
    let even = [8, 6, 2];
    let x = random(35, 96);
    let mut layout = Layout::default();
    let norm = GroupNorm::new(&mut layout, 8);
    check_gradients(
        "norm",
        &Fixture::new(layout).weights,
        &x,
        |w, x| norm.forward(w, picture(x, size)).0.values,
        |w, x, v_y, v_w| {
            norm.backward(w, &norm.forward(w, picture(x, size)).1, picture(v_y, size), v_w).values
        },
    );
    let mut layout = Layout::default();
    let squeeze = SqueezeExcite::new(&mut layout, 8);
    check_gradients(
        "squeeze and excitation",
        &Fixture::new(layout).weights,
        &x,
        |w, x| squeeze.forward(w, picture(x, size)).0.values,
        |w, x, v_y, v_w| {
            squeeze.backward(w, &squeeze.forward(w, picture(x, size)).1, picture(v_y, size), v_w).values
        },
    );
    let mut layout = Layout::default();
    let residual = SeResidual::new(&mut layout, 8);
    check_gradients(
        "residual",
        &Fixture::new(layout).weights,
        &x,
        |w, x| residual.forward(w, picture(x, size)).0.values,
        |w, x, v_y, v_w| {
            let (y, trace) = residual.forward(w, picture(x, size));
            residual.backward(w, &trace, &y, picture(v_y, size), v_w).values
        },
    );
    let mut layout = Layout::default();
    let gate = AttentionGate::new(&mut layout, 8);
    let halves = |x: &[f64]| (picture(&x[..96], size), picture(&x[96..], size));
    check_gradients(
        "gate",
        &Fixture::new(layout).weights,
        &random(36, 192),
        |w, x| {
            let (gating, skip) = halves(x);
            gate.forward(w, &gating, &skip).0.values
        },
        |w, x, v_y, v_w| {
            let (gating, skip) = halves(x);
            let (_, trace) = gate.forward(w, &gating, &skip);
            let (v_gating, v_skip) = gate.backward(w, &gating, &skip, &trace, &picture(v_y, size), v_w);
            [v_gating.values, v_skip.values].concat()
        },
    );
    let mut layout = Layout::default();
    let linear = Linear::pointwise(&mut layout, 7, 5);
    check_gradients(
        "linear",
        &Fixture::new(layout).weights,
        &random(37, 7),
        |w, x| linear.forward(w, x),
        |w, x, v_y, v_w| linear.backward(w, x, v_y, v_w),
    );
    check_gradients(
        "halving",
        &[],
        &x,
        |_, x| halve(&picture(x, even)).0.values,
        |_, x, v_y, _| {
            let (_, places) = halve(&picture(x, even));
            halve_backward(&places, &picture(v_y, [8, 3, 1]), 6, 2).values
        },
    );
}

#[test]
fn nan_propagates_through_every_layer() {
    let mut values = [-1.0, f64::NAN, 2.0, f64::NEG_INFINITY];
    relu(&mut values);
    assert!(values[0] == 0.0 && values[1].is_nan() && values[2..] == [2.0, 0.0], "{values:?}");
    let mut v = [1.0; 4];
    relu_backward(&values, &mut v);
    assert!(v[0] == 0.0 && v[1] == 1.0 && v[2] == 1.0 && v[3] == 0.0, "{v:?}");
    for at in 0..4 {
        let mut values = [3.0, 1.0, 2.0, 4.0];
        values[at] = f64::NAN;
        assert!(halve(&picture(&values, [1, 2, 2])).0.values[0].is_nan(), "{at}");
    }
}
