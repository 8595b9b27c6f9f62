//! Pictures and waters of which nothing can be learnt: runs stay finite, and what they end with is a water.

use std::sync::Arc;

use fathom_core::config::{Composition, WaterConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::Gpu;
use fathom_core::rng::{Stream, random_bits};
use fathom_core::train::{MediumRun, TrainRun, Trainer};
use fathom_core::views::{InMemory, PackedImage};
use fathom_core::water::Water;

use crate::device::device;
use crate::trainer::{config, photographs, run};
use crate::water::{WAYS, with};

const ITERATIONS: u32 = 60;

/// Photographs from the same cameras with other pixels.
fn repainted(photographs: &InMemory, pixel: impl Fn(usize, u32) -> u32) -> InMemory {
    let images = photographs.images.iter().enumerate().map(|(view, image)| {
        let pixels = (0..image.pixels.len() as u32).map(|i| pixel(view, i)).collect();
        Arc::new(PackedImage { pixels, ..PackedImage::clone(image) })
    });
    InMemory { images: images.collect(), views: photographs.views.clone() }
}

#[track_caller]
fn assert_sound(what: &str, gpu: &Arc<Gpu>, run: TrainRun) -> (Gaussians, Water) {
    let mut trainer = Trainer::new(Arc::clone(gpu), run).unwrap();
    let progress = trainer.advance(ITERATIONS).unwrap();
    assert!(progress.loss.is_finite(), "{what}: {progress:?}");
    let (model, water) = (trainer.gaussians().unwrap(), trainer.water().unwrap().unwrap());
    assert!(water.is_physical(), "{what}: {water:?}");
    assert!(water.to_array().iter().all(|value| value.is_finite()), "{what}: {water:?}");
    let numbers = model.means.iter().flatten().chain(model.quats.iter().flatten());
    let numbers = numbers.chain(model.log_scales.iter().flatten()).chain(&model.opacity_logits);
    assert!(numbers.chain(model.sh_coeffs.iter().flatten()).all(|value| value.is_finite()), "{what}");
    (model, water)
}

fn under(photographs: &InMemory, config_of_water: WaterConfig, water: Water, unit: f64) -> TrainRun {
    let medium = MediumRun { water, ..MediumRun::fixed(&config_of_water, Composition::PixelsSrgb, unit) };
    TrainRun { medium: Some(medium), ..run(photographs, config(ITERATIONS)) }
}

#[test]
fn waters_at_the_ends_of_what_a_water_can_be_stay_finite() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let air = Water { beta_d: [0.0; 3], beta_b: [0.0; 3], b_inf: [0.0; 3] };
    let mud = Water { beta_d: [60.0; 3], beta_b: [60.0; 3], b_inf: [1.0; 3] };
    let unlike = Water { beta_d: [1e-9, 1e-3, 30.0], beta_b: [30.0, 0.0, 1e-9], b_inf: [0.0, 1.0, 0.5] };
    for way in WAYS {
        for (name, water) in [("air", air), ("mud", mud), ("unlike channels", unlike)] {
            assert_sound(&format!("{name}, {way:?}"), &gpu, under(&photographs, with(way), water, 3.2));
        }
    }
}

#[test]
fn photographs_of_open_water_noise_or_nothing_stay_finite() {
    let Some(gpu) = device() else { return };
    let seen = photographs(&gpu, 64, 48);
    let blue = repainted(&seen, |_, _| u32::from_le_bytes([30, 90, 150, 255]));
    let noise = repainted(&seen, |view, i| random_bits(7, Stream::Test, i, view as u32)[0] | 0xff00_0000);
    let black = repainted(&seen, |_, _| 0xff00_0000);
    let masked = repainted(&seen, |_, _| 0x0000_ffff);
    let water = Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
    for config_of_water in WAYS.map(with).into_iter().chain([WaterConfig::paper()]) {
        let composed = (config_of_water.medium, config_of_water.blend);
        for (name, photographs) in [("open water", &blue), ("noise", &noise), ("black", &black)] {
            assert_sound(
                &format!("{name}, {composed:?}"),
                &gpu,
                under(photographs, config_of_water.clone(), water, 3.2),
            );
        }
        let (_, left) = assert_sound(
            &format!("masked, {composed:?}"),
            &gpu,
            under(&masked, WaterConfig { l2_weight: 0.0, ..config_of_water }, water, 3.2),
        );
        for (left, start) in left.to_array().into_iter().zip(water.to_array()) {
            assert!((left / start - 1.0).abs() < 1e-4, "pictures that do not count move {start} to {left}");
        }
    }
}

#[test]
fn open_water_becomes_the_colour_of_photographs_that_show_nothing_else() {
    let Some(gpu) = device() else { return };
    let blue = repainted(&photographs(&gpu, 64, 48), |_, _| u32::from_le_bytes([30, 90, 150, 255]));
    let start = Water { beta_d: [0.3; 3], beta_b: [0.3; 3], b_inf: [0.1; 3] };
    for way in WAYS {
        let config_of_water =
            WaterConfig { lr: 0.1, lr_end: 0.02, start_at: 0.0, freeze_at: 1.0, ..with(way) };
        let (_, water) = assert_sound(&format!("{way:?}"), &gpu, under(&blue, config_of_water, start, 3.2));
        let [red, green, blue] = water.b_inf;
        assert!(red < green && green < blue, "{way:?}: {water:?}");
        assert!(red < 0.05 && blue > 0.15, "{way:?}: {water:?}");
    }
}

#[test]
fn a_scene_so_near_that_the_water_does_not_matter_stays_finite_and_moves_only_what_is_seen() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    // The scene is 3 units away; counted in units of 3e4, nothing of the water is between.
    let water = Water { beta_d: [1e-5; 3], beta_b: [1e-5; 3], b_inf: [0.1, 0.2, 0.3] };
    for way in WAYS {
        assert_sound(&format!("{way:?}"), &gpu, under(&photographs, with(way), water, 3e4));
        assert_sound(&format!("{way:?}, tiny unit"), &gpu, under(&photographs, with(way), water, 1e-4));
    }
}
