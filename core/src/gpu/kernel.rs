//! Compute kernels: WGSL with its imports, reflected bindings, and recording of dispatches.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock};

use super::Gpu;
use crate::{CoreError, Result};

// `STAGES` and `SHARED`: name and text of each file of `shaders/` and of `shaders/shared/` (`core/build.rs`).
include!(concat!(env!("OUT_DIR"), "/shaders.rs"));

/// How kernels are laid out on an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileLayout {
    /// Side of a tile, pixels; a multiple of 8.
    pub tile: u32,
    /// Whether the threads of a tile are the lanes of one vector (then `tile` is 8). If so, the imports
    /// `votes`, `exchange` and `sums`, also those of disks, are the files that end in `_vector`. Otherwise
    /// they are those that end in `_workgroup`.
    pub vector: bool,
    /// Whether scans and sorts use the files that end in `_subgroups`, where they exist.
    pub subgroups: bool,
}

impl TileLayout {
    /// For GPUs with subgroups of 8 to 128 lanes.
    pub const GPU: Self = Self { tile: 16, vector: false, subgroups: true };
    /// For other GPUs.
    pub const PLAIN_GPU: Self = Self { tile: 16, vector: false, subgroups: false };
    /// For CPU adapters with subgroups of eight lanes.
    pub const VECTOR: Self = Self { tile: 8, vector: true, subgroups: false };
    /// For other CPU adapters.
    pub const SMALL: Self = Self { tile: 8, vector: false, subgroups: false };
    /// All layouts.
    pub const ALL: [Self; 4] = [Self::GPU, Self::PLAIN_GPU, Self::VECTOR, Self::SMALL];

    /// Whether its shaders need subgroups.
    pub fn needs_subgroups(&self) -> bool {
        self.vector || self.subgroups
    }
}

/// Start of a line that names a kernel and the files that replace imports in it:
/// `//@ variant NAME light=water+light_linear`.
const VARIANT: &str = "//@ variant ";

/// A kernel that is made from a file, with the files that replace some of its imports.
struct Variant {
    name: &'static str,
    /// Import, and the files that replace it.
    imports: Vec<(&'static str, Vec<&'static str>)>,
}

impl Variant {
    /// The variants that the header of a file declares. Lines that name the same one add to it.
    fn of(text: &'static str) -> Vec<Self> {
        let mut variants: Vec<Self> = Vec::new();
        for line in text.lines().filter_map(|line| line.strip_prefix(VARIANT)) {
            let mut words = line.split_whitespace();
            let Some(name) = words.next() else { continue };
            let imports = words.filter_map(|word| word.split_once('='));
            let imports = imports.map(|(import, files)| (import, files.split('+').collect()));
            match variants.iter_mut().find(|variant| variant.name == name) {
                Some(variant) => variant.imports.extend(imports),
                None => variants.push(Self { name, imports: imports.collect() }),
            }
        }
        variants
    }

    fn stands_for(&self, import: &str) -> Option<&[&'static str]> {
        self.imports.iter().find(|(name, _)| *name == import).map(|(_, files)| files.as_slice())
    }
}

/// The file that a kernel is made from, by name, and its variant if the file declares any.
fn file_of(kernel: &str) -> (&str, Option<Variant>) {
    let variants = STAGES
        .iter()
        .flat_map(|(file, text)| Variant::of(text).into_iter().map(move |variant| (*file, variant)));
    match variants.into_iter().find(|(_, variant)| variant.name == kernel) {
        Some((file, variant)) => (file, Some(variant)),
        None => (kernel, None),
    }
}

/// Names of the files of `shaders/`; each is a kernel.
pub fn kernel_names() -> impl Iterator<Item = &'static str> {
    STAGES.iter().map(|(name, _)| *name)
}

/// Names of the kernels that are made from the file of another kernel with different imports.
pub fn kernel_variants() -> impl Iterator<Item = &'static str> {
    let variants = STAGES.iter().flat_map(|(_, text)| Variant::of(text)).map(|variant| variant.name);
    variants.filter(|name| STAGES.iter().all(|(file, _)| file != name))
}

