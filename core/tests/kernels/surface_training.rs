//! Training of a scene that is seen through a water surface, on a small pool.

use std::sync::{Arc, OnceLock};

use fathom_core::CoreError;
use fathom_core::config::{DataConfig, SurfaceConfig, SurfaceJoin, SurfaceRefine, TrainConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, ListLimits, Rendered, Renderer, SurfaceRenderer};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::picture::{Photograph, prepare};
use fathom_core::scene::{Points, Pose, Purpose, learning_scale, load_scene};
use fathom_core::surface::SurfaceModel;
use fathom_core::synth::{PoolOptions, synthesise_pool};
use fathom_core::train::surface::{SurfaceTrainer, disks_at_points, surface_part, surface_run};
use fathom_core::train::{TrainRun, Trainer, initial_gaussians};
use fathom_core::views::{InMemory, PackedImage, TrainView};
use glam::DVec3;

use crate::device::{device, layouts};

const ITERATIONS: u32 = 700;

/// A pool: training views, held-out views with the region of water, points, and the scale of its scene.
struct Pool {
    train: InMemory,
    held_out: InMemory,
    regions: Vec<Vec<u8>>,
    /// The held-out views without water.
    dry: Vec<PackedImage>,
    points: Points,
    scene_views: Vec<u32>,
    extent: f32,
}

fn pool() -> &'static Pool {
    static POOL: OnceLock<Pool> = OnceLock::new();
    POOL.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let options =
            PoolOptions { views: 36, width: 56, height: 42, points_per_view: 60, ..PoolOptions::default() };
        synthesise_pool(folder.path(), &options, |_, _| ()).unwrap();
        let data = DataConfig::default();
        let scene = load_scene(folder.path(), Purpose::Train, &data).unwrap();
        let mut pool = Pool {
            train: InMemory { views: Vec::new(), images: Vec::new() },
            held_out: InMemory { views: Vec::new(), images: Vec::new() },
            regions: Vec::new(),
            dry: Vec::new(),
            points: scene.points.clone(),
            scene_views: Vec::new(),
            extent: learning_scale(scene.extent(), scene.viewing_distance()) as f32,
        };
        for (index, view) in (0_u32..).zip(&scene.views) {
            let camera = scene.camera(view.camera_id).unwrap();
            let bytes = std::fs::read(view.image.as_ref().unwrap()).unwrap();
            let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
            let (_, image) = prepare(&photograph, camera, data.mask_keep, data.max_resolution).unwrap();
            let camera = camera.pinhole().unwrap();
            let into = if index.is_multiple_of(8) { &mut pool.held_out } else { &mut pool.train };
            into.views.push(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 });
            into.images.push(Arc::new(image));
            if index.is_multiple_of(8) {
                let region = folder.path().join("truth/region").join(&view.name);
                pool.regions.push(image::open(region).unwrap().to_luma8().into_raw());
                let dry = image::open(folder.path().join("truth/dry").join(&view.name)).unwrap().to_rgb8();
                let pixels = dry.pixels().map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect();
                pool.dry.push(PackedImage { width: dry.width(), height: dry.height(), pixels });
            } else {
                pool.scene_views.push(index);
            }
        }
        pool
    })
}

fn config(iterations: u32) -> TrainConfig {
    TrainConfig {
        iterations,
        max_gaussians: 1500,
        sh_degree: 1,
        disks: true,
        resolution_at: [0.0; 2],
        refine_steps: 8,
        ..TrainConfig::default()
    }
}

fn plain(config: &TrainConfig) -> TrainRun {
    let pool = pool();
    TrainRun {
        config: config.clone(),
        extent: pool.extent,
        views: Arc::new(InMemory { views: pool.train.views.clone(), images: pool.train.images.clone() }),
        focus: initial_gaussians(&pool.points, &pool.train.views, config, None).unwrap(),
        context: Gaussians::empty(config.sh_degree),
        surfaces: Gaussians::empty(config.sh_degree),
        medium: None,
        surface: None,
    }
}

fn with_surface(config: &TrainConfig, settings: &SurfaceConfig) -> TrainRun {
    let pool = pool();
    let (focus, surface) =
        surface_run(&pool.points, &pool.train.views, &pool.scene_views, config, settings).unwrap();
    TrainRun { focus, surface: Some(surface), ..plain(config) }
}

