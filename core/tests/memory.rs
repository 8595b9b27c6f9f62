//! The memory of a long run. It needs its own process, because resident memory includes all threads.
#![cfg(target_os = "linux")]

use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::device_for_test;
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::TrainView;
use fathom_twins::samples::{grey, off_centre_view, random};

#[path = "../../tests/support/memory.rs"]
mod resident;
use resident::resident_mib;

/// On lavapipe, a branch that depends only on a uniform costs a copy of its kernel at every dispatch (see
/// `veiled` in shaders/shared/frame.wgsl). The copies are never released: at least 0.3 MiB per iteration, 60
/// MiB over the 200 iterations measured here.
#[test]
fn memory_does_not_grow_with_the_iterations_of_a_run() {
    let Some(gpu) = device_for_test("the memory of a long run") else { return };
    let (camera, pose) = off_centre_view(64, 48, 3.0);
    let views = vec![TrainView { name: "grey".into(), camera, pose, clear_range: 0.0 }];
    // Memory is measured after a quarter of the run, when lists, caches and compiled kernels exist.
    let config = TrainConfig {
        iterations: 400,
        max_gaussians: 300,
        sh_degree_at: [0.0; 3],
        refine_steps: 0,
        // Exposure adds its kernels to every iteration.
        exposure: true,
        ..TrainConfig::default()
    };
    let run = TrainRun {
        config,
        extent: 3.0,
        views: Arc::new(grey(views)),
        focus: random(5, 300, 3),
        context: Gaussians::empty(3),
        surfaces: Gaussians::empty(3),
        medium: None,
        surface: None,
    };
    let mut trainer = Trainer::new(gpu, run).unwrap();
    trainer.advance(100).unwrap();
    let before = resident_mib();
    assert!(before > 0.0, "the system does not say how much memory this process has");
    trainer.advance(200).unwrap();
    let grown = resident_mib() - before;
    assert!(grown < 8.0, "{grown:.1} MiB more after 200 iterations");
}
