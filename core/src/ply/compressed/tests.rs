//! Decodes what was written by the rules of the engine's reader, and bounds each error.

use super::*;
use crate::ply::header::{Header, Scalar};
use crate::rng::{Stream, uniform_at};

/// A Gaussian as the engine decodes it (`SplatCompressedIterator`).
struct Decoded {
    mean: [f64; 3],
    quat_wxyz: [f64; 4],
    log_scale: [f64; 3],
    colour: [f64; 3],
    alpha: f64,
    /// Channel by channel.
    rest: Vec<f64>,
    /// Half a step of centre, logarithm of the scale and colour in its chunk.
    half_steps: [[f64; 3]; 3],
}

struct File {
    header: Header,
    gaussians: Vec<Decoded>,
}

fn decode(bytes: &[u8]) -> File {
    let mut body = bytes;
    let header = Header::read(&mut body).unwrap();
    let names = |element: usize, kind: Scalar| {
        let element = &header.elements[element];
        assert!(element.properties.iter().all(|property| property.kind == kind) && !element.has_list);
        element.properties.iter().map(|property| property.name.clone()).collect::<Vec<_>>().join(" ")
    };
    let [chunks, rows] = [0, 1].map(|n| header.elements[n].count as usize);
    assert_eq!((names(0, Scalar::F32).as_str(), names(1, Scalar::U32).as_str()), (BOUNDS, PACKED));
    assert_eq!(chunks, rows.div_ceil(256));
    let rest = header.elements.get(2).map_or(0, |sh| {
        assert_eq!((sh.name.as_str(), sh.count as usize), ("sh", rows));
        assert!(names(2, Scalar::U8).starts_with("f_rest_0 f_rest_1 f_rest_2 f_rest_3"));
        sh.properties.len()
    });
    assert_eq!(body.len(), chunks * 72 + rows * (16 + rest));
    let (bounds, body) = body.split_at(chunks * 72);
    let (words, harmonics) = body.split_at(rows * 16);
    let bound = |chunk: usize, n: usize| Scalar::F32.read(&bounds[chunk * 72 + n * 4..], false);
    let word = |row: usize, n: usize| Scalar::U32.read(&words[row * 16 + n * 4..], false) as u32;
    let unorm = |value: u32, bits: u32| f64::from(value & ((1 << bits) - 1)) / f64::from((1_u32 << bits) - 1);
    let gaussians = (0..rows).map(|row| {
        let mut half_steps = [[0.0; 3]; 3];
        let mut three = |part: usize, shares: [f64; 3], bits: [u32; 3]| {
            [0, 1, 2].map(|n| {
                let (lo, hi) = (bound(row / 256, 6 * part + n), bound(row / 256, 6 * part + 3 + n));
                half_steps[part][n] = 0.5 * (hi - lo) / f64::from((1_u32 << bits[n]) - 1);
                lo * (1.0 - shares[n]) + hi * shares[n]
            })
        };
        let elevens = |word: u32| [unorm(word >> 21, 11), unorm(word >> 11, 10), unorm(word, 11)];
        let (colour, turn) = (word(row, 3), word(row, 1));
        let [a, b, c] = [20, 10, 0].map(|shift| (unorm(turn >> shift, 10) - 0.5) * std::f64::consts::SQRT_2);
        let m = (1.0 - (a * a + b * b + c * c)).sqrt();
        Decoded {
            mean: three(0, elevens(word(row, 0)), [11, 10, 11]),
            log_scale: three(1, elevens(word(row, 2)), [11, 10, 11]),
            colour: three(2, [24, 16, 8].map(|shift| unorm(colour >> shift, 8)), [8; 3]),
            alpha: unorm(colour, 8),
            quat_wxyz: [[m, a, b, c], [a, m, b, c], [a, b, m, c], [a, b, c, m]][(turn >> 30) as usize],
            rest: harmonics[row * rest..(row + 1) * rest]
                .iter()
                .map(|&v| f64::from(v) * 8.0 / 255.0 - 4.0)
                .collect(),
            half_steps,
        }
    });
    File { gaussians: gaussians.collect(), header }
}

