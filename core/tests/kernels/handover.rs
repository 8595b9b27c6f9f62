//! Runs whose water is replaced partway through.

use std::sync::Arc;

use fathom_core::CoreError;
use fathom_core::config::{Composition, Moments, TrainConfig, WaterConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::train::{MediumRun, Surroundings, TrainRun, Trainer};
use fathom_core::views::InMemory;
use fathom_core::water::Water;

use crate::device::device;
use crate::trainer::{assert_same_model, config, mean_psnr, photographs, run};

const ITERATIONS: u32 = 40;

fn start() -> MediumRun {
    let water = Water { beta_d: [0.2; 3], beta_b: [0.2; 3], b_inf: [0.1; 3] };
    MediumRun { water, ..MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, 3.2) }
}

fn watery(photographs: &InMemory, medium: MediumRun) -> TrainRun {
    // These pictures are too small to be halved. Harmonics start at once while the water is frozen.
    let config = TrainConfig { exposure: true, sh_degree_at: [0.0; 3], ..config(ITERATIONS) };
    TrainRun { medium: Some(medium), ..run(photographs, config) }
}

#[test]
fn a_run_continues_under_another_water_with_all_else_unchanged() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let new = || watery(&photographs, start());
    let free = WaterConfig::default().free_iterations(ITERATIONS);
    let mut whole = Trainer::new(Arc::clone(&gpu), new()).unwrap();
    whole.advance(free).unwrap();
    let state = whole.checkpoint().unwrap();
    let found = whole.water().unwrap().unwrap();
    whole.advance(ITERATIONS).unwrap();
    assert_eq!(whole.water().unwrap(), Some(found), "the water must stay after its part of the run");
    let whole = whole.gaussians().unwrap();
    let with = |water: Water| MediumRun { water, is_free: false, ..start() };
    let hand_over = |water| {
        Trainer::hand_over(Arc::clone(&gpu), new(), &state, Some(with(water)), None).unwrap().unwrap()
    };

    // The same water changes nothing: rates, density control, harmonics and exposures continue at their
    // iteration.
    let mut same = hand_over(found);
    assert_eq!(same.progress().iteration, free);
    same.advance(ITERATIONS).unwrap();
    assert_same_model("the same water", &whole, &same.gaussians().unwrap());

    // Another water stays and changes J. An interrupted run has the bytes of an uninterrupted one.
    let other = Water { beta_d: [0.5, 0.25, 0.125], ..found };
    let mut uninterrupted = hand_over(other);
    uninterrupted.advance(5).unwrap();
    let checkpoint = uninterrupted.checkpoint().unwrap();
    uninterrupted.advance(ITERATIONS).unwrap();
    assert_eq!(uninterrupted.water().unwrap().unwrap().beta_d, other.beta_d);
    let model = uninterrupted.gaussians().unwrap();
    assert_ne!(model.sh_coeffs, whole.sh_coeffs, "another water must change the colours");
    let mut resumed = hand_over(other);
    resumed.go_to(&checkpoint).unwrap();
    assert_eq!(resumed.progress().iteration, free + 5);
    resumed.advance(ITERATIONS).unwrap();
    assert_same_model("resumed after the exchange", &model, &resumed.gaussians().unwrap());

    // A checkpoint belongs to one water.
    let mut elsewhere = hand_over(found);
    for foreign in [&checkpoint, &state] {
        assert!(matches!(elsewhere.go_to(foreign), Err(CoreError::Checkpoint(_))));
    }
    elsewhere.advance(ITERATIONS).unwrap();
    assert_same_model("a refused checkpoint must change nothing", &whole, &elsewhere.gaussians().unwrap());
    let foreign = Trainer::hand_over(Arc::clone(&gpu), new(), &checkpoint, Some(with(found)), None);
    assert!(matches!(foreign, Err(CoreError::Checkpoint(_))), "the state of another run");
    let dry = TrainRun { medium: None, ..new() };
    let mut trainer = Trainer::new(Arc::clone(&gpu), TrainRun { medium: None, ..new() }).unwrap();
    let state = trainer.checkpoint().unwrap();
    assert!(Trainer::hand_over(Arc::clone(&gpu), dry, &state, Some(with(found)), None).is_err());
}

