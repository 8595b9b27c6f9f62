//! Metrics on held-out views during a run.

use std::sync::Arc;

use fathom_core::config::{Composition, TrainConfig, WaterConfig};
use fathom_core::gpu::{Output, Renderer, WaterView};
use fathom_core::metrics::quantised;
use fathom_core::train::{MediumRun, TrainRun, Trainer};
use fathom_core::views::ViewSource as _;
use fathom_core::water::Water;

use crate::device::device;
use crate::trainer::{
    assert_same_model, config, mean_psnr, photographs, photographs_from, run, start, truth,
};

#[test]
fn measuring_reports_the_current_model_and_changes_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let held_out = photographs_from(&gpu, &truth(), 48, 36, &[-0.7, 0.1, 0.5]);
    let config = || TrainConfig { exposure: true, random_background: true, ..config(40) };
    let mut plain = Trainer::new(Arc::clone(&gpu), run(&photographs, config())).unwrap();
    plain.advance(40).unwrap();
    let mut measured = Trainer::new(Arc::clone(&gpu), run(&photographs, config())).unwrap();
    let mut history = Vec::new();
    for _ in 0..4 {
        let iteration = measured.advance(10).unwrap().iteration;
        let metrics = measured.measure(&held_out, || true).unwrap().unwrap();
        let expected = mean_psnr(&gpu, &measured.gaussians().unwrap(), &held_out);
        assert!((metrics.psnr_db - expected).abs() < 1e-9, "{metrics:?}, expected {expected} dB");
        assert_eq!((metrics.iteration, metrics.views), (iteration, 3));
        history.push(metrics);
    }
    assert!(
        history[3].psnr_db > history[0].psnr_db + 1.0 && history[3].ssim > history[0].ssim,
        "{history:?}"
    );
    assert_eq!(
        measured.measure(&held_out, || false).unwrap(),
        None,
        "a cancelled measurement must return nothing"
    );
    let (plain, measured) = (plain.gaussians().unwrap(), measured.gaussians().unwrap());
    assert_same_model("with measurements during the run", &plain, &measured);
}

#[test]
fn the_measuring_interval_is_not_part_of_the_run() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 32, 24);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config(20))).unwrap();
    trainer.advance(5).unwrap();
    let checkpoint = trainer.checkpoint().unwrap();
    let other = TrainConfig { eval_every: 7, preview_seconds: 1, preview_views: 5, ..config(20) };
    assert!(Trainer::resume(Arc::clone(&gpu), run(&photographs, other), &checkpoint).is_ok());
}

#[test]
fn previews_show_all_that_the_run_sees_and_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let water = Water { beta_d: [0.3, 0.2, 0.1], beta_b: [0.2; 3], b_inf: [0.05, 0.2, 0.3] };
    let medium =
        MediumRun { water, ..MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, 3.2) };
    let (focus, context) = start().split_by(|mean| mean[0] < 0.0);
    let new = || TrainRun {
        focus: focus.clone(),
        context: context.clone(),
        medium: Some(medium.clone()),
        surface: None,
        ..run(&photographs, config(30))
    };
    let mut plain = Trainer::new(Arc::clone(&gpu), new()).unwrap();
    plain.advance(30).unwrap();
    let mut shown = Trainer::new(Arc::clone(&gpu), new()).unwrap();
    let cameras: Vec<_> = photographs.views().iter().take(2).map(|view| (view.camera, view.pose)).collect();
    for _ in 0..3 {
        shown.advance(10).unwrap();
        let previews = shown.preview(&cameras, || true).unwrap();
        assert_eq!(previews.len(), cameras.len());
        let mut all = shown.gaussians().unwrap();
        (0..context.len()).for_each(|index| all.push_from(&context, index));
        let mut renderer = Renderer::new(Arc::clone(&gpu), &all).unwrap();
        let under = shown.water_view().unwrap().unwrap();
        for (preview, (camera, pose)) in previews.iter().zip(&cameras) {
            for (picture, output) in
                [(Some(&preview.render), Output::Underwater), (preview.clear.as_ref(), Output::Restored)]
            {
                renderer.set_water(Some(WaterView { output, ..under }));
                let expected = renderer.render(camera, pose, [0.0; 3]).unwrap();
                let expected = quantised(expected.width, expected.height, &expected.rgb).to_rgb8();
                // The order of equal depths, and with it the last bit, may differ.
                let differs = |(a, b): (&u8, &u8)| a.abs_diff(*b) > 1;
                let picture = picture.unwrap();
                assert_eq!(picture.len(), expected.len());
                assert_eq!(
                    picture.iter().zip(&expected).filter(|pair| differs(*pair)).count(),
                    0,
                    "{output:?}"
                );
            }
            assert_ne!(Some(&preview.render), preview.clear.as_ref(), "the water is visible");
        }
    }
    assert_same_model(
        "with previews during the run",
        &plain.gaussians().unwrap(),
        &shown.gaussians().unwrap(),
    );
}