/// The complete WGSL of a kernel: the tile size, the files of `shaders/shared/` that its first line
/// `//@ import a, b` names, then the kernel itself.
///
/// # Errors
/// When the kernel or an import does not exist.
pub fn shader_source(name: &str, layout: TileLayout) -> Result<String> {
    let find = |list: &[(&str, &'static str)], name: &str| {
        list.iter()
            .find(|(n, _)| *n == name)
            .map(|(_, text)| *text)
            .ok_or_else(|| CoreError::Gpu(format!("there is no shader {name}")))
    };
    let (file, variant) = file_of(name);
    let body = match layout.subgroups.then(|| find(STAGES, &format!("{file}_subgroups"))) {
        Some(Ok(body)) => body,
        _ => find(STAGES, file)?,
    };
    let imports = body.lines().next().and_then(|line| line.strip_prefix("//@ import ")).unwrap_or("");
    let imports: Vec<&str> = imports.split(',').map(str::trim).filter(|import| !import.is_empty()).collect();
    let (tile, lanes) = (layout.tile, layout.tile * layout.tile / 8);
    let mut source = format!("const TILE: u32 = {tile}u;\nconst LANES: u32 = {lanes}u;\n");
    let kind = if layout.vector { "vector" } else { "workgroup" };
    for import in imports {
        match (import, variant.as_ref().and_then(|variant| variant.stands_for(import))) {
            (_, Some(files)) => {
                for file in files {
                    source.push_str(find(SHARED, file)?);
                }
            }
            ("votes" | "exchange" | "sums" | "exchange_disks" | "sums_disks", None) => {
                source.push_str(find(SHARED, &format!("{import}_{kind}"))?)
            }
            (import, None) => source.push_str(find(SHARED, import)?),
        }
    }
    source.push_str(body);
    Ok(source)
}

/// A compiled kernel.
pub struct Kernel {
    name: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    /// Binding number by the variable's name.
    bindings: HashMap<String, u32>,
    groups: Mutex<HashMap<Vec<wgpu::Buffer>, wgpu::BindGroup>>,
}

impl Kernel {
    fn compile(gpu: &Gpu, name: &'static str) -> Result<Self> {
        let source = shader_source(name, gpu.layout())?;
        let module = naga::front::wgsl::parse_str(&source)
            .map_err(|error| CoreError::Gpu(format!("shader {name}: {}", error.emit_to_string(&source))))?;
        let bindings = module
            .global_variables
            .iter()
            .filter_map(|(_, variable)| Some((variable.name.clone()?, variable.binding?.binding)))
            .collect();
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some(name),
            source: wgpu::ShaderSource::Wgsl(source.into()),
        };
        let shader = if gpu.shader_checks() {
            gpu.device().create_shader_module(descriptor)
        } else {
            // SAFETY: only the kernels of `shaders/` come here. They index by counts that earlier kernels
            // computed and clamped to the lengths of the lists, and every loop counts up to such a count.
            // `core/tests/kernels` tests that the checks change no byte of the output, even with garbage in
            // every buffer and with lists that are too short.
            unsafe {
                gpu.device().create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
            }
        };
        let pipeline = gpu.device().create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(name),
            layout: None,
            module: &shader,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                // Every kernel writes its workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        gpu.check()?;
        let layout = pipeline.get_bind_group_layout(0);
        Ok(Self { name, pipeline, layout, bindings, groups: Mutex::default() })
    }

    fn bind_group(&self, gpu: &Gpu, buffers: &[(&str, &wgpu::Buffer)]) -> Result<wgpu::BindGroup> {
        let key: Vec<wgpu::Buffer> = buffers.iter().map(|(_, buffer)| (*buffer).clone()).collect();
        let mut groups = self
            .groups
            .lock()
            .map_err(|_| CoreError::Gpu(format!("kernel {}: a thread panicked while binding", self.name)))?;
        if let Some(group) = groups.get(&key) {
            return Ok(group.clone());
        }
        let mut entries = Vec::with_capacity(buffers.len());
        for (name, buffer) in buffers {
            let binding = *self
                .bindings
                .get(*name)
                .ok_or_else(|| CoreError::Gpu(format!("kernel {} has no binding {name}", self.name)))?;
            entries.push(wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() });
        }
        let group = gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(self.name),
            layout: &self.layout,
            entries: &entries,
        });
        gpu.check()?;
        groups.insert(key, group.clone());
        Ok(group)
    }
}

