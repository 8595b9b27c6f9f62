//! Measures the kernels of a training step over random Gaussians, and the sort and the scan alone, for
//! `make bench`.
//!
//! `cargo run --release --example bench_random -- [GAUSSIANS] [WIDTH HEIGHT] [--repeats N] [--entries N,N]
//! [--write-scene FILE]`: the scene is that of `shared/random_scene.rs`. Without arguments it has 30,000
//! Gaussians at 480x270 on a CPU adapter, 1,000,000 at 1920x1080 on a GPU. A step is forward, backward with a
//! constant gradient of the picture instead of a loss, and Adam. The learning rates are so small that every
//! repetition has the same work.
//!
//! It prints one JSON object. Times are medians over the repetitions in seconds. `seconds` are the device's
//! timestamps; `cpu_seconds` are CPU time on a CPU adapter, where each stage runs alone. `passes` are whole
//! submissions. `--write-scene` also writes the scene for other programs (`random_scene::write`). Bytes are
//! those of the lists that a stage reads and writes, each entry once; null if there is no simple count.

use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use fathom_core::config::Moments;
use fathom_core::gpu::{
    Blocks, Frame, FrameUniform, Gpu, GpuOptions, KernelTime, Recorder, StepUniform, Workload, sh_stride,
};
use fathom_core::train::{BackwardBuffers, record_backward};
use serde_json::{Value, json};

#[path = "shared/cpu_time.rs"]
mod cpu_time;
#[path = "shared/floor.rs"]
mod floor;
#[path = "shared/grown_frame.rs"]
mod grown_frame;
#[path = "shared/primitives.rs"]
mod primitives;
#[path = "shared/random_scene.rs"]
mod random_scene;

use cpu_time::cpu_seconds;
use floor::{BACKWARD_RATE, FORWARD_RATE, floor_cpu_seconds};
use grown_frame::grown_frame;
use primitives::{KEY_BITS, Primitive, Primitives};

type Fallible<T> = Result<T, Box<dyn Error>>;

/// Format of the output. `scripts/bench.sh` only compares commits of the same format, and reads it from this
/// line.
const FORMAT: u32 = 1;

struct Arguments {
    gaussians: u32,
    width: u32,
    height: u32,
    repeats: u32,
    entries: Vec<u32>,
    write_scene: Option<String>,
}

fn arguments(is_cpu: bool) -> Fallible<Arguments> {
    let (gaussians, width, height) = if is_cpu { (30_000, 480, 270) } else { (1_000_000, 1920, 1080) };
    let mut found = Arguments {
        gaussians,
        width,
        height,
        repeats: if is_cpu { 5 } else { 20 },
        entries: vec![1_000_000, 4_000_000],
        write_scene: None,
    };
    let mut words = std::env::args().skip(1);
    let mut numbers: Vec<u32> = Vec::new();
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or_else(|| format!("{word} has no value"));
        match word.as_str() {
            "--repeats" => found.repeats = value()?.parse()?,
            "--entries" => found.entries = value()?.split(',').map(str::parse).collect::<Result<_, _>>()?,
            "--write-scene" => found.write_scene = Some(value()?),
            number => numbers
                .push(number.parse().map_err(|_| format!("{number} is neither a number nor an option"))?),
        }
    }
    match numbers[..] {
        [] => {}
        [n] => found.gaussians = n,
        [n, width, height] => (found.gaussians, found.width, found.height) = (n, width, height),
        _ => {
            return Err("usage: bench_random [GAUSSIANS] [WIDTH HEIGHT] [--repeats N] [--entries N,N] \
                        [--write-scene FILE]"
                .into());
        }
    }
    let numbers = [found.repeats, found.gaussians, found.width, found.height];
    if numbers.contains(&0) || found.entries.contains(&0) {
        return Err("every number must be at least 1".into());
    }
    Ok(found)
}

#[derive(Clone, Copy, PartialEq)]
enum Pass {
    Forward,
    Backward,
}

impl Pass {
    fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Backward => "backward",
        }
    }
}

/// A training step without a loss, on the device.
struct Step {
    gpu: Arc<Gpu>,
    blocks: Blocks,
    frame: Frame,
    view: FrameUniform,
    v_image: wgpu::Buffer,
    v_range: wgpu::Buffer,
    slot_gradients: wgpu::Buffer,
    rates: wgpu::Buffer,
}

