//! The GPU: adapter and device, and rendering of a model.

use std::sync::Arc;

use crate::gaussians::Gaussians;
use crate::scene::{PinholeCamera, Pose};
use crate::{CoreError, Result};

/// Which adapter may be used.
#[derive(Clone, Copy, Debug, Default)]
pub struct GpuOptions {
    /// Index among the adapters that `adapters` lists; `None` takes the first real GPU.
    pub index: Option<usize>,
    /// Whether an adapter that runs on the CPU (lavapipe) may be used when there is no GPU.
    pub allow_cpu: bool,
}

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
}

/// All adapters of this machine.
pub fn adapters() -> Vec<AdapterSummary> {
    Vec::new()
}

/// A device with its queue and pipelines.
pub struct Gpu {}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`CoreError::NoAdapter`] with the package to install, or the flag that allows the CPU.
    pub fn new(_options: GpuOptions) -> Result<Arc<Self>> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// What this device runs on.
    pub fn adapter(&self) -> &AdapterSummary {
        unreachable!("being written")
    }
}

/// A rendered view. Arrays are row-major from the top left.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colour over the background, as trained (sRGB for `3dgs`), unclamped.
    pub rgb: Vec<[f32; 3]>,
    /// 1 - transmittance left.
    pub alpha: Vec<f32>,
    /// Sum of weight times distance along the ray, scene units; divide by alpha for the expected range.
    pub range: Vec<f32>,
}

/// Renders one model from any camera.
pub struct Renderer {}

impl Renderer {
    /// Uploads a model.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(_gpu: Arc<Gpu>, _model: &Gaussians) -> Result<Self> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// Renders over `background`.
    ///
    /// # Errors
    /// When the device fails or the picture is larger than it can bind.
    pub fn render(
        &mut self,
        _camera: &PinholeCamera,
        _pose: &Pose,
        _background: [f32; 3],
    ) -> Result<Rendered> {
        Err(CoreError::Gpu("being written".into()))
    }
}
