//! No kernel reads workgroup memory before writing it. Pipelines do not clear this memory.

use std::sync::{Arc, Mutex, PoisonError};

use fathom_core::config::{Blend, DbdrConfig, FilmConfig, Medium, PriorsConfig, WaterConfig};
use fathom_core::gpu::{Gpu, Recorder, counter};
use fathom_core::train::{
    BackwardBuffers, DeviceMedium, DevicePhotograph, ExposureStep, Exposures, Film, FilmStep, Loss,
    WaterStep, record_backward,
};
use fathom_core::views::PackedImage;
use fathom_twins::samples;

use crate::device::{assert_same_bits, layouts, poison, storage};
use crate::view::{ImageGradients, Scene, View, gradients_only};
use crate::water::{fixed, gradients_of};

/// Two kernels that use all the workgroup memory that every adapter has. `fill` leaves a NaN in each word;
/// `look` writes nothing and counts the words that hold that NaN.
struct Rubbish {
    gpu: Arc<Gpu>,
    fill: wgpu::ComputePipeline,
    look: wgpu::ComputePipeline,
    counts: wgpu::Buffer,
}

const SOURCE: &str = "
const WORDS: u32 = 4096u;
var<workgroup> words: array<u32, 4096>;
@group(0) @binding(0) var<storage, read_write> counts: array<atomic<u32>>;

@compute @workgroup_size(64)
fn fill(@builtin(local_invocation_index) thread: u32) {
    for (var i = thread; i < WORDS; i += 64u) { words[i] = 0x7fc01234u; }
    workgroupBarrier();
    // So that the writes are not optimised away.
    if words[(thread * 61u) % WORDS] != 0x7fc01234u { atomicAdd(&counts[1], 1u); }
}

@compute @workgroup_size(64)
fn look(@builtin(local_invocation_index) thread: u32) {
    var found = 0u;
    for (var i = thread; i < WORDS; i += 64u) { found += u32(words[i] == 0x7fc01234u); }
    atomicAdd(&counts[0], found);
}
";

impl Rubbish {
    fn new(gpu: &Arc<Gpu>) -> Self {
        let module = gpu.device().create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("rubbish"),
            source: wgpu::ShaderSource::Wgsl(SOURCE.into()),
        });
        let pipeline = |entry| {
            gpu.device().create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry),
                layout: None,
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            })
        };
        let (fill, look) = (pipeline("fill"), pipeline("look"));
        Self { gpu: Arc::clone(gpu), fill, look, counts: storage(gpu, &[0_u32; 2]) }
    }

    /// Dispatches enough workgroups to reach every core that later kernels may use.
    fn run(&self, pipeline: &wgpu::ComputePipeline) {
        let group = self.gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &pipeline.get_bind_group_layout(0),
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: self.counts.as_entire_binding() }],
        });
        let mut encoder = self.gpu.device().create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(1024, 1, 1);
        drop(pass);
        self.gpu.queue().submit([encoder.finish()]);
        self.gpu.wait().unwrap();
    }

    /// Whether the next kernel finds the NaNs of `fill`.
    fn stays(&self) -> bool {
        self.run(&self.fill);
        self.run(&self.look);
        self.gpu.read::<u32>(&self.counts, 0, 1).unwrap()[0] > 0
    }
}

static RUBBISH: Mutex<Option<Rubbish>> = Mutex::new(None);

/// Serves as the clock of a stepped recording, so it runs before and after each dispatch.
fn fill() -> f64 {
    if let Some(rubbish) = &*RUBBISH.lock().unwrap_or_else(PoisonError::into_inner) {
        rubbish.run(&rubbish.fill);
    }
    0.0
}