impl Step {
    fn new(gpu: &Arc<Gpu>, arguments: &Arguments) -> Fallible<Self> {
        let &Arguments { gaussians: n, width, height, .. } = arguments;
        let mut blocks = Blocks::new(gpu, 3)?;
        blocks.push_trainable(gpu, &random_scene::model(n), n, Moments::Compact)?;
        let (camera, pose) = random_scene::camera(width, height);
        let view = FrameUniform { sh_degree: 3, ..FrameUniform::of_camera(&camera, &pose, gpu.tile()) };
        if view.bands(1, gpu.tile()).len() > 1 {
            return Err(
                format!("{width}x{height} has too many tiles for one band; take a smaller picture").into()
            );
        }
        let frame = grown_frame(gpu, &blocks, &view)?;
        let pixels = u64::from(width) * u64::from(height);
        let v_image = gpu.buffer("v_image", pixels * 16)?;
        gpu.write(&v_image, 0, &vec![0.3_f32; pixels as usize * 4]);
        let rates = StepUniform {
            means_lr: 1e-6,
            quats_lr: 1e-6,
            scales_lr: 1e-6,
            opacity_lr: 1e-6,
            sh_dc_lr: 1e-6,
            sh_rest_lr: 1e-6,
            opacity_reg: 0.01,
            scale_reg: 0.01,
            mean_noise: 1e-6,
            trainable: n,
            ..StepUniform::default()
        };
        Ok(Self {
            v_range: gpu.buffer("v_range", pixels * 4)?,
            slot_gradients: gpu.buffer("slot gradients", u64::from(frame.capacities().1) * 48)?,
            rates: gpu.uniform("step", &rates),
            gpu: Arc::clone(gpu),
            blocks,
            frame,
            view,
            v_image,
        })
    }

    fn record(&self, recorder: &mut Recorder<'_>, pass: Pass) -> Fallible<()> {
        if pass == Pass::Forward {
            self.frame.record_forward(&self.gpu, recorder, &self.blocks, &self.view)?;
            return Ok(());
        }
        let buffers = BackwardBuffers {
            v_image: &self.v_image,
            v_range: &self.v_range,
            slot_gradients: &self.slot_gradients,
            disks: None,
            traced: None,
            step: &self.rates,
            appearances: &[],
        };
        Ok(record_backward(&self.gpu, recorder, &self.frame, &self.blocks, &self.view, buffers)?)
    }

