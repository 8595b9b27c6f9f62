//! Tests of the network against central differences, known answers and a resumed run, and of its layers
//! against plain loops.

mod layers;

use super::parameters::{Layout, Parameters};
use super::water_param_predict::{UNet, image};
use super::{DepthMap, Learned, MAX_RANGE, RELEASE_PRIOR, WaterParamNet, WaterParamPredictor};
use crate::rng::{Stream, uniform_at};
use crate::water::Water;

/// Random numbers in -1..1 from a seed.
fn random(seed: u32, n: usize) -> Vec<f64> {
    (0..n as u32).map(|i| 2.0 * f64::from(uniform_at(seed, Stream::Test, 3, i)) - 1.0).collect()
}

/// A slope from `near` to `far` over the rows, with a bump whose position depends on `seed`.
fn slope(width: u32, height: u32, near: f32, far: f32, seed: u32) -> DepthMap {
    let at = uniform_at(seed, Stream::Test, 4, 0) * width as f32;
    let values = (0..width * height).map(|i| {
        let (x, y) = ((i % width) as f32, (i / width) as f32 / height as f32);
        near + (far - near) * y + 0.2 * near * (-((x - at) / 4.0).powi(2)).exp()
    });
    DepthMap::new(width, height, values.collect()).unwrap()
}

fn network(channels: u32, seed: u32) -> WaterParamNet {
    WaterParamNet::new(channels, RELEASE_PRIOR.to_raw(1.0), seed).unwrap()
}

#[test]
fn new_network_starts_near_its_prior() {
    for channels in [8, 32] {
        let prior = Water::COASTAL.to_raw(5.0);
        let net = WaterParamNet::new(channels, prior, 3).unwrap();
        let raw = net.predict(&slope(24, 16, 0.5, 2.0, 0)).unwrap();
        for (found, expected) in raw.iter().zip(prior) {
            // The last layer adds values with a deviation of 0.05 times features of size 0.1 to 1.
            assert!((f64::from(*found) - expected).abs() < 0.5, "{raw:?} {prior:?}");
        }
    }
}

#[test]
fn gradients_match_central_differences() {
    let (width, height, channels) = (24, 16, 8);
    let mut layout = Layout::default();
    let unet = UNet::new(&mut layout, channels, RELEASE_PRIOR.to_raw(1.0));
    let lengths: Vec<usize> = layout.places().iter().map(|place| place.length()).collect();
    // The initial last layer passes little gradient; a larger one makes every gradient count.
    let parameters = Parameters::new(layout, 5);
    let mut weights: Vec<f64> = parameters.values().iter().map(|v| f64::from(*v)).collect();
    let last = weights.len() - 9 - 2 * channels * 9;
    weights[last..].iter_mut().for_each(|w| *w *= 10.0);

    // Noise makes all pixels of a window different: at equal ones, the maximum has no derivative.
    let mut values = slope(width, height, 0.4, 3.0, 1).values().to_vec();
    values.iter_mut().zip(random(28, 384)).for_each(|(value, noise)| *value += 0.1 * noise as f32);
    let depth = DepthMap::new(width, height, values).unwrap();
    let values: Vec<f64> = depth.values().iter().map(|v| f64::from(*v)).collect();
    let v_raw: [f64; 9] = random(27, 9).try_into().unwrap();
    let loss = |weights: &[f64], values: &[f64]| -> f64 {
        let (raw, _) = unet.forward(weights, image(&depth, values));
        raw.iter().zip(v_raw).map(|(raw, v)| raw * v).sum()
    };
    let pass = unet.pass(&weights, &depth, &values, v_raw, true);
    let v_depth = pass.v_depth.unwrap();

    // Three weights of every array, so that no array without a gradient goes unnoticed.
    let mut samples = Vec::new();
    let mut start = 0;
    for (array, length) in lengths.iter().enumerate() {
        samples.extend((0..3).map(|k| (array, start + (k * 7919 + array) % length)));
        start += length;
    }
    // Rounding of the loss over the step is 1e-16 / 1e-6 = 1e-10. A step this small seldom crosses the kink
    // of one of the ten thousand ReLUs and maxima.
    let h = 1e-6;
    let check = |what: String, analytic: f64, numeric: f64, scale: f64| {
        let tolerance = 1e-5 * analytic.abs().max(scale);
        assert!((analytic - numeric).abs() < tolerance, "{what}: {analytic:e} {numeric:e}");
    };
    let mut moved = weights.clone();
    let mut arrays_with_gradient = vec![false; lengths.len()];
    for (array, at) in samples {
        let difference = |h: f64, moved: &mut Vec<f64>| {
            moved[at] = weights[at] + h;
            let loss = loss(moved, &values);
            moved[at] = weights[at];
            loss
        };
        let numeric = (difference(h, &mut moved) - difference(-h, &mut moved)) / (2.0 * h);
        check(format!("weight {at} of array {array}"), pass.v_weights[at], numeric, 1e-3);
        arrays_with_gradient[array] |= pass.v_weights[at].abs() > 1e-6;
    }
    // A bias before a normalisation has little effect on its group. But more than one array in ten without a
    // gradient means a broken graph.
    let without = arrays_with_gradient.iter().filter(|with| !**with).count();
    assert!(without <= lengths.len() / 10, "{without} of {} arrays", lengths.len());
    for at in (0..values.len()).step_by(13) {
        let (mut up, mut down) = (values.clone(), values.clone());
        up[at] += h;
        down[at] -= h;
        let numeric = (loss(&weights, &up) - loss(&weights, &down)) / (2.0 * h);
        check(format!("depth {at}"), v_depth[at], numeric, 1e-3);
        assert!(v_depth[at] != 0.0, "depth {at} counts");
    }

    // Training in f32 gives the same up to its rounding through a dozen layers.
    let narrow: Vec<f32> = weights.iter().map(|w| *w as f32).collect();
    let f32s = unet.pass(&narrow, &depth, depth.values(), v_raw.map(|v| v as f32), true);
    let largest = |v: &[f64]| v.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
    for (what, exact, found) in
        [("weights", &pass.v_weights, &f32s.v_weights), ("depth", &v_depth, &f32s.v_depth.unwrap())]
    {
        let scale = largest(exact);
        for (at, (a, b)) in exact.iter().zip(found).enumerate() {
            assert!((a - f64::from(*b)).abs() < 2e-4 * scale, "{what} {at}: {a} {b}");
        }
    }
}