/// The outputs of forward, exposure, loss, water, view embedding and backward of one view.
fn iteration(gpu: &Arc<Gpu>, recorder: fn(&Gpu) -> Recorder<'_>) -> [Vec<u32>; 8] {
    let scene = Scene::new("random", samples::random(161, 300, 2), 75, 53);
    let view = View::render(gpu, &scene);
    let pixels = view.pixels();
    let submit = |mut record: Box<dyn FnMut(&mut Recorder<'_>) + '_>| {
        let mut recorder = recorder(gpu);
        record(&mut recorder);
        recorder.submit_timed().unwrap();
    };
    poison(gpu, &view.frame.targets().unwrap().image);
    submit(Box::new(|recorder| {
        view.frame.record_forward(gpu, recorder, &view.blocks, &view.uniform).unwrap()
    }));

    let truth = PackedImage { width: 75, height: 53, pixels: vec![0xff80_6040; pixels] };
    let truth = DevicePhotograph::new(gpu, &truth).unwrap();
    let mut loss = Loss::new(gpu).unwrap();
    loss.prepare(gpu, truth.size).unwrap();
    let mut exposures = Exposures::new(gpu, 3).unwrap();
    exposures.prepare(gpu, truth.size).unwrap();
    let step = ExposureStep { view: 1, steps: 1, rate: 0.01, size: truth.size };
    let image = &view.frame.targets().unwrap().image;
    submit(Box::new(|recorder| {
        let exposed = exposures.record(gpu, recorder, image, step).unwrap();
        loss.record(gpu, recorder, &truth, exposed, 0.2, 1).unwrap();
        let v_image = loss.v_image().unwrap();
        exposures.record_backward(recorder, image, v_image, &view.frame.counters, step.size).unwrap();
    }));

    let v = ImageGradients::random(162, pixels);
    let (v_image, v_range) = (storage(gpu, &v.image), storage(gpu, &v.range));
    let intersections = view.counter(counter::INTERSECTIONS) as u64;
    let slot_gradients = gpu.buffer("slot gradients", 48 * intersections).unwrap();
    let step = gpu.uniform("step", &gradients_only());
    let buffers = BackwardBuffers {
        v_image: &v_image,
        v_range: &v_range,
        slot_gradients: &slot_gradients,
        disks: None,
        traced: None,
        step: &step,
        appearances: &[],
    };
    submit(Box::new(|recorder| {
        record_backward(gpu, recorder, &view.frame, &view.blocks, &view.uniform, buffers).unwrap();
    }));
    let priors = PriorsConfig { dark_channel: 1.0, depth_smoothness: 2.0, ..PriorsConfig::default() };
    let water = WaterConfig { priors, ..WaterConfig::default() };
    let mut water = DeviceMedium::new(gpu, fixed(&water, 3.0)).unwrap();
    water.give_to(gpu, &view.frame);
    water.prepare(gpu, truth.size, 300, 1).unwrap();
    let water_step = WaterStep {
        size: truth.size,
        has_surfaces: true,
        rate: Some(0.01),
        steps: 1,
        terms: 1.0,
        ..WaterStep::default()
    };
    submit(Box::new(|recorder| {
        let (truth, gradients) = (loss.truth().unwrap(), [&v_image, &v_range]);
        water.record(gpu, recorder, &view.frame, water_step, 300, 1).unwrap();
        water.record_backward(gpu, recorder, &view.frame, truth, None, water_step, gradients).unwrap();
        water
            .record_gradients(gpu, recorder, gradients_of(&view.frame, &view.blocks, &slot_gradients))
            .unwrap();
        water.record_step(recorder, &view.frame).unwrap();
    }));
    let words = |buffer: &wgpu::Buffer, count: u64| gpu.read::<u32>(buffer, 0, count as usize).unwrap();
    let all = |arrays: &[(&wgpu::Buffer, usize)]| -> Vec<u32> {
        arrays.iter().flat_map(|(buffer, bytes)| words(buffer, *bytes as u64 / 4)).collect()
    };
    let of_water = all(&water.arrays(&view.frame));
    // A water with DBDR, and a view embedding.
    let maps = WaterConfig {
        medium: Medium::PerPixel,
        blend: Blend::Linear,
        dbdr: DbdrConfig::paper(),
        ..WaterConfig::default()
    };
    let mut refined = DeviceMedium::new(gpu, fixed(&maps, 3.0)).unwrap();
    refined.give_to(gpu, &view.frame);
    refined.prepare(gpu, truth.size, 300, 1).unwrap();
    let mut film = Film::new(gpu, &FilmConfig::paper(), 3, 7).unwrap();
    film.prepare(gpu, truth.size).unwrap();
    let film_step = FilmStep { view: 1, size: truth.size, rate: Some(0.01), steps: 1, view_steps: 1 };
    submit(Box::new(|recorder| {
        let (truth, gradients) = (loss.truth().unwrap(), [&v_image, &v_range]);
        let seen = refined.record(gpu, recorder, &view.frame, water_step, 300, 1).unwrap();
        film.record(gpu, recorder, seen, film_step).unwrap();
        film.record_backward(recorder, seen, &v_image, &view.frame.counters, film_step).unwrap();
        refined.record_backward(gpu, recorder, &view.frame, truth, None, water_step, gradients).unwrap();
        refined.record_step(recorder, &view.frame).unwrap();
    }));
    [
        words(image, 4 * pixels as u64),
        words(loss.v_image().unwrap(), 4 * pixels as u64),
        words(&slot_gradients, 12 * intersections),
        vec![loss.mean(gpu, 1..2).unwrap().to_bits()],
        exposures.download(gpu).unwrap().iter().flatten().flatten().map(|value| value.to_bits()).collect(),
        of_water,
        all(&refined.arrays(&view.frame)),
        all(&film.arrays()),
    ]
}

#[test]
fn rubbish_in_workgroup_memory_changes_no_byte() {
    for gpu in layouts() {
        let rubbish = Rubbish::new(&gpu);
        // The rubbish must survive for this test to prove anything. Other drivers may clear it, so only
        // Mesa's CPU driver must keep it. Several tries, because a driver thread may run another test between
        // two kernels.
        let must_stay = gpu.adapter().name.contains("llvmpipe");
        assert!((0..50).any(|_| rubbish.stays()) || !must_stay, "no kernel can read the rubbish");
        let plain = iteration(&gpu, |gpu| Recorder::new(gpu));
        *RUBBISH.lock().unwrap_or_else(PoisonError::into_inner) = Some(rubbish);
        let filled = iteration(&gpu, |gpu| Recorder::stepped(gpu, fill));
        *RUBBISH.lock().unwrap_or_else(PoisonError::into_inner) = None;
        let what = ["image", "gradient of the image", "slots", "loss", "exposures", "water", "maps", "film"];
        for ((what, plain), filled) in what.iter().zip(&plain).zip(&filled) {
            assert_same_bits(&format!("{what}, {:?}", gpu.layout()), plain, filled);
        }
    }
}
