//! The trainer as a whole, on a tiny scene made by rendering known Gaussians.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use fathom_core::CoreError;
use fathom_core::config::{ClassicConfig, Moments, Strategy, TrainConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, ListLimits, Renderer};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::Pose;
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::{InMemory, PackedImage, TrainView, ViewSource};
use fathom_twins::samples::{off_centre_view, random};
use glam::DVec3;

use crate::device::{assert_same_bits, device, layouts};

/// The photographed model: few large splats.
pub fn truth() -> Gaussians {
    let mut model = random(91, 60, 0);
    model.log_scales.iter_mut().for_each(|scales| *scales = scales.map(|s| s.max(-2.8)));
    model
}

/// Six photographs from different directions, of `width` x `height`.
pub fn photographs(gpu: &Arc<Gpu>, width: u32, height: u32) -> InMemory {
    photographs_of(gpu, &truth(), width, height)
}

/// Six photographs of a model.
pub fn photographs_of(gpu: &Arc<Gpu>, model: &Gaussians, width: u32, height: u32) -> InMemory {
    let turns: Vec<f64> = (0..6).map(|i| f64::from(i) * 0.35 - 0.9).collect();
    photographs_from(gpu, model, width, height, &turns)
}

/// Photographs of a model, each from a direction given by an angle about the vertical, radians.
pub fn photographs_from(
    gpu: &Arc<Gpu>,
    model: &Gaussians,
    width: u32,
    height: u32,
    turns: &[f64],
) -> InMemory {
    let mut renderer = Renderer::new(Arc::clone(gpu), model).unwrap();
    let (mut views, mut images) = (Vec::new(), Vec::new());
    for (i, turn) in turns.iter().enumerate() {
        let (camera, _) = off_centre_view(width, height, 3.0);
        let eye = DVec3::new(3.2 * turn.sin(), 0.3 * turn, -3.2 * turn.cos());
        let pose = Pose::looking_at(eye, DVec3::ZERO, DVec3::Y);
        let rendered = renderer.render(&camera, &pose, [0.0; 3]).unwrap();
        images.push(Arc::new(quantised(width, height, &rendered.rgb)));
        views.push(TrainView { name: format!("{i}.png"), camera, pose, clear_range: 0.0 });
    }
    InMemory { views, images }
}

/// The start of training: the true model moved, faded and grey.
pub fn start() -> Gaussians {
    let mut model = truth();
    for (i, mean) in model.means.iter_mut().enumerate() {
        mean.iter_mut()
            .zip(0..)
            .for_each(|(v, k)| *v += 0.1 * (uniform_at(92, Stream::Test, i as u32, k) - 0.5));
    }
    model.opacity_logits.fill(0.0);
    model.log_scales.iter_mut().for_each(|scales| *scales = [-2.2; 3]);
    grey(&model)
}

/// The same without rotations and colours, at SH 1.
pub fn grey(model: &Gaussians) -> Gaussians {
    let mut full = Gaussians::empty(1);
    for i in 0..model.len() {
        full.means.push(model.means[i]);
        full.quats.push([1.0, 0.0, 0.0, 0.0]);
        full.log_scales.push(model.log_scales[i]);
        full.opacity_logits.push(model.opacity_logits[i]);
        full.sh_coeffs.extend([[0.0; 3]; 4]);
    }
    full
}

pub fn config(iterations: u32) -> TrainConfig {
    TrainConfig {
        iterations,
        max_gaussians: 100,
        sh_degree: 1,
        refine_steps: 5,
        means_lr: 1e-3,
        means_lr_end: 1e-4,
        sh_dc_lr: 2e-2,
        // The default suits splats of a few pixels; these cover a quarter of a picture.
        scales_lr: 1e-2,
        mean_noise: 5e3,
        ..TrainConfig::default()
    }
}

/// Classic density control that adds and removes Gaussians in such short runs. In 40 iterations it densifies
/// at 7, 14, 21 and 28 and resets at 10, 20 and 30.
fn classic(iterations: u32) -> TrainConfig {
    TrainConfig {
        strategy: Strategy::Classic,
        classic: ClassicConfig {
            // A quarter is cloned or split. Gaussians whose opacity rises after a reset stay; the others are
            // removed.
            gradient: 1.5e-2,
            prune_opacity: 0.0102,
            reset_every: 0.25,
            until: 0.85,
            ..ClassicConfig::default()
        },
        ..config(iterations)
    }
}

