//! CPU seconds of each kernel on a CPU adapter, which unlike wall time do not depend on what else the machine does.
//!
//! `cargo run --example bench_random -- [GAUSSIANS] [WIDTH HEIGHT]`: the scene of
//! `shared/random_scene.rs`.

use std::error::Error;
use std::sync::Arc;

use fathom_core::gpu::{
    Blocks, Frame, FrameUniform, Gpu, GpuOptions, Recorder, Size, counter, spatial_order,
};

#[path = "shared/random_scene.rs"]
mod random_scene;
use random_scene::cpu_seconds;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<u32> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let n = arguments.first().copied().unwrap_or(30_000);
    let (width, height) =
        (arguments.get(1).copied().unwrap_or(480), arguments.get(2).copied().unwrap_or(270));
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, ..Default::default() })?;
    let model = random_scene::model(n);
    let mut blocks = Blocks::new(&gpu, 3)?;
    blocks.push_frozen(&gpu, &model, &spatial_order(&model))?;
    let mut frame = Frame::new(&gpu, n, n, 24 * n)?;
    let (camera, pose) = random_scene::camera(width, height);
    let view = FrameUniform { sh_degree: 3, ..FrameUniform::of_camera(&camera, &pose, gpu.tile()) };
    frame.prepare_targets(&gpu, view.size)?;
    let mut recorder = Recorder::new(&gpu);
    frame.record_forward(&gpu, &mut recorder, &blocks, &view)?;
    recorder.submit();
    if let Some(overflow) = frame.overflow(&gpu)? {
        return Err(format!("{overflow:?}").into());
    }
    let counters: Vec<u32> = gpu.read(&frame.counters, 0, 9)?;
    let intersections = counters[counter::INTERSECTIONS as usize];
    println!(
        "{} visible, {intersections} intersections, {width}x{height}",
        counters[counter::VISIBLE as usize]
    );
    let evaluations = f64::from(intersections * gpu.tile() * gpu.tile());
    let pixels = u64::from(width) * u64::from(height);
    let v_image = gpu.buffer("v_image", pixels * 16)?;
    gpu.write(&v_image, 0, &vec![0.3_f32; pixels as usize * 4]);
    let v_range = gpu.buffer("v_range", pixels * 4)?;
    let slot_gradients = gpu.buffer("slot_gradients", u64::from(intersections) * 48)?;
    let targets = frame.targets()?;
    let tiles = view.tile_count();
    let common = [
        ("frame", &frame.uniform),
        ("projected", &frame.projected),
        ("slots", frame.sorted_slots(tiles)),
        ("visible_from_slot", &frame.visible_from_slot),
        ("ranges", &targets.ranges),
        ("tile_ends", &targets.tile_ends),
    ];
    let forward = [("image", &targets.image), ("range_image", &targets.range_image)];
    let backward = [("v_image", &v_image), ("v_range_image", &v_range), ("slot_gradients", &slot_gradients)];
    let forward: Vec<_> = common.iter().chain(&forward).copied().collect();
    let backward: Vec<_> = forward.iter().chain(&backward).copied().collect();
    for (stage, buffers) in [("rasterize_forward", &forward), ("rasterize_backward", &backward)] {
        let mut cost = 0.0;
        for repeat in 0..6 {
            let before = cpu_seconds();
            let mut recorder = Recorder::new(&gpu);
            recorder.dispatch(stage, Size::Groups(tiles), buffers)?;
            recorder.submit();
            gpu.wait()?;
            if repeat > 0 {
                cost += (cpu_seconds() - before) / 5.0;
            }
        }
        println!(
            "{stage:24} {:8.1} CPU ms  {:6.1} M evaluations a CPU second",
            cost * 1e3,
            evaluations / cost * 1e-6
        );
    }
    let mut recorder = Recorder::new(&gpu);
    let before = cpu_seconds();
    frame.record_forward(&gpu, &mut recorder, &blocks, &view)?;
    recorder.submit();
    gpu.wait()?;
    println!("whole forward            {:8.1} CPU ms", (cpu_seconds() - before) * 1e3);
    let image: Vec<u32> = gpu.read(&targets.image, 0, pixels as usize * 4)?;
    let gradients: Vec<u32> = gpu.read(&slot_gradients, 0, intersections as usize * 12)?;
    println!(
        "{} {}",
        blake3::hash(bytemuck::cast_slice(&image)),
        blake3::hash(bytemuck::cast_slice(&gradients))
    );
    drop(Arc::clone(&gpu));
    Ok(())
}
