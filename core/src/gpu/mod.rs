//! The GPU: adapter and device, compute kernels, and rendering of a model.
//!
//! Everything is compute shaders of `shaders/`, one kernel per file. Bindings are found by name, reflected
//! from the WGSL by naga, so a mismatch between a kernel and its call is an error.

mod blocks;
mod bounds;
mod device;
mod faults;
mod frame;
mod kernel;
mod layout;
mod limits;
mod memory;
mod photograph;
mod render;
mod seams;
mod sort;
mod surface;
mod workload;

pub use blocks::{BLOCK_CAPACITY, Block, BlockTraining, Blocks, block_capacity, sh_stride};
pub use bounds::{CULL_CHUNK, spatial_order};
pub use device::{
    AdapterSummary, Gpu, GpuOptions, STORAGE_BUFFERS, adapters, device_for_test, limited_device_for_test,
    numbered,
};
pub use frame::{Frame, FrameTargets, SurfaceRays};
pub use kernel::{
    Kernel, KernelTime, Recorder, Size, TileLayout, kernel_names, kernel_variants, shader_source,
};
pub(crate) use layout::water_rows;
pub use layout::{
    BlockUniform, DbdrState, DbdrUniform, ExposureUniform, FilmUniform, FrameUniform, LossUniform,
    MaskLossUniform, MediumUniform, NormalsUniform, PriorsUniform, StepUniform, SurfaceState,
    SurfaceStepUniform, SurfaceUniform, WaterState, WaterUniform, counter, medium,
};
pub use limits::{ListLimits, Overflow};
pub use memory::{DeviceMemory, Spare};
pub use photograph::{DeviceMap, DevicePhotograph};
pub use render::{Drawing, Output, Rendered, Renderer, WaterView};
pub use seams::SeamRun;
pub use sort::{Scan, Sort};
pub use surface::{SurfaceOutput, SurfaceRenderer};
pub use workload::Workload;
