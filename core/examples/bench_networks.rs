//! Measures the networks on this machine: `cargo run --release -p fathom-core --example bench_networks`.
//!
//! For WaterParamPredict at each width it prints the number of weights, and the milliseconds of a prediction
//! and of a training step at 64 x 96. Times are wall time (least and median) and CPU time, which is
//! comparable on a busy machine too.

#[path = "shared/cpu_time.rs"]
mod cpu_time;

use std::time::Instant;

use fathom_core::Result;
use fathom_core::nets::{DepthMap, RELEASE_PRIOR, WaterParamNet, WaterParamPredictor};

/// Columns and rows of the depth map.
const SIZE: (u32, u32) = (96, 64);
const REPEATS: usize = 20;

fn main() -> Result<()> {
    let (width, height) = SIZE;
    let values =
        (0..width * height).map(|i| 0.5 + (i / width) as f32 / height as f32 + 0.01 * (i % 7) as f32);
    let depth = DepthMap::new(width, height, values.collect())?;
    for channels in [8, 16, 32, 64] {
        let mut net = WaterParamNet::new(channels, RELEASE_PRIOR.to_raw(1.0), 1)?;
        // The first pass starts threads and touches memory, so it is not measured.
        net.learn(&depth, [0.1; 9], 1e-4, true)?;
        let predict = times(|| net.predict(&depth).map(drop))?;
        let step = times(|| net.learn(&depth, [0.1; 9], 1e-4, true).map(drop))?;
        println!("{channels} channels, {} weights: predict {predict}; step {step}", net.weights());
    }
    Ok(())
}

/// Least and median wall time and CPU time of `work`, as text.
fn times(mut work: impl FnMut() -> Result<()>) -> Result<String> {
    let cpu = cpu_time::cpu_seconds();
    let mut walls = Vec::with_capacity(REPEATS);
    for _ in 0..REPEATS {
        let start = Instant::now();
        work()?;
        walls.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let cpu = (cpu_time::cpu_seconds() - cpu) * 1e3 / REPEATS as f64;
    walls.sort_by(f64::total_cmp);
    Ok(format!("{:.1} ms least, {:.1} median, {cpu:.1} of CPU", walls[0], walls[REPEATS / 2]))
}
