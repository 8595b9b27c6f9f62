//! A trained model on disk: a result folder of `fathom train`, or a PLY alone.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use fathom_core::axes;
use fathom_core::config::DataConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{AdapterSummary, Gpu, GpuOptions, SurfaceRenderer, adapters};
use fathom_core::ply;
use fathom_core::surface::SurfaceModel;
use glam::DQuat;

use crate::error::{CliError, Result};
use crate::output;

/// The adapter for training and rendering, and its memory limit.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct GpuArgs {
    /// Adapter number, as listed by `fathom doctor` [default: the first real GPU]
    #[arg(long, value_name = "N", env = "FATHOM_GPU")]
    pub gpu: Option<usize>,
    /// Allow a CPU adapter when there is no GPU: correct but slow
    #[arg(long, env = "FATHOM_ALLOW_CPU", value_parser = clap::builder::FalseyValueParser::new(), num_args = 0, default_missing_value = "true")]
    pub allow_cpu: Option<bool>,
    /// GPU memory limit of each process of this program, bytes [default: all of it]
    #[arg(long, value_name = "BYTES", env = "FATHOM_GPU_MEMORY_LIMIT")]
    #[arg(value_parser = clap::value_parser!(u64).range(1..))]
    pub gpu_memory_limit: Option<u64>,
}

impl GpuArgs {
    /// Options of the trainer and the renderer.
    pub fn options(&self) -> GpuOptions {
        GpuOptions {
            index: self.gpu,
            allow_cpu: self.allow_cpu.unwrap_or(false),
            memory_limit: self.gpu_memory_limit,
            ..GpuOptions::default()
        }
    }

    /// Opens the adapter; warns if it runs on the CPU.
    pub fn open(&self) -> Result<std::sync::Arc<Gpu>> {
        Ok(Gpu::new(self.options())?)
    }

    /// The adapters for `workers` workers on one machine: real GPUs, round robin.
    ///
    /// # Errors
    /// When no adapter may be used; reported here rather than in every worker's log.
    pub fn share_out(&self, workers: u32) -> Result<Vec<Option<usize>>> {
        if self.gpu.is_some() {
            return Ok(vec![self.gpu; workers as usize]);
        }
        let is_real = |(index, adapter): (usize, AdapterSummary)| (!adapter.is_cpu).then_some(index);
        let real: Vec<usize> = adapters().into_iter().enumerate().filter_map(is_real).collect();
        if real.is_empty() {
            Gpu::new(self.options())?;
            return Ok(vec![None; workers as usize]);
        }
        Ok((0..workers as usize).map(|worker| Some(real[worker % real.len()])).collect())
    }
}

/// `model.ply` of a result folder, or the file itself.
pub fn model_path(given: &Path) -> Result<PathBuf> {
    if given.is_dir() {
        let path = given.join("model.ply");
        if path.is_file() {
            return Ok(path);
        }
        return Err(CliError::Message(format!(
            "{} has no model.ply; give a finished result folder of `fathom train` or `fathom download`, or a \
             PLY",
            given.display()
        )));
    }
    Ok(given.to_owned())
}

/// Renders a result through its water surface, from the folder `sets` beside its model; `None` if it has
/// none.
///
/// # Errors
/// When the sets cannot be read, or the device cannot hold them.
pub fn surface_renderer(gpu: &Arc<Gpu>, model: &Path) -> Result<Option<SurfaceRenderer>> {
    let sets = model.with_file_name("sets");
    if !sets.is_dir() {
        return Ok(None);
    }
    Ok(Some(SurfaceRenderer::new(Arc::clone(gpu), &SurfaceModel::read_sets(&sets)?)?))
}

/// Prefix of the PLY comment of a model exported with a white point; its JSON follows.
pub const WHITE_POINT: &str = "fathom_white_point ";
/// PLY comment of a model with colours in linear light, which no verb renders correctly.
pub const LINEAR_COLOURS: &str = "colours are in linear light, their harmonics refitted from sRGB";

/// Reads the Gaussians in scene axes, whichever axes they were exported in.
pub fn load(path: &Path) -> Result<Gaussians> {
    refuse_linear(path)?;
    let model = ply::read_model(path)?;
    Ok(match axes::among(ply::SplatReader::open(path)?.comments())? {
        Some(to_model) => axes::turned(model, to_model.inverse()),
        None => model,
    })
}

/// The rotation from scene axes to plan axes, from the `plan.json` beside a model.
pub fn alignment(model: &Path) -> Result<DQuat> {
    let path = model.with_file_name("plan.json");
    if !path.is_file() {
        return Err(CliError::Message(format!(
            "{} does not exist; it holds the scene's alignment. Give the result folder of `fathom train` or \
             `fathom download`",
            path.display()
        )));
    }
    let plan = output::read_json(&path)?;
    let quat = plan.pointer("/alignment/world_to_aligned_quat_wxyz").cloned().unwrap_or_default();
    let rotation =
        serde_json::from_value::<[f64; 4]>(quat).ok().map(|[w, x, y, z]| DQuat::from_xyzw(x, y, z, w));
    let is_unit = |rotation: &DQuat| (rotation.length() - 1.0).abs() < 1e-6;
    rotation.filter(is_unit).ok_or_else(|| {
        CliError::Message(format!("{} has no alignment; was it written by this program?", path.display()))
    })
}

/// Refuses a model that `fathom export` wrote with a white point: its colours are for viewing and no longer
/// J. `to` names the use that is refused.
pub fn refuse_white_point(path: &Path, to: &str) -> Result<()> {
    if ply::SplatReader::open(path)?.comments().iter().any(|comment| comment.starts_with(WHITE_POINT)) {
        return Err(CliError::Message(format!(
            "{} was exported with a white point, for viewing, and is not {to}; give the model that it was \
             exported from",
            path.display()
        )));
    }
    Ok(())
}

/// Refuses a model written by `fathom export --export-colour linear`.
pub fn refuse_linear(path: &Path) -> Result<()> {
    if ply::SplatReader::open(path)?.comments().iter().any(|comment| comment == LINEAR_COLOURS) {
        return Err(CliError::Message(format!(
            "{} was exported with colours in linear light, for other programs; give the model that it was \
             exported from",
            path.display()
        )));
    }
    Ok(())
}

/// `data` of the configuration in a result folder's `run.json`; `None` for a PLY alone.
pub fn data_config(given: &Path) -> Result<Option<DataConfig>> {
    let path = given.join("run.json");
    if !path.is_file() {
        return Ok(None);
    }
    let run = output::read_json(&path)?;
    let data = run.pointer("/config/data").cloned().ok_or_else(|| {
        CliError::Message(format!("{} has no config.data; was it written by this program?", path.display()))
    })?;
    serde_json::from_value(data)
        .map(Some)
        .map_err(|error| CliError::Message(format!("{}: config.data: {error}", path.display())))
}