pub fn run(photographs: &InMemory, config: TrainConfig) -> TrainRun {
    TrainRun {
        config,
        extent: 3.0,
        views: Arc::new(photographs.clone()),
        focus: start(),
        context: Gaussians::empty(1),
        surfaces: Gaussians::empty(1),
        medium: None,
        surface: None,
    }
}

/// Runs `new` to its end, then repeats it: interrupted at each of `interruptions` and resumed in another
/// trainer, with lists that must grow, and in bands of tiles. `limits` must be small enough to require bands.
/// Every run must give the same model and the same result of `learnt`. Returns both.
pub fn same_however_it_runs<T: PartialEq>(
    gpu: &Arc<Gpu>,
    what: &str,
    new: impl Fn() -> TrainRun,
    interruptions: impl IntoIterator<Item = u32>,
    limits: ListLimits,
    learnt: impl Fn(&mut Trainer) -> T,
) -> (Gaussians, T) {
    let iterations = new().config.iterations;
    let start = || Trainer::new(Arc::clone(gpu), new()).unwrap();
    let finish = |mut trainer: Trainer| {
        trainer.advance(iterations).unwrap();
        (trainer.gaussians().unwrap(), learnt(&mut trainer), trainer.most_bands())
    };
    let (model, expected, _) = finish(start());
    assert!(model.means.iter().flatten().all(|value| value.is_finite()), "{what}");
    let check = |how: &str, trainer: Trainer, bands: bool| {
        let what = format!("{what}, {how}");
        let (other_model, other, most_bands) = finish(trainer);
        assert_eq!(most_bands > 1, bands, "{what}: bands");
        assert_same_model(&what, &model, &other_model);
        assert!(other == expected, "{what}: the result of `learnt`");
    };
    check("again", start(), false);
    for at in interruptions {
        let mut first = start();
        first.advance(at).unwrap();
        let checkpoint = first.checkpoint().unwrap();
        assert!(first.checkpoint().unwrap() == checkpoint, "{what}: a checkpoint at {at} changed the state");
        let mut second = Trainer::resume(Arc::clone(gpu), new(), &checkpoint).unwrap();
        assert!(second.checkpoint().unwrap() == checkpoint, "{what}: resuming at {at} gave another state");
        check(&format!("resumed at {at}"), second, false);
        check(&format!("after a checkpoint at {at}"), first, false);
    }
    let mut short = start();
    short.set_list_capacities(20, 300).unwrap();
    check("short lists", short, false);
    let mut banded = start();
    banded.set_list_limits(limits).unwrap();
    check("bands", banded, true);
    (model, expected)
}

/// Lists so short that a view of [`photographs`] needs several bands, and long enough for a tile.
pub fn banded(gpu: &Gpu) -> ListLimits {
    ListLimits { visible: if gpu.layout().tile > 8 { 90 } else { 70 }, intersections: 400 }
}

#[track_caller]
pub fn assert_same_model(what: &str, left: &Gaussians, right: &Gaussians) {
    assert_eq!(left.len(), right.len(), "{what}: Gaussians");
    assert_same_bits(&format!("{what}: means"), &left.means, &right.means);
    assert_same_bits(&format!("{what}: quaternions"), &left.quats, &right.quats);
    assert_same_bits(&format!("{what}: scales"), &left.log_scales, &right.log_scales);
    assert_same_bits(&format!("{what}: opacities"), &left.opacity_logits, &right.opacity_logits);
    assert_same_bits(&format!("{what}: coefficients"), &left.sh_coeffs, &right.sh_coeffs);
}

pub fn mean_psnr(gpu: &Arc<Gpu>, model: &Gaussians, photographs: &InMemory) -> f64 {
    mean_psnr_with(gpu, model, photographs, false)
}

fn mean_psnr_with(gpu: &Arc<Gpu>, model: &Gaussians, photographs: &InMemory, mip_filter: bool) -> f64 {
    let mut renderer = Renderer::new(Arc::clone(gpu), model).unwrap().with_mip_filter(mip_filter);
    let each = photographs.views.iter().zip(&photographs.images).map(|(view, image)| {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        psnr(&quantised(image.width, image.height, &rendered.rgb), image)
    });
    each.sum::<f64>() / photographs.views.len() as f64
}

