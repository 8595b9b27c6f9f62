//! Pictures and waters that allow no learning: runs stay finite and end with a physical water.

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
use crate::water::{COMPOSITIONS, with};

const ITERATIONS: u32 = 60;

/// The same views with every pixel replaced by `pixel(view, index)`.
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
fn runs_under_extreme_waters_stay_finite() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let air = Water { beta_d: [0.0; 3], beta_b: [0.0; 3], b_inf: [0.0; 3] };
    let mud = Water { beta_d: [60.0; 3], beta_b: [60.0; 3], b_inf: [1.0; 3] };
    let uneven = Water { beta_d: [1e-9, 1e-3, 30.0], beta_b: [30.0, 0.0, 1e-9], b_inf: [0.0, 1.0, 0.5] };
    for composed in COMPOSITIONS {
        for (name, water) in [("air", air), ("mud", mud), ("uneven channels", uneven)] {
            assert_sound(
                &format!("{name}, {composed:?}"),
                &gpu,
                under(&photographs, with(composed), water, 3.2),
            );
        }
    }
}

#[test]
fn runs_on_open_water_noise_black_or_masks_stay_finite() {
    let Some(gpu) = device() else { return };
    let seen = photographs(&gpu, 64, 48);
    let blue = repainted(&seen, |_, _| u32::from_le_bytes([30, 90, 150, 255]));
    let noise = repainted(&seen, |view, i| random_bits(7, Stream::Test, i, view as u32)[0] | 0xff00_0000);
    let black = repainted(&seen, |_, _| 0xff00_0000);
    let masked = repainted(&seen, |_, _| 0x0000_ffff);
    let water = Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
    for config_of_water in COMPOSITIONS.map(with).into_iter().chain([WaterConfig::paper()]) {
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
            assert!((left / start - 1.0).abs() < 1e-4, "masked pictures move {start} to {left}");
        }
    }
}

#[test]
fn photographs_of_open_water_alone_set_its_colour() {
    let Some(gpu) = device() else { return };
    let blue = repainted(&photographs(&gpu, 64, 48), |_, _| u32::from_le_bytes([30, 90, 150, 255]));
    let start = Water { beta_d: [0.3; 3], beta_b: [0.3; 3], b_inf: [0.1; 3] };
    for composed in COMPOSITIONS {
        let config_of_water =
            WaterConfig { lr: 0.1, lr_end: 0.02, start_at: 0.0, freeze_at: 1.0, ..with(composed) };
        let (_, water) =
            assert_sound(&format!("{composed:?}"), &gpu, under(&blue, config_of_water, start, 3.2));
        let [red, green, blue] = water.b_inf;
        assert!(red < green && green < blue, "{composed:?}: {water:?}");
        assert!(red < 0.05 && blue > 0.15, "{composed:?}: {water:?}");
    }
}

#[test]
fn runs_stay_finite_at_huge_and_tiny_scene_scales() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    // The scene is 3 units away, so this water has no visible effect. The scene scales are far too large and
    // far too small.
    let water = Water { beta_d: [1e-5; 3], beta_b: [1e-5; 3], b_inf: [0.1, 0.2, 0.3] };
    for composed in COMPOSITIONS {
        assert_sound(&format!("{composed:?}"), &gpu, under(&photographs, with(composed), water, 3e4));
        assert_sound(
            &format!("{composed:?}, tiny scale"),
            &gpu,
            under(&photographs, with(composed), water, 1e-4),
        );
    }
}
