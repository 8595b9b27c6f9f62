//! Adapter, device, buffers and reads from the device.

use std::io::Write as _;
use std::sync::Arc;

use super::faults::Faults;
use super::kernel::{Kernels, TileLayout};
use super::memory::Ledger;
use crate::{CoreError, Result};

/// Which adapter to use, and how much of its memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct GpuOptions {
    /// Index in the list of [`adapters`]; `None` takes the first real GPU.
    pub index: Option<usize>,
    /// Whether an adapter that runs on the CPU (lavapipe) may be used if there is no GPU.
    pub allow_cpu: bool,
    /// Largest amount of memory allocated at once, bytes, for shared GPUs and for tests. Beyond it,
    /// allocation fails as on a device of that size. The driver's blocks, which buffers are cut from, may be
    /// somewhat larger in total ([`DeviceMemory::reserved_bytes`](super::DeviceMemory::reserved_bytes)).
    /// `None`, the default, sets no limit beyond the driver's.
    pub memory_limit: Option<u64>,
    /// Whether shaders check every index and every loop at run time. `None`, the default: in debug builds
    /// only, as `debug_assert` does. All shaders are this crate's own, and `core/tests/kernels` tests that
    /// the results are the same with and without checks.
    pub shader_checks: Option<bool>,
}

/// Storage buffers of one kernel, at most. WebGPU guarantees 8, so this is asked for by name. Workgroup
/// memory and threads stay within what WebGPU guarantees. `tests/shaders` compares all of it with every
/// kernel.
pub const STORAGE_BUFFERS: u32 = 10;

/// The limits to open the adapter `name` with: what kernels need, and sizes of buffers and dispatches as
/// large as the adapter has them.
///
/// # Errors
/// [`CoreError::NoAdapter`] if the adapter lacks something.
fn limits_for_kernels(adapter: wgpu::Limits, name: &str) -> Result<wgpu::Limits> {
    let guaranteed = wgpu::Limits::default();
    let limits = wgpu::Limits {
        max_storage_buffers_per_shader_stage: STORAGE_BUFFERS,
        max_compute_workgroup_storage_size: guaranteed.max_compute_workgroup_storage_size,
        max_compute_invocations_per_workgroup: guaranteed.max_compute_invocations_per_workgroup,
        max_compute_workgroup_size_x: guaranteed.max_compute_workgroup_size_x,
        ..adapter.clone()
    };
    let needs = [
        (
            "storage buffers in a shader",
            limits.max_storage_buffers_per_shader_stage,
            adapter.max_storage_buffers_per_shader_stage,
        ),
        (
            "bytes of workgroup memory",
            limits.max_compute_workgroup_storage_size,
            adapter.max_compute_workgroup_storage_size,
        ),
        (
            "threads in a workgroup",
            limits.max_compute_invocations_per_workgroup.max(limits.max_compute_workgroup_size_x),
            adapter.max_compute_invocations_per_workgroup.min(adapter.max_compute_workgroup_size_x),
        ),
    ];
    match needs.into_iter().find(|(_, needed, has)| has < needed) {
        Some((what, needed, has)) => Err(CoreError::NoAdapter(format!(
            "{name} allows {has} {what}, and training needs {needed}; update its driver, or use another GPU"
        ))),
        None => Ok(limits),
    }
}

/// Largest buffer that a kernel may bind, bytes. Shaders compute addresses in 32 bits, so a larger one would
/// be read and written at wrapped addresses without an error, whatever the adapter allows.
fn largest_binding(limits: &wgpu::Limits) -> u64 {
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size).min(u32::MAX.into())
}

/// A smaller limit leaves no room for any work; it was probably not meant as bytes.
const LEAST_MEMORY_LIMIT: u64 = 1 << 20;

/// Description of an adapter.
#[derive(Clone, Debug, PartialEq)]
pub struct AdapterSummary {
    /// Name reported by its driver.
    pub name: String,
    /// Driver and version.
    pub driver: String,
    /// vulkan, metal or dx12.
    pub backend: String,
    /// Whether it runs on the CPU.
    pub is_cpu: bool,
    /// Largest storage binding, bytes.
    pub max_binding_bytes: u64,
    /// Address on the PCI bus, which distinguishes equal GPUs of one machine; empty if the driver does not
    /// report it.
    pub pci_bus_id: String,
}