/// The paper's masks and stages.
fn masked() -> SurfaceConfig {
    SurfaceConfig { join: SurfaceJoin::Masked, ..SurfaceConfig::default() }
}

/// Mean PSNR of the held-out views where they show water: against the photographs, or the same without water.
fn in_region(dry: bool, mut render: impl FnMut(&TrainView) -> Rendered) -> f64 {
    let pool = pool();
    let each = pool.held_out.views.iter().enumerate().map(|(index, view)| {
        let mut truth = if dry { pool.dry[index].clone() } else { (*pool.held_out.images[index]).clone() };
        for (pixel, region) in truth.pixels.iter_mut().zip(&pool.regions[index]) {
            *pixel = (*pixel & 0x00ff_ffff) | (u32::from(*region) << 24);
        }
        let rendered = render(view);
        psnr(&quantised(rendered.width, rendered.height, &rendered.rgb), &truth)
    });
    each.sum::<f64>() / pool.held_out.views.len() as f64
}

#[test]
fn a_surface_explains_what_lies_in_the_water() {
    let Some(gpu) = device() else { return };
    let config = config(ITERATIONS);
    let mut trainer =
        SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, &SurfaceConfig::default())).unwrap();
    trainer.advance(ITERATIONS).unwrap();
    let model = trainer.model().unwrap();
    let mut wet = SurfaceRenderer::new(Arc::clone(&gpu), &model).unwrap();
    let mut dry = SurfaceRenderer::dry(Arc::clone(&gpu), &model).unwrap();
    let with = [
        in_region(false, |view| wet.render(&view.camera, &view.pose).unwrap()),
        in_region(true, |view| dry.render(&view.camera, &view.pose, [0.0; 3]).unwrap()),
    ];

    let mut control = Trainer::new(Arc::clone(&gpu), plain(&config)).unwrap();
    control.advance(ITERATIONS).unwrap();
    let model = control.gaussians().unwrap();
    let mut renderer = Renderer::new(Arc::clone(&gpu), &model).unwrap().drawn(config.drawing()).unwrap();
    let without = [false, true]
        .map(|dry| in_region(dry, |view| renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap()));
    println!("in the region of water, wet and dry: {with:.2?} dB with the surface, {without:.2?} dB without");
    assert!(with[0] > without[0], "wet: {with:.2?} dB with the surface, {without:.2?} dB without");
    assert!(with[1] > without[1] + 1.0, "dry: {with:.2?} dB with the surface, {without:.2?} dB without");
}

/// The bytes of everything that a run has trained.
fn bytes_of(trainer: &mut SurfaceTrainer) -> Vec<u8> {
    fathom_core::ply::surface_to_bytes(&trainer.model().unwrap(), &[]).unwrap()
}

#[test]
fn a_run_with_a_surface_resumes_to_the_byte_in_every_phase() {
    // Before the surface appears (8), when it does, between two makings of pseudo-masks, at a reset, after
    // the last, and at the end.
    let stops: &[u32] = &[5, 8, 9, 15, 20, 28, 32];
    // On the first layout in every phase; the others differ in kernels, not in what is kept.
    let mut cases: Vec<(Arc<Gpu>, SurfaceConfig, &[u32])> =
        layouts().into_iter().map(|gpu| (gpu, masked(), &stops[4..5])).collect();
    let Some(first) = cases.first_mut() else { return };
    first.2 = stops;
    let over = (Arc::clone(&first.0), SurfaceConfig::default(), &stops[..1]);
    cases.push(over);
    for (gpu, settings, stops) in cases {
        let config = TrainConfig { max_gaussians: 400, ..config(32) };
        let settings = SurfaceConfig { refine: SurfaceRefine::Tilt, ..settings };
        let new = || SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, &settings)).unwrap();
        let mut whole = new();
        whole.advance(32).unwrap();
        let expected = bytes_of(&mut whole);
        for &stop in stops {
            let mut first = new();
            first.advance(stop).unwrap();
            let checkpoint = first.checkpoint().unwrap();
            let mut second =
                SurfaceTrainer::resume(Arc::clone(&gpu), with_surface(&config, &settings), &checkpoint)
                    .unwrap();
            assert_eq!(second.progress().iteration, stop);
            second.advance(32).unwrap();
            assert!(bytes_of(&mut second) == expected, "resumed at {stop}: another result");
        }
    }
}