/// Trains on (map, target) pairs in turn, with half the squared distance of the outputs as loss. Returns the
/// largest error at the end.
fn overfit(net: &mut WaterParamNet, pairs: &[(DepthMap, [f64; 9])], steps: usize) -> f64 {
    for step in 0..steps {
        let (depth, target) = &pairs[step % pairs.len()];
        let raw = net.predict(depth).unwrap();
        let v_raw = std::array::from_fn(|i| raw[i] - target[i] as f32);
        // The learning rate decays to a hundredth, so that Adam settles.
        let learning_rate = 0.01 * 0.01_f32.powf(step as f32 / steps as f32);
        let learned = net.learn(depth, v_raw, learning_rate, false).unwrap();
        assert_eq!(learned, Learned { raw, v_depth: None, stepped: true }, "learning repeats the same pass");
    }
    let miss = |(depth, target): &(DepthMap, [f64; 9])| {
        let raw = net.predict(depth).unwrap();
        raw.iter().zip(target).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
    };
    pairs.iter().map(miss).fold(0.0, f64::max)
}

#[test]
fn many_views_agree_on_one_water() {
    let target = Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
    let raw = target.to_raw(4.0);
    let pairs: Vec<_> =
        (0..6).map(|i| (slope(24, 16, 0.3 + 0.1 * i as f32, 1.0 + 0.4 * i as f32, i), raw)).collect();
    let mut net = network(8, 1);
    let miss = overfit(&mut net, &pairs, 240);
    assert!(miss < 0.03, "largest error of the unconstrained parameters {miss}");
    let found = net.predict(&pairs[0].0).unwrap().map(f64::from);
    let found = Water::from_raw(found, 4.0);
    for (found, expected) in found.to_array().iter().zip(target.to_array()) {
        assert!((found / expected - 1.0).abs() < 0.03, "{found} {expected}");
    }
    // An unseen view gives the same water.
    let unseen = net.predict(&slope(24, 16, 0.55, 1.9, 77)).unwrap();
    assert!(unseen.iter().zip(raw).all(|(a, b)| (f64::from(*a) - b).abs() < 0.15), "{unseen:?} {raw:?}");
}

#[test]
fn predictions_depend_on_the_depth() {
    // The second map is the first one at three times the distance: no normalisation may remove this
    // difference.
    let (near, far) = (slope(24, 16, 0.4, 1.2, 5), slope(24, 16, 1.2, 3.6, 5));
    let targets = [Water::COASTAL.to_raw(2.0), RELEASE_PRIOR.to_raw(1.0)];
    let mut net = network(8, 2);
    let miss = overfit(&mut net, &[(near, targets[0]), (far, targets[1])], 480);
    let apart = targets[0].iter().zip(targets[1]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(miss < 0.05 && apart > 0.5, "miss {miss}, targets {apart} apart");
}

/// Trains briefly at a size where threads share the work; returns the state and the result of every step.
fn short_run(seed: u32) -> (Vec<u8>, Vec<Learned>) {
    let mut net = network(16, seed);
    let learned = (0..3)
        .map(|i| {
            let depth = slope(96, 64, 0.5, 2.0 + i as f32, i);
            net.learn(&depth, std::array::from_fn(|k| 0.1 * (k as f32 - 4.0)), 1e-3, true).unwrap()
        })
        .collect();
    (net.to_bytes(), learned)
}

#[test]
fn same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let with = |threads: usize, seed: u32| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| short_run(seed))
    };
    let one = with(1, 7);
    for threads in [1, 2, 3, 8] {
        assert!(with(threads, 7) == one, "{threads} threads");
    }
    assert!(with(1, 8).0 != one.0, "another seed");
}