impl AdapterSummary {
    fn of(adapter: &wgpu::Adapter) -> Self {
        let info = adapter.get_info();
        Self {
            name: info.name,
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            backend: info.backend.to_string(),
            is_cpu: info.device_type == wgpu::DeviceType::Cpu,
            max_binding_bytes: adapter.limits().max_storage_buffer_binding_size,
            pci_bus_id: info.device_pci_bus_id,
        }
    }

    /// Whether both are certainly the same GPU of this machine, listed by two backends.
    pub fn is_same_gpu(&self, other: &Self) -> bool {
        let of_two_backends = self.backend != other.backend && self.name == other.name;
        match (self.pci_bus_id.as_str(), other.pci_bus_id.as_str()) {
            ("", _) | (_, "") => of_two_backends,
            (one, another) => one == another,
        }
    }
}

/// Adapters with their numbers in one line, for the error about a number that does not exist.
pub fn numbered(adapters: &[AdapterSummary]) -> String {
    let line = |(index, adapter): (usize, &AdapterSummary)| {
        let cpu = if adapter.is_cpu { ", on the CPU" } else { "" };
        format!("{index}: {} ({}{cpu})", adapter.name, adapter.backend)
    };
    adapters.iter().enumerate().map(line).collect::<Vec<_>>().join(", ")
}

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY;
    // Our own `count_*` kernels clamp indirect dispatches; wgpu's check would add a dispatch to each.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

fn all_adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    // Real GPUs first; otherwise in the driver's order.
    adapters.sort_by_key(|adapter| adapter.get_info().device_type == wgpu::DeviceType::Cpu);
    adapters
}

/// Lists all adapters of this machine, real GPUs first.
pub fn adapters() -> Vec<AdapterSummary> {
    all_adapters(&instance()).iter().map(AdapterSummary::of).collect()
}

/// The first device, including one on the CPU, for the test `what`. `None`, with a message on stderr, if
/// there is none.
///
/// # Panics
/// When there is an adapter but it cannot be opened, or when `FATHOM_TEST_REQUIRE_GPU=1` and there is no
/// adapter: a CI that has a driver must not pass without it.
pub fn device_for_test(what: &str) -> Option<Arc<Gpu>> {
    limited_device_for_test(what, None)
}

/// As [`device_for_test`], with a device of its own and [`GpuOptions::memory_limit`].
///
/// # Panics
/// As [`device_for_test`].
pub fn limited_device_for_test(what: &str, memory_limit: Option<u64>) -> Option<Arc<Gpu>> {
    match Gpu::new(GpuOptions { allow_cpu: true, memory_limit, ..Default::default() }) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(matches!(error, CoreError::NoAdapter(_)), "{what}: {error}");
            let required = std::env::var("FATHOM_TEST_REQUIRE_GPU").is_ok_and(|value| value == "1");
            assert!(!required, "FATHOM_TEST_REQUIRE_GPU=1, but {what} cannot run: {error}");
            // Not eprintln: the test harness captures its output in tests that pass.
            let _ = writeln!(std::io::stderr().lock(), "\nSKIPPED, NOTHING WAS TESTED: {what}: {error}");
            None
        }
    }
}