#[test]
fn a_run_with_a_surface_does_not_depend_on_its_lists() {
    let Some(gpu) = device() else { return };
    let (config, settings) = (config(32), SurfaceConfig::default());
    let new = || SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, &settings)).unwrap();
    let mut roomy = new();
    roomy.advance(32).unwrap();
    let expected = bytes_of(&mut roomy);
    let mut short = new();
    short.set_list_capacities(64, 256).unwrap();
    short.advance(32).unwrap();
    assert!(bytes_of(&mut short) == expected, "lists that grow change the result");
    let mut banded = new();
    // Large tiles have fewer intersections.
    let intersections = if gpu.layout().tile > 8 { 1000 } else { 2500 };
    banded.set_list_limits(ListLimits { visible: 1500, intersections }).unwrap();
    banded.advance(32).unwrap();
    assert!(banded.most_bands() > 1, "the limits force no bands");
    assert!(bytes_of(&mut banded) == expected, "bands change the result");
}

#[test]
fn a_part_of_a_scene_is_trained_beside_the_rest_of_it() {
    let Some(gpu) = device() else { return };
    let config = config(24);
    let mut whole =
        SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, &SurfaceConfig::default())).unwrap();
    whole.advance(24).unwrap();
    let held_out = &pool().held_out;
    let measured = whole.measure(held_out, || true).unwrap().unwrap().psnr_db;
    let model = whole.model().unwrap();
    let (mut part, mut rest) = model.split_by(|mean| mean[0] < 0.0);
    // Nothing of the reflected set is the part's.
    let none = Gaussians::empty(1);
    let reflected = std::mem::replace(&mut part.reflected, none.clone());
    let (straight, refracted, record) = (none.clone(), none, model.record.clone());
    rest.append(&SurfaceModel { straight, masks: Vec::new(), reflected, refracted, record });
    assert_eq!(part.len() + rest.len(), model.len());
    let cap = TrainConfig { max_gaussians: part.len() as u32 + 1, refine_steps: 0, ..config.clone() };
    let nothing = || [Gaussians::empty(1), Gaussians::empty(1)];
    let ([focus, context], surface) =
        surface_part(part.clone(), rest.clone(), nothing(), &cap, &SurfaceConfig::default());
    assert_eq!((surface.reflected.len(), focus.len()), (1, part.straight.len()), "a set must not be empty");
    let run = TrainRun { focus, context, surface: Some(surface), ..plain(&cap) };
    let mut trainer = SurfaceTrainer::new(Arc::clone(&gpu), run).unwrap();
    let beside = trainer.measure(held_out, || true).unwrap().unwrap().psnr_db;
    assert!((beside - measured).abs() < 1e-3, "{beside} dB at the start, {measured} dB as a whole");
    trainer.advance(24).unwrap();
    let after = trainer.measure(held_out, || true).unwrap().unwrap().psnr_db;
    assert!(after > beside + 0.2, "{after} dB after, {beside} dB before");
    let trained = trainer.model().unwrap();
    assert_eq!(trained.straight.len(), part.straight.len());
    assert_eq!(trained.record, model.record, "the surface moved");
}

#[test]
fn disks_at_points_lie_where_light_comes_from() {
    let (pool, config) = (pool(), config(1));
    let (_, surface) =
        surface_run(&pool.points, &pool.train.views, &pool.scene_views, &config, &SurfaceConfig::default())
            .unwrap();
    let plane = surface.record.surface();
    let at = |views: &[TrainView]| {
        disks_at_points(&pool.points, views, &pool.scene_views[..views.len()], &config, &surface.record)
            .unwrap()
    };
    let heights = |model: &Gaussians| -> Vec<f64> {
        model.means.iter().map(|mean| plane.height(DVec3::from(mean.map(f64::from)))).collect()
    };
    // A quarter of the views sorts most points as all of them do.
    let views = &pool.train.views;
    for some in [&views[..], &views[..views.len() / 4]] {
        let [straight, refracted] = at(some);
        assert!(straight.len() > 100 && refracted.len() > 100, "{} and {}", straight.len(), refracted.len());
        let below = heights(&refracted).iter().filter(|height| **height < 0.01).count();
        assert!(below * 100 >= refracted.len() * 95, "{below} of {} are in the water", refracted.len());
        assert!(heights(&straight).iter().all(|height| *height > 0.0), "a straight disk is in the water");
    }
    let upwards = |view: &TrainView| {
        let eye = view.pose.centre();
        let pose = Pose::looking_at(eye, eye + plane.normal, plane.normal.any_orthonormal_vector());
        TrainView { pose, ..view.clone() }
    };
    let [straight, refracted] = at(&views[..3].iter().map(upwards).collect::<Vec<_>>());
    assert!(straight.len() > 100 && refracted.is_empty(), "no camera sees water");
}