    /// Runs both passes, each as one submission, and returns their wall and CPU seconds.
    fn run(&self) -> Fallible<[(f64, f64); 2]> {
        let mut taken = [(0.0, 0.0); 2];
        for (pass, taken) in [Pass::Forward, Pass::Backward].into_iter().zip(&mut taken) {
            let (wall, cpu) = (Instant::now(), cpu_seconds());
            let mut recorder = Recorder::new(&self.gpu);
            self.record(&mut recorder, pass)?;
            recorder.submit();
            self.gpu.wait()?;
            *taken = (wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
        }
        Ok(taken)
    }

    /// Bytes of the lists that a stage reads and writes, each entry once; `None` if there is no simple count.
    fn bytes(&self, stage: &str, work: &Workload) -> Option<u64> {
        let (v, i) = (u64::from(work.visible), u64::from(work.intersections));
        let n = u64::from(self.blocks.total());
        let pixels = u64::from(self.view.size[0]) * u64::from(self.view.size[1]);
        let tiles = u64::from(self.view.tile_count());
        // For each intersection, rasterisation fetches the slot, its Gaussian, and the splat of 48 bytes.
        let fetched = work.needed_evaluations / u64::from(self.gpu.tile()).pow(2) * 56;
        let stride = sh_stride(self.blocks.sh_degree());
        let harmonics = 16 * u64::from(stride);
        Some(match stage {
            "cull" => n * (48 + 4),
            "project_forward" => n * 4 + v * (48 + harmonics + 48 + 12),
            "intersect_count" => v * (4 + 32 + 4),
            "intersect_emit" => v * (8 + 32 + 8) + i * 12,
            "tile_ranges" => i * 4 + tiles * 8,
            "rasterize_forward" => fetched + tiles * 12 + pixels * 20,
            "rasterize_backward" => fetched + tiles * 12 + pixels * 40 + i * 48,
            "project_backward" => {
                let (_, _, training) = self.blocks.trainable().next()?;
                let state: usize = training.arrays(stride).iter().map(|(_, bytes)| bytes).sum();
                v * (12 + 2 * (48 + harmonics + state as u64)) + i * 48
            }
            _ => return None,
        })
    }
}

/// Times of one stage of a pass in every repetition.
struct KernelTimes {
    pass: Pass,
    kernel: &'static str,
    dispatches: u32,
    seconds: Vec<f64>,
    cpu_seconds: Vec<f64>,
}

fn collect(all: &mut Vec<KernelTimes>, pass: Pass, times: Vec<KernelTime>, by_cpu: bool) {
    for KernelTime { kernel: stage, seconds, dispatches } in times {
        let at = all.iter().position(|have| have.pass == pass && have.kernel == stage).unwrap_or_else(|| {
            all.push(KernelTimes {
                pass,
                kernel: stage,
                dispatches,
                seconds: Vec::new(),
                cpu_seconds: Vec::new(),
            });
            all.len() - 1
        });
        let list = if by_cpu { &mut all[at].cpu_seconds } else { &mut all[at].seconds };
        list.push(seconds);
    }
}

/// CPU seconds of a nearly empty submission, which are part of the time of each dispatch that runs alone.
fn submission_cpu_seconds(gpu: &Gpu) -> Fallible<Option<f64>> {
    let nothing = gpu.buffer("nothing", 16)?;
    let mut taken = Vec::new();
    for _ in 0..50 {
        let before = cpu_seconds();
        let mut recorder = Recorder::new(gpu);
        recorder.clear(&nothing);
        recorder.submit();
        gpu.wait()?;
        taken.push(cpu_seconds() - before);
    }
    Ok(median(&taken))
}

/// The median; `None` without values.
fn median(times: &[f64]) -> Option<f64> {
    let mut sorted = times.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    let high = *sorted.get(middle)?;
    Some(if sorted.len() % 2 == 1 { high } else { 0.5 * (sorted[middle - 1] + high) })
}

fn per_second(amount: f64, seconds: Option<f64>) -> Option<f64> {
    seconds.filter(|&seconds| seconds > 0.0).map(|seconds| amount / seconds)
}

fn digest<T: bytemuck::Pod>(values: &[T]) -> String {
    blake3::hash(bytemuck::cast_slice(values)).to_hex()[..32].to_owned()
}

/// The object of one stage or primitive: its times, its bytes and, on a GPU, its bandwidth.
fn times_of(
    gpu: &Gpu,
    seconds: &[f64],
    cpu_seconds: &[f64],
    bytes: Option<u64>,
) -> serde_json::Map<String, Value> {
    let seconds = median(seconds);
    let mut object = serde_json::Map::new();
    object.insert("seconds".to_owned(), json!(seconds));
    object.insert("cpu_seconds".to_owned(), json!(median(cpu_seconds)));
    object.insert("bytes".to_owned(), json!(bytes));
    if !gpu.adapter().is_cpu {
        let rate = bytes.and_then(|bytes| per_second(bytes as f64 * 1e-9, seconds));
        object.insert("gigabytes_per_second".to_owned(), json!(rate));
    }
    object
}

fn measure_primitives(gpu: &Gpu, arguments: &Arguments) -> Fallible<Vec<Value>> {
    let mut found = Vec::new();
    for &n in &arguments.entries {
        let primitives = Primitives::new(gpu, n)?;
        for primitive in [Primitive::Sort, Primitive::Scan] {
            let (mut seconds, mut cpu) = (Vec::new(), Vec::new());
            for repeat in 0..=arguments.repeats {
                primitives.refill(primitive)?;
                let before = cpu_seconds();
                let mut recorder = Recorder::timed(gpu);
                primitives.record(&mut recorder, primitive)?;
                let times = recorder.submit_timed()?;
                gpu.wait()?;
                let taken = cpu_seconds() - before;
                if repeat == 0 {
                    // The first repetition compiles the kernels.
                    primitives.check(primitive)?;
                    continue;
                }
                if gpu.has_timestamps() {
                    seconds.push(times.iter().map(|time| time.seconds).sum());
                }
                if gpu.adapter().is_cpu {
                    cpu.push(taken);
                }
            }
            let mut object = times_of(gpu, &seconds, &cpu, Some(primitive.bytes(n)));
            object.insert("primitive".to_owned(), json!(primitive.name()));
            object.insert("entries".to_owned(), json!(n));
            object.insert("bits".to_owned(), json!((primitive == Primitive::Sort).then_some(KEY_BITS)));
            let n = f64::from(n);
            object.insert("entries_per_second".to_owned(), json!(per_second(n, median(&seconds))));
            object.insert("entries_per_cpu_second".to_owned(), json!(per_second(n, median(&cpu))));
            found.push(Value::Object(object));
        }
    }
    Ok(found)
}

fn main() -> Fallible<()> {
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, ..Default::default() })?;
    let is_cpu = gpu.adapter().is_cpu;
    let arguments = arguments(is_cpu)?;
    if let Some(file) = &arguments.write_scene {
        let Arguments { gaussians, width, height, .. } = arguments;
        random_scene::write(file.as_ref(), gaussians, width, height)
            .map_err(|error| format!("{file} cannot be written: {error}"))?;
    }
    let step = Step::new(&gpu, &arguments)?;
    // Compiles the other kernels.
    step.run()?;
    let work = step.frame.workload(&gpu, &step.view)?;
    let pixels = arguments.width as usize * arguments.height as usize;
    let image: Vec<u32> = gpu.read(&step.frame.targets()?.image, 0, 4 * pixels)?;
    let gradients: Vec<u32> = gpu.read(&step.slot_gradients, 0, 12 * work.intersections as usize)?;

    let (mut stages, mut passes) = (Vec::new(), [(); 4].map(|()| Vec::new()));
    for _ in 0..arguments.repeats {
        for (at, (wall, cpu)) in step.run()?.into_iter().enumerate() {
            passes[at].push(wall);
            passes[2 + at].push(cpu);
        }
        for by_cpu in [false, true] {
            if by_cpu && !is_cpu {
                continue;
            }
            for pass in [Pass::Forward, Pass::Backward] {
                let mut recorder =
                    if by_cpu { Recorder::stepped(&gpu, cpu_seconds) } else { Recorder::timed(&gpu) };
                step.record(&mut recorder, pass)?;
                collect(&mut stages, pass, recorder.submit_timed()?, by_cpu);
            }
        }
    }
    let model = step.blocks.download(&gpu)?;

    let stage_of = |name: &str| stages.iter().find(|times| times.kernel == name);
    let rate_of = |name: &str, rate: f64| {
        let evaluations = work.needed_evaluations as f64;
        let (seconds, cpu) =
            stage_of(name).map_or((None, None), |times| (median(&times.seconds), median(&times.cpu_seconds)));
        let floor = is_cpu.then_some(evaluations / rate);
        json!({
            "evaluations_per_second": per_second(evaluations, seconds),
            "evaluations_per_cpu_second": per_second(evaluations, cpu),
            "floor_cpu_seconds": floor,
            "ratio_to_floor": cpu.zip(floor).map(|(cpu, floor)| cpu / floor),
        })
    };
    let [forward_wall, backward_wall, forward_cpu, backward_cpu] = passes.map(|times| median(&times));
    let floor = floor_cpu_seconds(work.needed_evaluations as f64);
    let step_cpu = forward_cpu.zip(backward_cpu).map(|(forward, backward)| forward + backward);
    let on_cpu = |value: Option<f64>| value.filter(|_| is_cpu);
    let stages: Vec<Value> = stages
        .iter()
        .map(|times| {
            let bytes = step.bytes(times.kernel, &work);
            let mut object = times_of(&gpu, &times.seconds, &times.cpu_seconds, bytes);
            object.insert("pass".to_owned(), json!(times.pass.name()));
            object.insert("stage".to_owned(), json!(times.kernel));
            object.insert("dispatches".to_owned(), json!(times.dispatches));
            Value::Object(object)
        })
        .collect();
    let result = json!({
        "format": FORMAT,
        "adapter": gpu.adapter().name,
        "driver": gpu.adapter().driver,
        "is_cpu": is_cpu,
        "tile": gpu.tile(),
        "shader_checks": gpu.shader_checks(),
        "gaussians": arguments.gaussians,
        "size": [arguments.width, arguments.height],
        "repeats": arguments.repeats,
        "visible": work.visible,
        "intersections": work.intersections,
        "listed_evaluations": work.listed_evaluations,
        "needed_evaluations": work.needed_evaluations,
        "stages": stages,
        "passes": {
            "forward": { "wall_seconds": forward_wall, "cpu_seconds": on_cpu(forward_cpu) },
            "backward": { "wall_seconds": backward_wall, "cpu_seconds": on_cpu(backward_cpu) },
        },
        "rasterize_forward": rate_of("rasterize_forward", FORWARD_RATE),
        "rasterize_backward": rate_of("rasterize_backward", BACKWARD_RATE),
        "floor_cpu_seconds": on_cpu(Some(floor)),
        "ratio_to_floor": on_cpu(step_cpu.map(|cpu| cpu / floor)),
        "submission_cpu_seconds": if is_cpu { submission_cpu_seconds(&gpu)? } else { None },
        "primitives": measure_primitives(&gpu, &arguments)?,
        "digests": {
            "image": digest(&image),
            "gradients": digest(&gradients),
            "model": digest(&[
                bytemuck::cast_slice::<_, f32>(&model.means),
                bytemuck::cast_slice(&model.quats),
                bytemuck::cast_slice(&model.log_scales),
                &model.opacity_logits,
                bytemuck::cast_slice(&model.sh_coeffs),
            ].concat()),
        },
    });
    println!("{}", serde_json::to_string_pretty(&result)?);
    Ok(())
}