/// All kernels of a device, compiled on first use.
#[derive(Default)]
pub(crate) struct Kernels {
    compiled: Mutex<HashMap<&'static str, Arc<OnceLock<Arc<Kernel>>>>>,
}

impl Kernels {
    fn get(&self, gpu: &Gpu, name: &'static str) -> Result<Arc<Kernel>> {
        let cell = {
            let mut compiled = self
                .compiled
                .lock()
                .map_err(|_| CoreError::Gpu("a thread panicked while compiling".into()))?;
            Arc::clone(compiled.entry(name).or_default())
        };
        if let Some(kernel) = cell.get() {
            return Ok(Arc::clone(kernel));
        }
        let kernel = Arc::new(Kernel::compile(gpu, name)?);
        Ok(Arc::clone(cell.get_or_init(|| kernel)))
    }

    /// Drops all bind groups, so that replaced buffers can be freed. Called before a buffer is created and
    /// when memory is released, so code that replaces a buffer does not have to call it.
    pub(super) fn forget_bind_groups(&self) {
        let Ok(compiled) = self.compiled.lock() else { return };
        for kernel in compiled.values().filter_map(|cell| cell.get()) {
            if let Ok(mut groups) = kernel.groups.lock() {
                groups.clear();
            }
        }
    }
}

/// Number of workgroups of a dispatch.
#[derive(Clone, Copy)]
pub enum Size<'a> {
    /// Known to the host; folded into two dimensions.
    Groups(u32),
    /// One thread per item; the second number is threads per group.
    Items(u32, u32),
    /// Computed by a `count_*` kernel; the slot of the argument buffer.
    Indirect(&'a wgpu::Buffer, u32),
}

/// Device time of a kernel, seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct KernelTime {
    /// The kernel.
    pub kernel: &'static str,
    /// Seconds on the device, summed over its dispatches.
    pub seconds: f64,
    /// Number of dispatches.
    pub dispatches: u32,
}

/// Adds the time of one dispatch to that of its kernel.
fn add_time(times: &mut Vec<KernelTime>, kernel: &'static str, seconds: f64) {
    match times.iter_mut().find(|time| time.kernel == kernel) {
        Some(time) => {
            time.seconds += seconds;
            time.dispatches += 1;
        }
        None => times.push(KernelTime { kernel, seconds, dispatches: 1 }),
    }
}

/// Records dispatches into one submission; with timing on, each dispatch is a pass of its own.
pub struct Recorder<'g> {
    gpu: &'g Gpu,
    encoder: wgpu::CommandEncoder,
    timing: Option<Timing>,
    stepping: Option<Stepping>,
}

struct Stepping {
    clock: fn() -> f64,
    times: Vec<KernelTime>,
}

struct Timing {
    queries: wgpu::QuerySet,
    names: Vec<&'static str>,
    /// Dispatches without a query.
    untimed: u32,
}

const MAX_TIMED: u32 = 2048;

impl<'g> Recorder<'g> {
    /// An empty recording.
    pub fn new(gpu: &'g Gpu) -> Self {
        let encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self { gpu, encoder, timing: None, stepping: None }
    }

    /// An empty recording that runs every dispatch immediately, alone, and times it with `clock`, seconds.
    /// With a clock of CPU time this measures the cost of a kernel on a CPU adapter, regardless of other
    /// load.
    pub fn stepped(gpu: &'g Gpu, clock: fn() -> f64) -> Self {
        Self { stepping: Some(Stepping { clock, times: Vec::new() }), ..Self::new(gpu) }
    }