#[test]
fn training_lowers_the_loss_and_raises_the_psnr() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config(240))).unwrap();
    let before = mean_psnr(&gpu, &start(), &photographs);
    let first = trainer.advance(6).unwrap();
    let mut most = first.gaussians;
    while trainer.progress().iteration < 240 {
        most = most.max(trainer.advance(12).unwrap().gaussians);
    }
    let last = trainer.progress();
    let after = mean_psnr(&gpu, &trainer.gaussians().unwrap(), &photographs);
    assert!(
        last.loss < 0.4 * first.loss,
        "loss {} after the first epoch, {} at the end",
        first.loss,
        last.loss
    );
    assert!(after > before + 8.0, "PSNR {before:.2} dB at the start, {after:.2} dB at the end");
    // The cap is reached and never exceeded.
    assert_eq!((most, last.gaussians), (100, 100));
    assert_eq!(trainer.advance(10).unwrap(), last, "a finished run must do nothing");
}

#[test]
fn classic_density_control_lowers_the_loss_and_keeps_the_cap() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let config = TrainConfig {
        classic: ClassicConfig { until: 0.5, prune_opacity: 0.025, ..classic(240).classic },
        max_gaussians: 80,
        ..classic(240)
    };
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
    let before = mean_psnr(&gpu, &start(), &photographs);
    let first = trainer.advance(6).unwrap();
    let mut counts = vec![first.gaussians];
    while trainer.progress().iteration < 240 {
        counts.push(trainer.advance(6).unwrap().gaussians);
    }
    let last = trainer.progress();
    let after = mean_psnr(&gpu, &trainer.gaussians().unwrap(), &photographs);
    assert!(
        last.loss < 0.5 * first.loss,
        "loss {} after the first epoch, {} at the end",
        first.loss,
        last.loss
    );
    assert!(after > before + 6.0, "PSNR {before:.2} dB at the start, {after:.2} dB at the end");
    assert_eq!(counts.iter().max(), Some(&80), "the cap must be reached and never exceeded: {counts:?}");
    assert!(!counts.is_sorted(), "some Gaussians must be removed: {counts:?}");
    assert!(
        counts[20..].iter().all(|count| count == &last.gaussians),
        "density control must stop at its end: {counts:?}"
    );
}

#[test]
fn a_model_trained_with_the_mip_filter_renders_best_with_it() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let config = TrainConfig { mip_filter: true, ..config(240) };
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
    trainer.advance(240).unwrap();
    let model = trainer.gaussians().unwrap();
    let before = mean_psnr(&gpu, &start(), &photographs);
    let [without, with] = [false, true].map(|on| mean_psnr_with(&gpu, &model, &photographs, on));
    assert!(
        with > before + 8.0 && with > without + 0.5,
        "{before:.2}, without {without:.2}, with {with:.2} dB"
    );
    // The returned model includes its smoothing. Its scales are at least sqrt(0.2) pixel at the nearest
    // depth.
    let camera = photographs.views[0].camera;
    let finest = 0.2_f64.sqrt() / camera.fx.max(camera.fy);
    let bare = trainer.blocks().download(&gpu).unwrap();
    let mut widened = 0;
    for (i, (scales, was)) in model.log_scales.iter().zip(&bare.log_scales).enumerate() {
        let least = scales.iter().copied().fold(f32::MAX, f32::min);
        let nearest =
            photographs.views.iter().map(|view| view.pose.transform(model.means[i].map(f64::from).into()).z);
        let depth = nearest.fold(f64::MAX, f64::min);
        // 0.8, because the Gaussian has moved since the widths were computed.
        let bound = 0.8 * finest * depth;
        assert!(f64::from(least).exp() > bound, "Gaussian {i}: {}, bound {bound}", least.exp());
        widened += usize::from(scales.iter().zip(was).all(|(a, b)| a > b));
    }
    assert!(widened > 90, "{widened} of {}", model.len());
}

