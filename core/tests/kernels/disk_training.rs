//! Training of disks as a whole, on the tiny scene of `trainer`.

use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, ListLimits, Renderer};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::InMemory;

use crate::device::{device, layouts};
use crate::trainer::{config, photographs, run, same_however_it_runs, start};

fn disks(iterations: u32) -> TrainConfig {
    TrainConfig { disks: true, ..config(iterations) }
}

fn run_of_disks(photographs: &InMemory, iterations: u32) -> TrainRun {
    run(photographs, disks(iterations))
}

fn mean_psnr(gpu: &Arc<Gpu>, model: &Gaussians, photographs: &InMemory, config: &TrainConfig) -> f64 {
    let mut renderer = Renderer::new(Arc::clone(gpu), model).unwrap().drawn(config.drawing()).unwrap();
    let each = photographs.views.iter().zip(&photographs.images).map(|(view, image)| {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        psnr(&quantised(image.width, image.height, &rendered.rgb), image)
    });
    each.sum::<f64>() / photographs.views.len() as f64
}

#[test]
fn training_of_disks_raises_the_psnr_of_disks() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let config = disks(240);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run_of_disks(&photographs, 240)).unwrap();
    let before = mean_psnr(&gpu, &start(), &photographs, &config);
    let progress = trainer.advance(240).unwrap();
    assert_eq!(progress.gaussians, 100);
    let model = trainer.gaussians().unwrap();
    let after = mean_psnr(&gpu, &model, &photographs, &config);
    println!("disks: {before:.2} dB before, {after:.2} dB after");
    assert!(after > before + 6.0, "PSNR {before:.2} dB at the start, {after:.2} dB at the end");
    // As thin as the file says, so that other programs show them too.
    for [u, v, thin] in &model.log_scales {
        assert!((thin - (u.min(*v) + 0.01_f32.ln())).abs() < 1e-5);
    }
    let as_solids = mean_psnr(&gpu, &model, &photographs, &TrainConfig { disks: false, ..config });
    assert!(as_solids > before, "as 3D Gaussians: {as_solids:.2} dB");
    assert!(as_solids < after, "disks must render best as disks: {as_solids:.2} and {after:.2} dB");
}

#[test]
fn a_run_of_disks_has_one_result_however_it_runs() {
    for gpu in layouts() {
        let photographs = photographs(&gpu, 64, 48);
        let new = || run_of_disks(&photographs, 24);
        // A tile may see every disk that reaches behind the camera: only intersections force bands.
        let limits = ListLimits { visible: 100, intersections: 200 };
        same_however_it_runs(&gpu, "disks", new, [13], limits, |_| ());
    }
}

/// Mean angle, in degrees, between the blended normals of a model and those of its expected range, over
/// pixels that it covers.
fn disagreement(gpu: &Arc<Gpu>, model: &Gaussians, photographs: &InMemory) -> f64 {
    use fathom_twins::{DiskRaster, Raster, normal_consistency, pinhole_rays};
    let config = disks(1);
    let mut renderer = Renderer::new(Arc::clone(gpu), model).unwrap().drawn(config.drawing()).unwrap();
    let (mut sum, mut count) = (0.0, 0.0);
    for view in &photographs.views {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        let normals = renderer.normals(model, &view.camera, &view.pose).unwrap();
        let raster = Raster {
            width: rendered.width,
            height: rendered.height,
            alpha: rendered.alpha.iter().map(|&a| a.into()).collect(),
            range: rendered.range.iter().map(|&r| r.into()).collect(),
            ..Raster::default()
        };
        let normal: Vec<[f64; 3]> = normals.iter().map(|n| n.map(f64::from)).collect();
        let rays = pinhole_rays(&view.camera);
        let found = normal_consistency(
            &DiskRaster { raster, normal: normal.clone(), ..DiskRaster::default() },
            &rays,
            1.0,
            0.8,
        );
        for (surface, normal) in found.v_normal.iter().zip(&normal) {
            let cosine: f64 = -surface.iter().zip(normal).map(|(a, b)| a * b).sum::<f64>();
            if *surface != [0.0; 3] && *normal != [0.0; 3] {
                sum += cosine.clamp(-1.0, 1.0).acos().to_degrees();
                count += 1.0;
            }
        }
    }
    assert!(count > 1000.0, "{count} pixels have a surface");
    sum / count
}

#[test]
fn normal_consistency_brings_normals_and_surface_together() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let with_weight = |normal_consistency: f32| {
        let config = TrainConfig { normal_consistency, ..disks(240) };
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
        trainer.advance(240).unwrap();
        disagreement(&gpu, &trainer.gaussians().unwrap(), &photographs)
    };
    let [without, with] = [0.0, 0.5].map(with_weight);
    println!("normals and surface: {without:.1} degrees apart without, {with:.1} with consistency");
    assert!(with < 0.8 * without, "{without:.1} degrees apart without, {with:.1} with consistency");
}
