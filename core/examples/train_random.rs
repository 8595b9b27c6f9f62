//! Trains a few steps on more Gaussians than a binding holds. One view sees all of them, the other 2 %.
//!
//! `cargo run --release --example train_random -- [GAUSSIANS] [STEPS] [WIDTH HEIGHT]` (12 million, 6, 480
//! 270). The scene is that of `shared/random_scene.rs`; the photographs are grey. It prints the time of each
//! step and the memory on the device.

use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, GpuOptions, ListLimits};
use fathom_core::scene::PinholeCamera;
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::TrainView;
use fathom_twins::samples::grey;

#[path = "shared/cpu_time.rs"]
mod cpu_time;
#[path = "shared/random_scene.rs"]
mod random_scene;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<u32> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let or = |i: usize, default: u32| arguments.get(i).copied().unwrap_or(default);
    let (gaussians, steps, width, height) = (or(0, 12_000_000), or(1, 6), or(2, 480), or(3, 270));
    let (wide, pose) = random_scene::camera(width, height);
    // A seventh of the angle in both directions shows a fiftieth.
    let narrow = PinholeCamera { fx: 7.0 * wide.fx, fy: 7.0 * wide.fy, ..wide };
    let view = |name: &str, camera| TrainView { name: name.to_owned(), camera, pose, clear_range: 0.0 };
    let views = grey(vec![view("all", wide), view("a fiftieth", narrow)]);
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, ..Default::default() })?;
    let run = TrainRun {
        config: TrainConfig {
            iterations: steps,
            max_gaussians: gaussians,
            refine_steps: 0,
            sh_degree_at: [0.0; 3],
            resolution_at: [0.0; 2],
            ..TrainConfig::default()
        },
        extent: 3.0,
        views: Arc::new(views),
        focus: random_scene::model(gaussians),
        context: Gaussians::empty(3),
        surfaces: Gaussians::empty(3),
        medium: None,
        surface: None,
    };
    let limits = ListLimits::of(&gpu);
    println!("{}: lists of at most {} rows", gpu.adapter().name, limits.visible.min(limits.intersections));
    let begin = Instant::now();
    let mut trainer = Trainer::new(Arc::clone(&gpu), run)?;
    println!("{gaussians} Gaussians of SH 3 on the device after {:.1} s", begin.elapsed().as_secs_f64());
    for step in 0..steps {
        let (wall, cpu) = (Instant::now(), cpu_time::cpu_seconds());
        let progress = trainer.advance(1)?;
        println!(
            "step {step}: loss {:.5}, {:.1} s, {:.1} CPU s; at most {} bands",
            progress.loss,
            wall.elapsed().as_secs_f64(),
            cpu_time::cpu_seconds() - cpu,
            trainer.most_bands()
        );
    }
    let memory = trainer.memory();
    println!(
        "{:.0} bytes a Gaussian; MiB: Gaussians {}, by visible {}, by intersection {}, bands {}",
        memory.gaussians as f64 / f64::from(gaussians),
        memory.gaussians >> 20,
        memory.per_visible >> 20,
        memory.per_intersection >> 20,
        memory.bands >> 20
    );
    Ok(())
}
