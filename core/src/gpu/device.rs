//! Adapter, device, buffers and reading back.

use std::io::Write as _;
use std::sync::Arc;

use super::faults::Faults;
use super::kernel::{Kernels, TileLayout};
use super::memory::Ledger;
use crate::{CoreError, Result};

/// Which adapter may be used, and how much of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct GpuOptions {
    /// Index among the adapters that [`adapters`] lists; `None` takes the first real GPU.
    pub index: Option<usize>,
    /// Whether an adapter that runs on the CPU (lavapipe) may be used when there is no GPU.
    pub allow_cpu: bool,
    /// Most memory that may be allocated at once, bytes, for who shares a GPU and for tests; beyond it
    /// allocation fails as on a device that has no more. The driver's blocks, of which it is cut, may hold
    /// some more ([`DeviceMemory::reserved_bytes`](super::DeviceMemory::reserved_bytes)). `None`, the
    /// default, is as much as the driver gives.
    pub memory_limit: Option<u64>,
    /// Whether shaders check every index and every loop at run time. `None`, the default: as `debug_assert`
    /// does, in debug builds only. All shaders are this crate's own, and `core/tests/kernels` proves them the
    /// same with and without.
    pub shader_checks: Option<bool>,
}

/// Below this, nothing can be done at all: a number that was not meant as bytes.
const LEAST_MEMORY_LIMIT: u64 = 1 << 20;

/// What an adapter is.
#[derive(Clone, Debug, PartialEq)]
pub struct AdapterSummary {
    /// Name by its driver.
    pub name: String,
    /// Driver and version.
    pub driver: String,
    /// vulkan, metal or dx12.
    pub backend: String,
    /// Whether it runs on the CPU.
    pub is_cpu: bool,
    /// Largest storage binding, bytes.
    pub max_binding_bytes: u64,
    /// Where it is on the bus, which tells equal GPUs of one machine apart; empty where the driver does not
    /// say.
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

    /// Whether both are certainly one GPU of this machine, which two backends may list each.
    pub fn is_same_gpu(&self, other: &Self) -> bool {
        let of_two_backends = self.backend != other.backend && self.name == other.name;
        match (self.pci_bus_id.as_str(), other.pci_bus_id.as_str()) {
            ("", _) | (_, "") => of_two_backends,
            (one, another) => one == another,
        }
    }
}

/// Adapters with their numbers, in one line, for those who named one that is not there.
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
    // Indirect dispatches are clamped by our own `count_*` kernels; wgpu's check would add a dispatch to
    // each.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

fn all_adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    // Real GPUs first; the order within is the driver's.
    adapters.sort_by_key(|adapter| adapter.get_info().device_type == wgpu::DeviceType::Cpu);
    adapters
}

/// All adapters of this machine, real GPUs first.
pub fn adapters() -> Vec<AdapterSummary> {
    all_adapters(&instance()).iter().map(AdapterSummary::of).collect()
}

/// The first device, also one on the CPU, for the test `what`; `None` where there is none, which stderr is
/// told.
///
/// # Panics
/// When there is an adapter and it cannot be opened. With `FATHOM_TEST_REQUIRE_GPU=1` there must be one: a CI
/// that has a driver must not pass without it.
pub fn device_for_test(what: &str) -> Option<Arc<Gpu>> {
    limited_device_for_test(what, None)
}