#[test]
fn damaged_and_foreign_checkpoints_change_nothing() {
    let Some(gpu) = device() else { return };
    let (config, settings) = (config(24), SurfaceConfig::default());
    let new = |settings: &SurfaceConfig| {
        SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, settings)).unwrap()
    };
    let mut trainer = new(&settings);
    trainer.advance(10).unwrap();
    let good = trainer.checkpoint().unwrap();
    let other = SurfaceConfig { mask_weight: 0.1, ..settings.clone() };
    let foreign = new(&other).checkpoint().unwrap();
    let mut damaged = good.clone();
    damaged[good.len() / 2] ^= 1;
    for (bytes, says) in [
        (&good[..good.len() - 1], "digest does not match"),
        (&damaged[..], "digest does not match"),
        (&foreign[..], "belongs to another run"),
        (&[][..], "torn"),
    ] {
        let error = trainer.go_to(bytes).unwrap_err();
        assert!(matches!(error, CoreError::Checkpoint(_)) && error.to_string().contains(says), "{error}");
    }
    assert_eq!(trainer.progress().iteration, 10);
    assert!(trainer.checkpoint().unwrap() == good, "a refused checkpoint changed the run");
}

#[test]
fn pictures_with_another_liquid_differ_in_the_water_only() {
    let Some(gpu) = device() else { return };
    let config = config(24);
    let settings = SurfaceConfig { from: Some(0.1), ..masked() };
    let mut trainer = SurfaceTrainer::new(Arc::clone(&gpu), with_surface(&config, &settings)).unwrap();
    trainer.advance(24).unwrap();
    let mut model = trainer.model().unwrap();
    // Everything is above water, so no pixel has rays at the surface.
    model.masks.iter_mut().for_each(|mask| *mask = 30.0);
    model.straight.opacity_logits.iter_mut().for_each(|opacity| *opacity = 8.0);
    let view = &pool().held_out.views[0];
    let picture = |model: &SurfaceModel, ior: f64| {
        let mut renderer = SurfaceRenderer::new(Arc::clone(&gpu), model).unwrap();
        renderer.set_ior(ior).unwrap();
        renderer.render(&view.camera, &view.pose).unwrap().rgb
    };
    let furthest = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    // Where a single opaque disk lies, a hundredth is still seen through it.
    let dry = furthest(&picture(&model, 1.46), &picture(&model, 1.333));
    assert!(dry < 0.02, "{dry} apart, though nothing is seen of the surface");
    model.masks.iter_mut().for_each(|mask| *mask = -30.0);
    let wet = furthest(&picture(&model, 1.46), &picture(&model, 1.333));
    assert!(wet > 0.1, "{wet} apart");
    let mut renderer = SurfaceRenderer::new(Arc::clone(&gpu), &model).unwrap();
    let error = renderer.set_ior(0.9).unwrap_err().to_string();
    assert!(error.contains("above that of air") && error.contains("0.9"), "{error}");
}

#[test]
fn a_surface_above_a_camera_is_refused() {
    let pool = pool();
    let config = config(10);
    let highest = pool.train.views.iter().map(|view| -view.pose.centre().y).fold(f64::MIN, f64::max);
    let settings = SurfaceConfig {
        normal: Some([0.0, -1.0, 0.0]),
        offset: Some(highest + 0.5),
        ..SurfaceConfig::default()
    };
    let error = surface_run(&pool.points, &pool.train.views, &pool.scene_views, &config, &settings);
    let error = error.unwrap_err().to_string();
    assert!(error.contains("camera"), "{error}");
}