/// Random Gaussians of all sizes; the opacity logit is the number of each, so that it is found again.
fn sample(count: usize, sh_degree: u8) -> Gaussians {
    let mut model = Gaussians::empty(sh_degree);
    for n in 0..count {
        let value = |slot: u32| uniform_at(7, Stream::Test, n as u32, slot) * 2.0 - 1.0;
        model.means.push([5.0 * value(0), 50.0 * value(1), value(2)]);
        model.quats.push([value(3), value(4), value(5), value(6)].map(|v| 3.0 * v));
        model.log_scales.push([value(7) * 8.0 - 2.0, value(8), 25.0 * value(9)]);
        model.opacity_logits.push(8.0 * value(10));
        (0..model.coeffs() as u32).for_each(|k| {
            model.sh_coeffs.push([0, 1, 2].map(|channel| 4.0 * value(20 + 3 * k + channel)));
        });
    }
    model
}

/// The Gaussian of a model that is nearest to a decoded one, by centre and alpha.
fn original(model: &Gaussians, found: &Decoded) -> usize {
    let apart = |index: usize| {
        let alpha = 1.0 / (1.0 + (-f64::from(model.opacity_logits[index])).exp());
        let centre: f64 = (0..3).map(|n| (f64::from(model.means[index][n]) - found.mean[n]).abs()).sum();
        centre + (alpha - found.alpha).abs()
    };
    (0..model.len()).min_by(|&a, &b| apart(a).total_cmp(&apart(b))).unwrap()
}

#[test]
fn what_the_engine_decodes_is_the_model_up_to_its_steps() {
    for (count, sh_degree) in [(1, 3), (255, 0), (256, 1), (257, 2), (700, 3)] {
        let model = sample(count, sh_degree);
        let copy = compressed(&model, &[]).unwrap();
        let file = decode(&copy.bytes);
        assert_eq!((copy.gaussians, copy.left_out, file.gaussians.len()), (count, 0, count));
        let (mut seen, k) = (vec![false; count], model.coeffs());
        for found in &file.gaussians {
            let index = original(&model, found);
            assert!(!std::mem::replace(&mut seen[index], true), "Gaussian {index} is there twice");
            let near = |found: f64, value: f32, bound: f64, what: &str| {
                // Bounds are floats, so a value may be off by their rounding too.
                let bound = bound + 1e-6 * f64::from(value).abs().max(1.0);
                let apart = (found - f64::from(value)).abs();
                assert!(apart <= bound, "{what} of Gaussian {index}: {found}, was {value}, bound {bound}");
            };
            let sh = &model.sh_coeffs[index * k..(index + 1) * k];
            for n in 0..3 {
                near(found.mean[n], model.means[index][n], found.half_steps[0][n], "centre");
                let log = model.log_scales[index][n].clamp(-20.0, 20.0);
                near(found.log_scale[n], log, found.half_steps[1][n], "scale");
                near(found.colour[n], 0.5 + SH_C0 * sh[0][n], found.half_steps[2][n], "colour");
                for (place, rgb) in sh[1..].iter().enumerate() {
                    // Writer and reader of PlayCanvas count steps of 1/256 and of 1/255.
                    near(found.rest[n * (k - 1) + place], rgb[n], 8.0 / 256.0, "harmonic");
                }
            }
            let alpha = 1.0 / (1.0 + (-f64::from(model.opacity_logits[index])).exp());
            near(found.alpha, alpha as f32, 0.5 / 255.0, "alpha");
            // The same rotation has two quaternions. Half a step of a component is sqrt(2) / 2046; the
            // largest is at least 1/2 and is found from three others.
            let quat = model.quats[index].map(f64::from);
            let norm = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
            let cosine: f64 = quat.iter().zip(found.quat_wxyz).map(|(a, b)| a / norm * b).sum();
            let half = std::f64::consts::SQRT_2 / 2046.0;
            assert!(cosine.abs() > 1.0 - 2.0 * 3.0 * half * half, "rotation of {index}: cosine {cosine}");
        }
        assert!(seen.iter().all(|&seen| seen));
    }
}

#[test]
fn known_values_have_known_bits() {
    let mut model = sample(2, 0);
    model.means = vec![[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]];
    model.quats = vec![[1.0, 0.0, 0.0, 0.0], [0.0, -2.0, 0.0, 0.0]];
    model.log_scales = vec![[-30.0, -3.0, 0.0], [-3.0, -3.0, 30.0]];
    model.opacity_logits = vec![40.0, -40.0];
    model.sh_coeffs = vec![[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]];
    let bytes = compressed(&model, &["one".to_owned()]).unwrap().bytes;
    let words: Vec<u32> = bytes[bytes.len() - 32..]
        .chunks_exact(4)
        .map(|word| u32::from_le_bytes(word.try_into().unwrap()))
        .collect();
    // 0 is step 511.5 of 1023, rounded up; a range of nothing is step 0.
    let middle = 512 << 20 | 512 << 10 | 512;
    assert_eq!(words[..4], [0, middle, 0, 0x00FF_00FF]);
    assert_eq!(words[4..], [u32::MAX, 1 << 30 | middle, 2047 << 21 | 2047, 0xFF00_0000]);
    let bounds: Vec<f32> = bytes[bytes.len() - 32 - 72..bytes.len() - 32]
        .chunks_exact(4)
        .map(|float| f32::from_le_bytes(float.try_into().unwrap()))
        .collect();
    assert_eq!(bounds[..12], [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, -20.0, -3.0, 0.0, -3.0, -3.0, 20.0]);
    assert_eq!(
        [127, 128, 0, 255, 255],
        [(0.0, 0), (0.0, 1), (-9.0, 0), (9.0, 0), (4.0, 0)].map(|(v, n)| harmonic(v, n))
    );
}