/// As [`device_for_test`], a device of its own with [`GpuOptions::memory_limit`].
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
            // Not eprintln: the harness keeps what passing tests say with it to itself.
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
    /// [`CoreError::Config`] for a memory limit that cannot be kept.
    pub fn new(options: GpuOptions) -> Result<Arc<Self>> {
        Self::open(options, None)
    }

    /// Opens a device with a given layout of tiles, so that one machine can test the layouts of others.
    ///
    /// # Errors
    /// As [`Gpu::new`]; also when the adapter has no subgroups of the kind that the layout needs.
    pub fn with_layout(options: GpuOptions, layout: TileLayout) -> Result<Arc<Self>> {
        Self::open(options, Some(layout))
    }

    fn open(options: GpuOptions, layout: Option<TileLayout>) -> Result<Arc<Self>> {
        if let Some(limit) = options.memory_limit.filter(|&limit| limit < LEAST_MEMORY_LIMIT) {
            return Err(CoreError::Config(format!(
                "a limit of {limit} bytes of the GPU's memory leaves no room for any work; it is in bytes and at least \
                 {LEAST_MEMORY_LIMIT}, 8 GiB are 8589934592"
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
        // Of 256 threads, shaders have room for 32 subgroups. wgpu says 4 lanes for all of Metal, so it has
        // the plain forms.
        let subgroups =
            has(wgpu::Features::SUBGROUP) && *subgroup_sizes.start() >= 8 && *subgroup_sizes.end() <= 128;
        let layout = layout.unwrap_or(match (summary.is_cpu, vectors_of_eight) {
            (false, _) if subgroups => TileLayout::GPU,
            (false, _) => TileLayout::PLAIN_GPU,
            (true, true) => TileLayout::VECTOR,
            (true, false) => TileLayout::SMALL,
        });
        if (layout.vector && !vectors_of_eight) || (layout.subgroups && !subgroups) {
            return Err(CoreError::NoAdapter(format!("{} has no subgroups of that kind", summary.name)));
        }
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::TIMESTAMP_QUERY, timestamps);
        features.set(wgpu::Features::SUBGROUP, layout.needs_subgroups());
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("fathom"),
            required_features: features,
            required_limits: adapter.limits(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| CoreError::Gpu(format!("cannot open {}: {error}", summary.name)))?;
        let faults = Faults::of(&device);
        if options.memory_limit.is_some() && device.generate_allocator_report().is_none() {
            return Err(CoreError::Config(format!(
                "a limit of GPU memory cannot be kept: {} does not say what is allocated on {}; \
                 leave --gpu-memory-limit out",
                summary.backend, summary.name
            )));
        }
        if summary.is_cpu {
            tracing::warn!(adapter = %summary.name, "no GPU is used: this adapter runs on the CPU and is slow");
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

    /// What this device runs on.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.summary
    }

    /// How tiles are laid out here.
    ///
    /// A CPU adapter runs a workgroup as vectors of eight lanes and cannot skip a branch that no lane takes,
    /// so there a tile is what one vector holds, and the sort does the skipping.
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

    /// [`GpuOptions::shader_checks`], resolved.
    pub fn shader_checks(&self) -> bool {
        self.shader_checks
    }

    /// Whether dispatches can be timed.
    pub fn has_timestamps(&self) -> bool {
        self.timestamps
    }

    /// A zeroed buffer that kernels read as a uniform and others write.
    ///
    /// # Errors
    /// [`CoreError::OutOfMemory`] where there is no room.
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
    /// [`CoreError::BufferTooLarge`] beyond the binding limit, [`CoreError::OutOfMemory`] where there is no
    /// room.
    pub fn buffer(&self, label: &'static str, bytes: u64) -> Result<wgpu::Buffer> {
        // What was replaced by now is given back before there is something new.
        self.kernels.forget_bind_groups();
        self.streamed(label, bytes)
    }

    /// A zeroed storage buffer for what comes and goes while a run trains, such as a photograph. Bind groups
    /// stay.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub(crate) fn streamed(&self, label: &'static str, bytes: u64) -> Result<wgpu::Buffer> {
        let limits = self.device.limits();
        let limit_bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
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

    /// A uniform buffer with content. Where there is no room for it, [`Gpu::check`] will say so.
    pub fn uniform<T: bytemuck::Pod>(&self, label: &'static str, value: &T) -> wgpu::Buffer {
        let descriptor = wgpu::BufferDescriptor {
            label: Some(label),
            size: (size_of::<T>() as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT),
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            // Not mapped: wgpu's helper for buffers with content panics where there is no room.
            mapped_at_creation: false,
        };
        let buffer = self.allocate(&descriptor).unwrap_or_else(|error| {
            self.faults.report(error);
            self.create(&descriptor).0
        });
        self.write(&buffer, 0, std::slice::from_ref(value));
        buffer
    }

    /// Overwrites the beginning of a buffer before the next submission. Where that fails, [`Gpu::check`] will
    /// say so.
    pub fn write<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer, offset: u64, values: &[T]) {
        let bytes = size_of_val(values) as u64;
        if bytes > 0 && self.may_stage(bytes) {
            self.queue.write_buffer(buffer, offset, bytemuck::cast_slice(values));
            self.staged(bytes);
        }
    }

    /// Reads `count` values from `offset` bytes on; waits for all submitted work.
    ///
    /// # Errors
    /// When the device failed before or during the copy, or has no room for it.
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
            // The receiver lives until the wait below is over.
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
        // A write alone is not submitted, and holds its staging buffer until it is.
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
                "adapter {index} ({}) runs on the CPU and is slow; say --allow-cpu to use it all the same",
                adapter.get_info().name
            )));
        }
        return Ok(adapter);
    }
    let first = adapters.swap_remove(0);
    if first.get_info().device_type == wgpu::DeviceType::Cpu && !options.allow_cpu {
        return Err(CoreError::NoAdapter(format!(
            "the only adapter ({}) runs on the CPU and is slow; say --allow-cpu to use it all the same, \
             or install the driver of your GPU",
            first.get_info().name
        )));
    }
    Ok(first)
}