/// A device with its queue and kernels.
pub struct Gpu {
    summary: AdapterSummary,
    layout: TileLayout,
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    kernels: Kernels,
    timestamps: bool,
    shader_checks: bool,
    pub(super) faults: Arc<Faults>,
    pub(super) ledger: Ledger,
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`CoreError::NoAdapter`] with the package to install, or the flag that allows the CPU;
    /// [`CoreError::Config`] for a memory limit that cannot be enforced.
    pub fn new(options: GpuOptions) -> Result<Arc<Self>> {
        Self::open(options, None)
    }

    /// Opens a device with a given tile layout, so that one machine can test the layouts of others.
    ///
    /// # Errors
    /// As [`Gpu::new`]; also when the adapter lacks the subgroups that the layout needs.
    pub fn with_layout(options: GpuOptions, layout: TileLayout) -> Result<Arc<Self>> {
        Self::open(options, Some(layout))
    }

    fn open(options: GpuOptions, layout: Option<TileLayout>) -> Result<Arc<Self>> {
        if let Some(limit) = options.memory_limit.filter(|&limit| limit < LEAST_MEMORY_LIMIT) {
            return Err(CoreError::Config(format!(
                "a GPU memory limit of {limit} bytes leaves no room for any work; it is in bytes and at least \
                 {LEAST_MEMORY_LIMIT}; 8 GiB is 8589934592"
            )));
        }
        let instance = instance();
        let adapters = all_adapters(&instance);
        let adapter = choose(adapters, options)?;
        let summary = AdapterSummary::of(&adapter);
        let timestamps = adapter.features().contains(wgpu::Features::TIMESTAMP_QUERY);
        let info = adapter.get_info();
        let has = |features| adapter.features().contains(features);
        let subgroup_sizes = info.subgroup_min_size..=info.subgroup_max_size;
        let vectors_of_eight = has(wgpu::Features::SUBGROUP) && subgroup_sizes == (8..=8);
        // Shaders have room for 32 subgroups in 256 threads. wgpu reports 4 lanes for all of Metal, so Metal
        // uses the plain kernels.
        let subgroups =
            has(wgpu::Features::SUBGROUP) && *subgroup_sizes.start() >= 8 && *subgroup_sizes.end() <= 128;
        let layout = layout.unwrap_or(match (summary.is_cpu, vectors_of_eight) {
            (false, _) if subgroups => TileLayout::GPU,
            (false, _) => TileLayout::PLAIN_GPU,
            (true, true) => TileLayout::VECTOR,
            (true, false) => TileLayout::SMALL,
        });
        if (layout.vector && !vectors_of_eight) || (layout.subgroups && !subgroups) {
            return Err(CoreError::NoAdapter(format!(
                "{} has no subgroups of the required size",
                summary.name
            )));
        }
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::TIMESTAMP_QUERY, timestamps);
        features.set(wgpu::Features::SUBGROUP, layout.needs_subgroups());
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("fathom"),
            required_features: features,
            required_limits: limits_for_kernels(adapter.limits(), &summary.name)?,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| CoreError::Gpu(format!("cannot open {}: {error}", summary.name)))?;
        let faults = Faults::of(&device);
        if options.memory_limit.is_some() && device.generate_allocator_report().is_none() {
            return Err(CoreError::Config(format!(
                "a GPU memory limit cannot be enforced: {} does not report what is allocated on {}; \
                 omit --gpu-memory-limit",
                summary.backend, summary.name
            )));
        }
        if summary.is_cpu {
            tracing::warn!(adapter = %summary.name, "no GPU is used; this adapter runs on the CPU and is slow");
        }
        let ledger = Ledger::new(options.memory_limit);
        let kernels = Kernels::default();
        let shader_checks = options.shader_checks.unwrap_or(cfg!(debug_assertions));
        Ok(Arc::new(Self {
            summary,
            layout,
            kernels,
            device,
            queue,
            timestamps,
            shader_checks,
            faults,
            ledger,
        }))
    }

    /// The adapter of this device.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.summary
    }

    /// How tiles are laid out on this device.
    ///
    /// A CPU adapter runs a workgroup as vectors of eight lanes and cannot skip a branch that no lane takes.
    /// There a tile is therefore as small as one vector, and the sort does the skipping.
    pub fn layout(&self) -> TileLayout {
        self.layout
    }

    /// Side of a tile, pixels.
    pub fn tile(&self) -> u32 {
        self.layout.tile
    }

    /// The wgpu device.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The wgpu queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    pub(crate) fn kernels(&self) -> &Kernels {
        &self.kernels
    }

    /// Largest buffer that a kernel may bind, bytes.
    pub fn largest_binding(&self) -> u64 {
        largest_binding(&self.device.limits())
    }

    /// [`GpuOptions::shader_checks`], resolved.
    pub fn shader_checks(&self) -> bool {
        self.shader_checks
    }

    /// Whether dispatches can be timed.
    pub fn has_timestamps(&self) -> bool {
        self.timestamps
    }

    /// A zeroed buffer that some kernels read as a uniform and others write.
    ///
    /// # Errors
    /// [`CoreError::OutOfMemory`] when memory runs out.
    pub fn parameters(&self, label: &'static str, bytes: u64) -> Result<wgpu::Buffer> {
        let buffer = self.allocate(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.next_multiple_of(16).max(16),
            usage: wgpu::BufferUsages::UNIFORM
                | wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })?;
        self.check()?;
        Ok(buffer)
    }

    /// A zeroed storage buffer.
    ///
    /// # Errors
    /// [`CoreError::BufferTooLarge`] beyond the binding limit, [`CoreError::OutOfMemory`] when memory runs
    /// out.
    pub fn buffer(&self, label: &'static str, bytes: u64) -> Result<wgpu::Buffer> {
        // Releases replaced buffers before the new one is allocated.
        self.kernels.forget_bind_groups();
        self.streamed(label, bytes)
    }

    /// A zeroed storage buffer for data that comes and goes during training, such as a photograph. Bind
    /// groups stay.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub(crate) fn streamed(&self, label: &'static str, bytes: u64) -> Result<wgpu::Buffer> {
        let limit_bytes = self.largest_binding();
        if bytes > limit_bytes {
            return Err(CoreError::BufferTooLarge { buffer: label, needed_bytes: bytes, limit_bytes });
        }
        let buffer = self.allocate(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.next_multiple_of(16).max(16),
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST
                | wgpu::BufferUsages::INDIRECT,
            mapped_at_creation: false,
        })?;
        self.check()?;
        Ok(buffer)
    }

    /// An initialised uniform buffer. If memory runs out, [`Gpu::check`] reports it.
    pub fn uniform<T: bytemuck::Pod>(&self, label: &'static str, value: &T) -> wgpu::Buffer {
        let descriptor = wgpu::BufferDescriptor {
            label: Some(label),
            size: (size_of::<T>() as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT),
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            // Not mapped: wgpu's helper for initialised buffers panics when memory runs out.
            mapped_at_creation: false,
        };
        let buffer = self.allocate(&descriptor).unwrap_or_else(|error| {
            self.faults.report(error);
            self.create(&descriptor).0
        });
        self.write(&buffer, 0, std::slice::from_ref(value));
        buffer
    }

    /// Overwrites part of a buffer, from `offset` bytes on, before the next submission. If that fails,
    /// [`Gpu::check`] reports it.
    pub fn write<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer, offset: u64, values: &[T]) {
        let bytes = size_of_val(values) as u64;
        if bytes > 0 && self.may_stage(bytes) {
            self.queue.write_buffer(buffer, offset, bytemuck::cast_slice(values));
            self.staged(bytes);
        }
    }

    /// Reads `count` values from `offset` bytes on. Waits for all submitted work.
    ///
    /// # Errors
    /// When the device failed before or during the copy, or memory ran out.
    pub fn read<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer, offset: u64, count: usize) -> Result<Vec<T>> {
        let bytes = (count * size_of::<T>()) as u64;
        if bytes == 0 {
            return Ok(Vec::new());
        }
        let padded = bytes.next_multiple_of(4);
        let staging = self.allocate(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: padded,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })?;
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer, offset, &staging, 0, padded);
        self.queue.submit([encoder.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |outcome| {
            // The receiver lives until the wait below has ended.
            let _ = sender.send(outcome);
        });
        self.settle()?;
        // Another thread's wait may still be about to send.
        match receiver.recv() {
            Ok(Ok(())) => {}
            _ => return Err(CoreError::Gpu("a buffer could not be read back".into())),
        }
        let view = staging
            .get_mapped_range(..)
            .map_err(|error| CoreError::Gpu(format!("a buffer could not be read back: {error}")))?;
        let mut values = vec![T::zeroed(); count];
        bytemuck::cast_slice_mut::<T, u8>(&mut values).copy_from_slice(&view[..bytes as usize]);
        Ok(values)
    }

    /// Waits for all submitted work and all writes.
    ///
    /// # Errors
    /// When the device failed.
    pub fn wait(&self) -> Result<()> {
        // A write is not submitted on its own, and holds its staging buffer until it is.
        self.queue.submit([]);
        self.settle()
    }

    fn settle(&self) -> Result<()> {
        self.poll(wgpu::PollType::wait_indefinitely())?;
        self.ledger.nothing_is_staged();
        self.check()
    }
}