#[test]
fn a_seed_decides_every_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    for config in [config(40), classic(40)] {
        let train = |seed: u32, steps: &[u32]| {
            let config = TrainConfig { seed, ..config.clone() };
            let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
            for &n in steps {
                trainer.advance(n).unwrap();
            }
            trainer.gaussians().unwrap()
        };
        let model = train(1, &[40]);
        assert_same_model("the same again", &model, &train(1, &[40]));
        assert_same_model("in small steps", &model, &train(1, &[1, 7, 3, 19, 10]));
        assert_ne!(model.means, train(2, &[40]).means, "another seed");
    }
}

#[test]
fn a_failed_photograph_read_loses_and_repeats_no_step() {
    struct Flaky {
        photographs: InMemory,
        loads: AtomicU32,
    }
    impl ViewSource for Flaky {
        fn views(&self) -> &[TrainView] {
            self.photographs.views()
        }

        fn load(&self, index: usize) -> fathom_core::Result<Arc<PackedImage>> {
            // Each of six views is read once, so this fails in the fifth iteration.
            if self.loads.fetch_add(1, Ordering::Relaxed) == 4 {
                return Err(CoreError::Scene("the disk was gone".into()));
            }
            self.photographs.load(index)
        }
    }
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let config = || TrainConfig { prefetch_threads: 0, ..config(40) };
    let mut plain = Trainer::new(Arc::clone(&gpu), run(&photographs, config())).unwrap();
    plain.advance(40).unwrap();
    let views = Arc::new(Flaky { photographs: photographs.clone(), loads: AtomicU32::new(0) });
    let mut flaky =
        Trainer::new(Arc::clone(&gpu), TrainRun { views, ..run(&photographs, config()) }).unwrap();
    let error = flaky.advance(40).unwrap_err();
    assert!(error.to_string().contains("the disk was gone"), "{error}");
    assert_eq!(flaky.progress().iteration, 4);
    assert_eq!(flaky.advance(40).unwrap().iteration, 40);
    assert_same_model("after a photograph", &plain.gaussians().unwrap(), &flaky.gaussians().unwrap());
}

#[test]
fn threads_that_read_ahead_change_no_byte() {
    let Some(gpu) = device() else { return };
    // 192 pixels: each photograph has two sizes.
    let photographs = photographs(&gpu, 192, 20);
    let train = |prefetch_threads: u32| {
        let config = TrainConfig { prefetch_threads, ..config(30) };
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
        trainer.advance(30).unwrap();
        trainer.gaussians().unwrap()
    };
    let waiting = train(0);
    for threads in [1, 2] {
        assert_same_model(&format!("{threads} threads"), &waiting, &train(threads));
    }
}

#[test]
fn a_resumed_run_gives_the_bytes_of_an_uninterrupted_one() {
    let Some(gpu) = device() else { return };
    // 192 pixels are enough to start at half size, so a resumed run must also find its level.
    let photographs = photographs(&gpu, 192, 20);
    for config in [config(40), classic(40), TrainConfig { mip_filter: true, ..classic(40) }] {
        let new = || Trainer::new(Arc::clone(&gpu), run(&photographs, config.clone())).unwrap();
        let mut whole = new();
        whole.advance(40).unwrap();
        let whole = whole.gaussians().unwrap();
        // 0: before the first step; 34: after the last density control; the others are between, before and at
        // density control (every 7) and resets (every 10).
        for at in [0, 1, 6, 7, 10, 13, 19, 20, 21, 34] {
            let mut first = new();
            first.advance(at).unwrap();
            let checkpoint = first.checkpoint().unwrap();
            assert_eq!(first.checkpoint().unwrap(), checkpoint, "a checkpoint must change nothing");
            drop(first);
            let mut second =
                Trainer::resume(Arc::clone(&gpu), run(&photographs, config.clone()), &checkpoint).unwrap();
            assert_eq!(second.progress().iteration, at);
            assert_eq!(second.checkpoint().unwrap(), checkpoint, "checkpoint of the run resumed at {at}");
            second.advance(40).unwrap();
            let what = format!("{:?}, resumed at {at}", config.strategy);
            assert_same_model(&what, &whole, &second.gaussians().unwrap());
        }
    }
}