    /// An empty recording whose dispatches are timed, if the device supports it.
    pub fn timed(gpu: &'g Gpu) -> Self {
        let mut recorder = Self::new(gpu);
        if gpu.has_timestamps() {
            let queries = gpu.device().create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("kernel times"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * MAX_TIMED,
            });
            recorder.timing = Some(Timing { queries, names: Vec::new(), untimed: 0 });
        }
        recorder
    }

    /// Appends one dispatch. `buffers` are matched to the shader's variables by name.
    ///
    /// # Errors
    /// When the shader does not compile or a name is not one of its bindings.
    pub fn dispatch(
        &mut self,
        kernel: &'static str,
        size: Size<'_>,
        buffers: &[(&str, &wgpu::Buffer)],
    ) -> Result<()> {
        let gpu = self.gpu;
        let compiled = gpu.kernels().get(gpu, kernel)?;
        let group = compiled.bind_group(gpu, buffers)?;
        let groups = match size {
            Size::Groups(groups) => Some(groups),
            Size::Items(items, per_group) => Some(items.div_ceil(per_group)),
            Size::Indirect(..) => None,
        };
        if groups == Some(0) {
            return Ok(());
        }
        let timestamp_writes = self.timing.as_mut().and_then(|timing| {
            let at = 2 * timing.names.len() as u32;
            if at >= 2 * MAX_TIMED {
                timing.untimed += 1;
                return None;
            }
            timing.names.push(kernel);
            Some(wgpu::ComputePassTimestampWrites {
                query_set: &timing.queries,
                beginning_of_pass_write_index: Some(at),
                end_of_pass_write_index: Some(at + 1),
            })
        });
        let mut pass = self
            .encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(kernel), timestamp_writes });
        pass.set_pipeline(&compiled.pipeline);
        pass.set_bind_group(0, &group, &[]);
        match (size, groups) {
            (Size::Indirect(args, slot), _) => pass.dispatch_workgroups_indirect(args, u64::from(slot) * 12),
            (_, Some(groups)) => {
                // The same fold as `put` in the count_* kernels.
                let x = groups.min(32_768);
                pass.dispatch_workgroups(x, groups.div_ceil(x), 1);
            }
            (_, None) => {}
        }
        drop(pass);
        if let Some(clock) = self.stepping.as_ref().map(|stepping| stepping.clock) {
            let before = clock();
            self.flush();
            gpu.wait()?;
            let seconds = clock() - before;
            if let Some(stepping) = &mut self.stepping {
                add_time(&mut stepping.times, kernel, seconds);
            }
        }
        Ok(())
    }

    /// Copies a whole buffer to the beginning of another.
    pub fn copy(&mut self, from: &wgpu::Buffer, to: &wgpu::Buffer) {
        self.encoder.copy_buffer_to_buffer(from, 0, to, 0, from.size().min(to.size()));
    }

    /// Sets a whole buffer to zero.
    pub fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.encoder.clear_buffer(buffer, 0, None);
    }

    /// Submits the recording so far. Later dispatches are another submission and see later uniform writes.
    pub fn flush(&mut self) {
        let next = self.gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let recorded = std::mem::replace(&mut self.encoder, next);
        self.gpu.queue().submit([recorded.finish()]);
    }

    /// Submits the recording.
    pub fn submit(self) {
        self.gpu.queue().submit([self.encoder.finish()]);
    }

    /// Submits, waits, and returns the time of each kernel in the order of first use.
    ///
    /// # Errors
    /// When the device fails.
    pub fn submit_timed(mut self) -> Result<Vec<KernelTime>> {
        if let Some(stepping) = self.stepping.take() {
            let gpu = self.gpu;
            self.submit();
            gpu.wait()?;
            return Ok(stepping.times);
        }
        let Some(timing) = self.timing.take() else {
            self.submit();
            return Ok(Vec::new());
        };
        if timing.untimed > 0 {
            tracing::warn!(timing.untimed, "dispatches beyond {MAX_TIMED} are missing from the kernel times");
        }
        let count = 2 * timing.names.len() as u32;
        let resolved = self.gpu.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some("kernel times"),
            size: u64::from(count.max(2)) * 8,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        self.encoder.resolve_query_set(&timing.queries, 0..count, &resolved, 0);
        let gpu = self.gpu;
        self.submit();
        let ticks: Vec<u64> = gpu.read(&resolved, 0, count as usize)?;
        let period = f64::from(gpu.queue().get_timestamp_period()) * 1e-9;
        let mut times: Vec<KernelTime> = Vec::new();
        for (pair, &kernel) in ticks.chunks_exact(2).zip(&timing.names) {
            add_time(&mut times, kernel, pair[1].saturating_sub(pair[0]) as f64 * period);
        }
        Ok(times)
    }
}
