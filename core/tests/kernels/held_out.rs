//! Metrics on held-out views during a run.

use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::train::Trainer;

use crate::device::device;
use crate::trainer::{assert_same_model, config, mean_psnr, photographs, photographs_from, run, truth};

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
    let other = TrainConfig { eval_every: 7, ..config(20) };
    assert!(Trainer::resume(Arc::clone(&gpu), run(&photographs, other), &checkpoint).is_ok());
}