#[test]
fn short_lists_grow_and_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    for config in [config(40), classic(40)] {
        let train = |capacities: Option<(u32, u32)>| {
            let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config.clone())).unwrap();
            if let Some((visible, intersections)) = capacities {
                trainer.set_list_capacities(visible, intersections).unwrap();
            }
            let loss = trainer.advance(40).unwrap().loss;
            (trainer.gaussians().unwrap(), loss, trainer.list_capacities())
        };
        let (ample, loss, _) = train(None);
        for capacities in [(1, 1), (20, 5000), (50, 150)] {
            let (model, short_loss, grown) = train(Some(capacities));
            assert!(grown.0 > capacities.0 || grown.1 > capacities.1, "{capacities:?} must be too short");
            assert_same_model(&format!("{:?}, lists of {capacities:?}", config.strategy), &ample, &model);
            assert_same_bits("loss", &[loss], &[short_loss]);
        }
    }
}

#[test]
fn bands_change_no_byte() {
    for gpu in layouts() {
        let photographs = photographs(&gpu, 64, 48);
        let context = grey(&truth());
        for moments in [Moments::Compact, Moments::F32] {
            let train = |limits: Option<ListLimits>| {
                let config = TrainConfig { moments, ..config(16) };
                let run = TrainRun { context: context.clone(), ..run(&photographs, config) };
                let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
                if let Some(limits) = limits {
                    trainer.set_list_limits(limits).unwrap();
                }
                let loss = trainer.advance(16).unwrap().loss;
                (trainer.gaussians().unwrap(), loss, trainer.most_bands(), trainer.list_capacities())
            };
            let (whole, loss, bands, _) = train(None);
            assert_eq!(bands, 1);
            // Too few entries of either kind, and of both.
            for (visible, intersections) in [(130, 100_000), (100_000, 400), (130, 400)] {
                let limits = ListLimits { visible, intersections };
                let (model, banded_loss, bands, capacities) = train(Some(limits));
                assert!(bands > 1, "{limits:?} must be too short");
                assert!(capacities.0 <= visible && capacities.1 <= intersections, "{capacities:?}");
                assert_same_model(&format!("{moments:?}, {bands} bands"), &whole, &model);
                assert_same_bits("loss", &[loss], &[banded_loss]);
            }
        }
    }
}

#[test]
fn a_tile_beyond_the_list_limit_is_an_error_with_advice() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 32, 24);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config(10))).unwrap();
    trainer.set_list_limits(ListLimits { visible: 3, intersections: 3 }).unwrap();
    let error = trainer.advance(10).unwrap_err();
    assert!(matches!(error, CoreError::BufferTooLarge { .. }), "{error}");
    assert!(error.to_string().contains("--max-gaussians"), "{error}");
}

#[test]
fn a_torn_or_foreign_checkpoint_is_refused() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 32, 24);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config(20))).unwrap();
    trainer.advance(5).unwrap();
    let whole = trainer.checkpoint().unwrap();
    let refused =
        |what: &str, run: TrainRun, bytes: &[u8]| match Trainer::resume(Arc::clone(&gpu), run, bytes) {
            Err(CoreError::Checkpoint(_)) => {}
            Err(other) => panic!("{what}: {other}"),
            Ok(_) => panic!("{what}: was accepted"),
        };
    let own = || run(&photographs, config(20));
    for length in [0, 7, 8, 60, 87, 88, whole.len() / 2, whole.len() - 1] {
        refused(&format!("cut to {length} bytes"), own(), &whole[..length]);
    }
    for at in [0, 9, 20, 45, 60, whole.len() / 2, whole.len() - 1] {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x10;
        refused(&format!("byte {at} damaged"), own(), &damaged);
    }
    refused("longer", own(), &[&whole[..], &[0]].concat());
    refused("another seed", run(&photographs, TrainConfig { seed: 9, ..config(20) }), &whole);
    refused("another length of run", run(&photographs, config(21)), &whole);
    let mut moved = own();
    moved.focus.means[3][0] += 1e-3;
    refused("another model", moved, &whole);
    let mut context = own();
    context.context.push_from(&start(), 0);
    refused("another context", context, &whole);
    // Checkpoints with a correct digest and wrong content. A refused checkpoint leaves the run unchanged.
    let sealed = |content: &[u8]| [content, blake3::hash(content).as_bytes()].concat();
    let content = &whole[..whole.len() - 32];
    let mut fewer = content.to_vec();
    fewer[52] -= 1;
    let mut more = content.to_vec();
    more[54] = 1;
    for (what, bytes) in [
        ("one Gaussian fewer", sealed(&fewer)),
        ("more than the cap", sealed(&more)),
        ("an array cut short", sealed(&content[..content.len() - 4])),
        ("too long", sealed(&[content, &[0; 4]].concat())),
    ] {
        refused(what, own(), &bytes);
        assert!(matches!(trainer.go_to(&bytes), Err(CoreError::Checkpoint(_))), "{what}");
        assert_same_bits(what, &whole, &trainer.checkpoint().unwrap());
    }
    // The interval of checkpoints and the number of reading threads do not belong to the run.
    let other = TrainConfig { checkpoint_seconds: 1, prefetch_threads: 2, ..config(20) };
    assert!(Trainer::resume(Arc::clone(&gpu), run(&photographs, other), &whole).is_ok());
}