#[test]
fn equal_centres_and_a_single_gaussian_decode_exactly() {
    for count in [1, 300] {
        let mut model = sample(count, 0);
        model.means = vec![[1.5, -2.5, 1e-3]; count];
        let file = decode(&compressed(&model, &[]).unwrap().bytes);
        assert!(file.gaussians.iter().all(|found| found.mean == [1.5, -2.5, f64::from(1e-3_f32)]));
    }
}

#[test]
fn the_same_model_gives_the_same_bytes_in_any_order() {
    let model = sample(900, 1);
    let comments = ["fathom_water {\"a\": \"é\"}".to_owned(), "antialiased: yes".to_owned()];
    let copy = compressed(&model, &comments).unwrap();
    assert_eq!(copy, compressed(&model, &comments).unwrap());
    assert_eq!(decode(&copy.bytes).header.comments, comments);
    let backwards: Vec<u32> = (0..900).rev().collect();
    assert_eq!(compressed(&model.in_order(&backwards), &comments).unwrap(), copy);
    assert!(compressed(&model, &["two\nlines".to_owned()]).unwrap_err().to_string().contains("one line"));
}

#[test]
fn gaussians_without_a_finite_place_or_shape_are_left_out() {
    let mut model = sample(300, 1);
    model.means[3][1] = f32::NAN;
    model.quats[4] = [0.0; 4];
    model.log_scales[5][2] = f32::INFINITY;
    model.opacity_logits[6] = f32::NAN;
    model.sh_coeffs[7 * 4 + 2][0] = f32::NEG_INFINITY;
    let copy = compressed(&model, &[]).unwrap();
    assert_eq!((copy.gaussians, copy.left_out, decode(&copy.bytes).gaussians.len()), (295, 5, 295));
    model.means = vec![[f32::NAN; 3]; 300];
    let error = compressed(&model, &[]).unwrap_err().to_string();
    assert!(error.contains("none of the 300 Gaussians"), "{error}");
    assert!(compressed(&Gaussians::empty(3), &[]).is_err());
}

#[test]
fn chunks_are_compact_though_some_gaussians_are_far() {
    let mut model = sample(20_000, 0);
    // A background at 100 times the distance.
    (0..200).for_each(|n| model.means[100 * n] = model.means[100 * n].map(|v| 1000.0 * v));
    let file = decode(&compressed(&model, &[]).unwrap().bytes);
    let mut steps: Vec<f64> = file.gaussians.iter().map(|found| found.half_steps[0][1]).collect();
    steps.sort_by(f64::total_cmp);
    // The longest side is 100. 79 chunks split each side about 4 times, and many lie across a split: their
    // side is 50 at most. One that held near and far Gaussians would have a side of 50,000.
    let (half, most) = (steps[10_000], steps[19_500]);
    assert!(half < 0.5 * 50.0 / 1023.0 && most < 0.5 * 101.0 / 1023.0, "{half} and {most}");
}

#[test]
fn harmonics_that_are_all_zero_take_no_room() {
    let mut model = sample(10, 3);
    model.sh_coeffs.chunks_exact_mut(16).for_each(|coeffs| coeffs[1..].fill([0.0; 3]));
    assert_eq!(decode(&compressed(&model, &[]).unwrap().bytes).header.elements.len(), 2);
    // One that is not zero: the zeros of the others are 0 in the mean.
    model.sh_coeffs[5] = [0.5; 3];
    let file = decode(&compressed(&model, &[]).unwrap().bytes);
    let all: Vec<f64> = file.gaussians.iter().flat_map(|found| found.rest.clone()).collect();
    let mean = all.iter().sum::<f64>() / all.len() as f64;
    assert!((mean - 1.5 / all.len() as f64).abs() < 1e-3, "{mean}");
}