#[test]
fn resumed_run_gives_the_bytes_of_an_uninterrupted_one() {
    let train = |net: &mut WaterParamNet, steps: std::ops::Range<u32>| {
        for i in steps {
            net.learn(&slope(24, 16, 0.5, 2.0, i), [0.1; 9], 1e-2, false).unwrap();
        }
    };
    let mut whole = network(8, 4);
    train(&mut whole, 0..6);
    let mut first = network(8, 4);
    train(&mut first, 0..3);
    // With another seed, everything that counts must come from the bytes.
    let mut second = network(8, 99);
    second.restore(&first.to_bytes()).unwrap();
    train(&mut second, 3..6);
    assert!(second.to_bytes() == whole.to_bytes());
}

#[test]
fn foreign_or_damaged_states_are_refused_and_change_nothing() {
    let mut net = network(8, 4);
    let sound = net.to_bytes();
    let other = network(16, 4).to_bytes();
    let (mut flipped, mut longer) = (sound.clone(), sound.clone());
    flipped[sound.len() / 2] ^= 1;
    longer.push(0);
    let cases: [(&[u8], &str); 6] = [
        (&[], "other bytes"),
        (&[7; 4000], "other bytes"),
        (&sound[..sound.len() - 4], "torn"),
        (&flipped, "damaged"),
        (&longer, "damaged"),
        (&other, "16 channels"),
    ];
    net.learn(&slope(16, 16, 0.5, 2.0, 0), [0.1; 9], 1e-2, false).unwrap();
    let before = net.to_bytes();
    for (bytes, why) in cases {
        let error = net.restore(bytes).unwrap_err().to_string();
        assert!(error.starts_with("checkpoint: ") && error.contains(why), "{why}: {error}");
        assert!(net.to_bytes() == before, "{why}");
    }
    net.restore(&sound).unwrap();
    assert!(net.to_bytes() == sound);
}

#[test]
fn bad_maps_and_gradients_are_reported_and_stay_finite() {
    let mut net = network(8, 6);
    let bad = |value: f32| DepthMap::new(24, 16, vec![value; 24 * 16]).unwrap();
    for (value, unusable, coverage) in
        [(0.0, 0, 0.0), (f32::NAN, 384, 0.0), (f32::INFINITY, 384, 0.0), (1e30, 0, 1.0), (1e-30, 0, 1.0)]
    {
        let depth = bad(value);
        assert_eq!((depth.unusable(), depth.coverage()), (unusable, coverage), "{value}");
        let learned = net.learn(&depth, [0.1; 9], 1e-3, true).unwrap();
        assert!(learned.stepped && learned.raw.iter().all(|v| v.is_finite()), "{value}: {learned:?}");
        let v_depth = learned.v_depth.unwrap();
        assert!(v_depth.iter().all(|v| v.is_finite()), "{value}");
        let flat = value == 0.0 || !value.is_finite() || value > MAX_RANGE;
        assert_eq!(v_depth.iter().all(|v| *v == 0.0), flat, "{value}");
    }
    let before = net.to_bytes();
    for v in [f32::NAN, f32::INFINITY, f32::MAX] {
        let learned = net.learn(&slope(24, 16, 0.5, 2.0, 0), [v; 9], 1e-3, true).unwrap();
        assert!(!learned.stepped && learned.v_depth.is_none(), "{v}");
        assert!(learned.raw.iter().all(|v| v.is_finite()), "{v}");
    }
    for learning_rate in [f32::NAN, f32::INFINITY, -1e-3] {
        let error = net.learn(&bad(1.0), [0.1; 9], learning_rate, false).unwrap_err().to_string();
        assert!(error.contains("learning rate"), "{error}");
    }
    assert!(net.to_bytes() == before, "nothing has changed");
}

#[test]
fn diverged_network_is_reported() {
    let mut net = network(8, 6);
    let depth = slope(24, 16, 0.5, 2.0, 0);
    net.learn(&depth, [1.0; 9], f32::MAX, false).unwrap();
    for error in [net.predict(&depth).unwrap_err(), net.learn(&depth, [1.0; 9], 1e-3, false).unwrap_err()] {
        assert!(error.to_string().contains("diverged"), "{error}");
    }
}

#[test]
fn invalid_networks_are_refused() {
    let prior = RELEASE_PRIOR.to_raw(1.0);
    for channels in [0, 4, 12, 264] {
        let error = WaterParamNet::new(channels, prior, 0).err().unwrap().to_string();
        assert!(error.contains(&channels.to_string()), "{error}");
    }
    assert!(WaterParamNet::new(8, [f64::NAN; 9], 0).err().unwrap().to_string().contains("prior"));
}