#[test]
fn context_is_seen_but_never_changes() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let (focus, context) = start().split_by(|mean| mean[0] < 0.0);
    let with = TrainRun { focus: focus.clone(), context: context.clone(), ..run(&photographs, config(30)) };
    let without = TrainRun { focus: focus.clone(), ..run(&photographs, config(30)) };
    let mut trainer = Trainer::new(Arc::clone(&gpu), with).unwrap();
    let bits = |trainer: &Trainer| -> Vec<Vec<u32>> {
        let frozen = trainer.blocks().iter().filter(|block| block.training.is_none());
        frozen
            .flat_map(|block| [&block.transforms, &block.sh_coeffs])
            .map(|buffer| gpu.read(buffer, 0, buffer.size() as usize / 4).unwrap())
            .collect()
    };
    let before = bits(&trainer);
    assert_eq!(before.len(), 2);
    assert_eq!(before[0].len(), 12 * context.len());
    trainer.advance(30).unwrap();
    assert_eq!(before, bits(&trainer));
    // `focus` grew; only its Gaussians are returned.
    assert_eq!(trainer.gaussians().unwrap().len(), 100);
    let mut alone = Trainer::new(Arc::clone(&gpu), without).unwrap();
    alone.advance(30).unwrap();
    assert_ne!(
        alone.gaussians().unwrap().means,
        trainer.gaussians().unwrap().means,
        "the context must be visible"
    );
}

#[test]
fn masked_pixels_do_not_influence_training() {
    let Some(gpu) = device() else { return };
    let mut photographs = photographs(&gpu, 48, 36);
    let train = |photographs: &InMemory| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(photographs, config(24))).unwrap();
        trainer.advance(24).unwrap();
        trainer.gaussians().unwrap()
    };
    let unmasked = train(&photographs);
    let mut paint = |colour: u32| {
        for image in &mut photographs.images {
            for (i, pixel) in Arc::make_mut(image).pixels.iter_mut().enumerate() {
                if i % 48 < 20 {
                    *pixel = colour;
                }
            }
        }
        train(&photographs)
    };
    let (black, pink) = (paint(0), paint(0x00FF_20FF));
    assert_same_model("another colour under the mask", &black, &pink);
    assert_ne!(black.means, unmasked.means, "the mask must hide something");
}

#[test]
fn a_run_without_views_or_gaussians_is_refused() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 32, 24);
    let nothing = InMemory { views: Vec::new(), images: Vec::new() };
    let no_focus = TrainRun { focus: Gaussians::empty(1), ..run(&photographs, config(10)) };
    for (what, run) in [("no views", run(&nothing, config(10))), ("no Gaussians", no_focus)] {
        assert!(matches!(Trainer::new(Arc::clone(&gpu), run), Err(CoreError::Scene(_))), "{what}");
    }
}

#[test]
fn more_gaussians_than_the_cap_are_thinned_by_the_seed() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 32, 24);
    let counts = |seed| {
        let config = TrainConfig { seed, max_gaussians: 30, ..config(10) };
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
        let model = trainer.gaussians().unwrap();
        assert_eq!(trainer.advance(10).unwrap().gaussians, 30);
        model
    };
    assert_eq!(counts(1).len(), 30);
    assert_eq!(counts(1), counts(1));
    assert_ne!(counts(1), counts(2));
}