#[test]
fn only_free_water_parameters_gather_evidence_with_each_step() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    // The third and the last are known exactly, so nothing can move them.
    let errors = [0.1, 0.1, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0];
    let medium = MediumRun { standard_error: Some(errors), ..start() };
    let mut trainer = Trainer::new(Arc::clone(&gpu), watery(&photographs, medium)).unwrap();
    let from = (ITERATIONS as f32 * WaterConfig::default().start_at) as u32;
    trainer.advance(from).unwrap();
    assert_eq!(trainer.water_evidence().unwrap(), Some([0.0; 9]), "before the water moves");
    let mut last = [0.0; 9];
    for _ in 0..4 {
        trainer.advance(5).unwrap();
        let evidence = trainer.water_evidence().unwrap().unwrap();
        for (i, (now, before)) in evidence.into_iter().zip(last).enumerate() {
            if errors[i] == 0.0 {
                assert_eq!(now, 0.0, "parameter {i}");
            } else {
                assert!(now > before && now.is_finite(), "parameter {i}: {now} after {before}");
            }
        }
        last = evidence;
    }
    let free = WaterConfig::default().free_iterations(ITERATIONS);
    trainer.advance(free - trainer.progress().iteration).unwrap();
    let at_the_end = trainer.water_evidence().unwrap();
    trainer.advance(ITERATIONS).unwrap();
    assert_eq!(trainer.water_evidence().unwrap(), at_the_end, "frozen steps must not add evidence");
    let dry = Trainer::new(Arc::clone(&gpu), run(&photographs, config(8))).unwrap();
    assert_eq!(dry.water_evidence().unwrap(), None);
}

#[test]
fn a_run_continues_with_the_kept_gaussians_beside_new_context() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    for (what, medium, moments) in
        [("in air", None, Moments::F32), ("under water", Some(start()), Moments::Compact)]
    {
        let config = TrainConfig { exposure: true, sh_degree_at: [0.0; 3], moments, ..config(ITERATIONS) };
        let new = || TrainRun { medium: medium.clone(), ..run(&photographs, config.clone()) };
        let mut whole = Trainer::new(Arc::clone(&gpu), new()).unwrap();
        whole.advance(25).unwrap();
        let state = whole.checkpoint().unwrap();
        let then = whole.gaussians().unwrap();
        whole.advance(ITERATIONS).unwrap();
        let whole = whole.gaussians().unwrap();
        let hand_over = |keeps: &dyn Fn([f32; 3]) -> bool, context: Gaussians| {
            let surroundings = Some(Surroundings { keeps, context });
            Trainer::hand_over(Arc::clone(&gpu), new(), &state, None, surroundings).unwrap()
        };

        // All Gaussians stay without a context: the run continues to the bit.
        let mut same = hand_over(&|_| true, Gaussians::empty(1)).unwrap();
        assert_eq!(same.progress().iteration, 25);
        same.advance(ITERATIONS).unwrap();
        assert_same_model(what, &whole, &same.gaussians().unwrap());

        // Half of them stay. The others become context and no longer change.
        let stays = |mean: [f32; 3]| mean[0] > 0.0;
        let (kept, gone) = then.split_by(stays);
        assert!(kept.len() > 10 && gone.len() > 10, "{} and {}", kept.len(), gone.len());
        let mut half = hand_over(&stays, gone.clone()).unwrap();
        assert_same_model(what, &kept, &half.gaussians().unwrap());
        half.advance(5).unwrap();
        let checkpoint = half.checkpoint().unwrap();
        half.advance(ITERATIONS).unwrap();
        let half = half.gaussians().unwrap();
        let (mut both, _) = half.split_by(|_| true);
        (0..gone.len()).for_each(|row| both.push_from(&gone, row));
        if medium.is_none() {
            let [before, after] = [&then, &both].map(|model| mean_psnr(&gpu, model, &photographs));
            assert!(after > before, "{what}: {after} dB beside the context, {before} before");
        }

        // An interrupted run has the same bytes; a run without the context has different ones.
        let mut resumed = hand_over(&stays, gone.clone()).unwrap();
        resumed.go_to(&checkpoint).unwrap();
        assert_eq!(resumed.progress().iteration, 30);
        resumed.advance(ITERATIONS).unwrap();
        assert_same_model(what, &half, &resumed.gaussians().unwrap());
        let mut alone = hand_over(&stays, Gaussians::empty(1)).unwrap();
        let foreign = alone.go_to(&checkpoint);
        assert!(matches!(foreign, Err(CoreError::Checkpoint(_))), "a checkpoint with another context");
        alone.advance(ITERATIONS).unwrap();
        assert_ne!(alone.gaussians().unwrap().means, half.means, "{what}: the context has no effect");
        assert!(hand_over(&|_| false, gone).is_none(), "no Gaussian is left to train");
    }
}