fn choose(mut adapters: Vec<wgpu::Adapter>, options: GpuOptions) -> Result<wgpu::Adapter> {
    if adapters.is_empty() {
        return Err(CoreError::NoAdapter(
            "no Vulkan, Metal or DX12 adapter was found; on Debian install the GPU's driver, \
             or mesa-vulkan-drivers and libvulkan1 to run on the CPU with --allow-cpu"
                .into(),
        ));
    }
    if let Some(index) = options.index {
        if index >= adapters.len() {
            return Err(CoreError::NoAdapter(format!(
                "there is no adapter {index}; this machine has {}",
                numbered(&adapters.iter().map(AdapterSummary::of).collect::<Vec<_>>())
            )));
        }
        let adapter = adapters.swap_remove(index);
        if adapter.get_info().device_type == wgpu::DeviceType::Cpu && !options.allow_cpu {
            return Err(CoreError::NoAdapter(format!(
                "adapter {index} ({}) runs on the CPU and is slow; use --allow-cpu to accept it",
                adapter.get_info().name
            )));
        }
        return Ok(adapter);
    }
    let first = adapters.swap_remove(0);
    if first.get_info().device_type == wgpu::DeviceType::Cpu && !options.allow_cpu {
        return Err(CoreError::NoAdapter(format!(
            "the only adapter ({}) runs on the CPU and is slow; use --allow-cpu to accept it, \
             or install the driver of your GPU",
            first.get_info().name
        )));
    }
    Ok(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_binding_is_larger_than_addresses_of_32_bits_reach() {
        let of = |binding, buffer| {
            largest_binding(&wgpu::Limits {
                max_storage_buffer_binding_size: binding,
                max_buffer_size: buffer,
                ..Default::default()
            })
        };
        assert_eq!(of(128 << 20, 1 << 31), 128 << 20);
        assert_eq!(of(1 << 40, 1 << 40), u64::from(u32::MAX), "a word beyond it would be word 0");
        assert_eq!(of(1 << 40, 1 << 30), 1 << 30);
    }

    #[test]
    fn adapters_that_lack_what_kernels_need_are_refused_by_name() {
        let least =
            wgpu::Limits { max_storage_buffers_per_shader_stage: STORAGE_BUFFERS, ..Default::default() };
        assert_eq!(limits_for_kernels(least.clone(), "A").ok(), Some(least.clone()));
        let more = wgpu::Limits {
            max_compute_workgroup_storage_size: 65_536,
            max_buffer_size: 1 << 40,
            ..least.clone()
        };
        let opened = limits_for_kernels(more, "A").expect("more is no less");
        assert_eq!((opened.max_compute_workgroup_storage_size, opened.max_buffer_size), (16_384, 1 << 40));
        let refused =
            |limits| limits_for_kernels(limits, "Old GPU").expect_err("it lacks something").to_string();
        let few = wgpu::Limits::default();
        assert!(refused(few).contains("Old GPU allows 8 storage buffers in a shader, and training needs 10"));
        let little = wgpu::Limits { max_compute_workgroup_storage_size: 8192, ..least.clone() };
        assert!(refused(little).contains("8192 bytes of workgroup memory"));
        let narrow = wgpu::Limits { max_compute_workgroup_size_x: 128, ..least };
        assert!(refused(narrow).contains("128 threads in a workgroup"));
    }
}
