//! The picture and the gradients of one iteration over random Gaussians, to compare drivers.
//!
//! `cargo run --example first_iteration -- write FILE [GAUSSIANS WIDTH HEIGHT]` renders the scene of
//! `shared/random_scene.rs` and takes it backward with a constant gradient of the picture. It writes the
//! picture and the gradients of all parameters, as f32.
//!
//! `first_iteration compare FILE FILE` prints how far two such files are apart, and fails beyond
//! [`TOLERANCES`].
//!
//! Drivers round `exp` and divisions differently. A contribution near the threshold of 1/255 may then be
//! taken by one and skipped by the other, so single pixels may differ by much more than rounding.

use std::error::Error;
use std::fs;
use std::sync::Arc;

use fathom_core::config::Moments;
use fathom_core::gpu::{Blocks, FrameUniform, Gpu, GpuOptions, Recorder, StepUniform, sh_stride};
use fathom_core::train::{BackwardBuffers, record_backward};

#[path = "shared/grown_frame.rs"]
mod grown_frame;
#[path = "shared/random_scene.rs"]
mod random_scene;

use grown_frame::grown_frame;

type Fallible<T> = Result<T, Box<dyn Error>>;

/// Names of the parts of a file with their tolerances: the root mean square of the difference, relative to
/// that of the first file.
const TOLERANCES: [(&str, f64); 5] = [
    ("picture", 1e-5),
    ("gradient of means and opacities", 1e-4),
    ("gradient of rotations", 1e-4),
    ("gradient of scales", 1e-4),
    ("gradient of colours", 1e-4),
];

fn main() -> Fallible<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["write", file] => write(file, 3000, 160, 120),
        ["write", file, n, width, height] => write(file, n.parse()?, width.parse()?, height.parse()?),
        ["compare", one, other] => compare(one, other),
        _ => Err("usage: first_iteration write FILE [GAUSSIANS WIDTH HEIGHT] | compare FILE FILE".into()),
    }
}

fn write(file: &str, n: u32, width: u32, height: u32) -> Fallible<()> {
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, ..Default::default() })?;
    let parts = iteration(&gpu, n, width, height)?;
    let mut bytes = Vec::new();
    for part in &parts {
        bytes.extend((part.len() as u64).to_le_bytes());
        bytes.extend(part.iter().flat_map(|value| value.to_le_bytes()));
    }
    fs::write(file, bytes)?;
    println!("{} ({})", gpu.adapter().name, gpu.adapter().driver);
    Ok(())
}

/// The parts of a file, in the order of [`TOLERANCES`].
fn iteration(gpu: &Arc<Gpu>, n: u32, width: u32, height: u32) -> Fallible<[Vec<f32>; 5]> {
    let mut blocks = Blocks::new(gpu, 3)?;
    blocks.push_trainable(gpu, &random_scene::model(n), n, Moments::F32)?;
    let (camera, pose) = random_scene::camera(width, height);
    let view = FrameUniform { sh_degree: 3, ..FrameUniform::of_camera(&camera, &pose, gpu.tile()) };
    let frame = grown_frame(gpu, &blocks, &view)?;
    let pixels = width as usize * height as usize;
    let v_image = gpu.buffer("v_image", pixels as u64 * 16)?;
    gpu.write(&v_image, 0, &vec![0.3_f32; pixels * 4]);
    let step = StepUniform { gradients_only: 1, ..StepUniform::default() };
    let mut recorder = Recorder::new(gpu);
    let buffers = BackwardBuffers {
        v_image: &v_image,
        v_range: &gpu.buffer("v_range", pixels as u64 * 4)?,
        slot_gradients: &gpu.buffer("slot gradients", u64::from(frame.capacities().1) * 48)?,
        disks: None,
        traced: None,
        step: &gpu.uniform("step", &step),
        appearances: &[],
    };
    record_backward(gpu, &mut recorder, &frame, &blocks, &view, buffers)?;
    recorder.submit();
    let picture: Vec<f32> = gpu.read(&frame.targets()?.image, 0, 4 * pixels)?;
    let (_, _, training) = blocks.trainable().next().ok_or("the scene is empty")?;
    let rows: Vec<[[f32; 4]; 6]> = gpu.read(&training.moments, 0, n as usize)?;
    let row = |at: usize| rows.iter().flat_map(|row| row[at]).collect();
    let colours: Vec<[[f32; 4]; 2]> = gpu.read(&training.sh_moments, 0, (n * sh_stride(3)) as usize)?;
    Ok([picture, row(0), row(1), row(2), colours.iter().flat_map(|[gradient, _]| *gradient).collect()])
}

fn read(file: &str) -> Fallible<Vec<Vec<f32>>> {
    let bytes = fs::read(file)?;
    let (mut rest, mut parts) = (bytes.as_slice(), Vec::new());
    while let Some((count, after)) = rest.split_first_chunk::<8>() {
        let bytes = usize::try_from(u64::from_le_bytes(*count))? * 4;
        let (values, after) = after.split_at_checked(bytes).ok_or_else(|| format!("{file} is cut off"))?;
        parts.push(values.chunks_exact(4).map(|v| f32::from_le_bytes([v[0], v[1], v[2], v[3]])).collect());
        rest = after;
    }
    Ok(parts)
}

fn compare(one: &str, other: &str) -> Fallible<()> {
    let (one, other) = (read(one)?, read(other)?);
    if one.len() != TOLERANCES.len() || other.len() != TOLERANCES.len() {
        return Err("a file has not the parts that this program writes".into());
    }
    let mut faults = Vec::new();
    for ((one, other), (name, tolerance)) in one.iter().zip(&other).zip(TOLERANCES) {
        if one.len() != other.len() {
            return Err(format!("{name}: the files are of different scenes").into());
        }
        let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
        let pairs = one.iter().zip(other).map(|(a, b)| f64::from(*a) - f64::from(*b));
        let apart = square(&mut pairs.clone()).sqrt() / square(&mut one.iter().map(|v| f64::from(*v))).sqrt();
        let most = pairs.fold(0.0, |most: f64, v| most.max(v.abs()));
        println!(
            "{name}: {apart:.1e} of its size apart (tolerance {tolerance:.0e}), single values at most {most:.1e}"
        );
        if apart.is_nan() || apart > tolerance {
            faults.push(name);
        }
    }
    if faults.is_empty() {
        Ok(())
    } else {
        Err(format!("beyond the tolerance: {}", faults.join(", ")).into())
    }
}
