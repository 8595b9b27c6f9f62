//! View embeddings on the device (FiLM, SMP-UWGS eq. 10): colour factors of a training view, between the
//! underwater render and the loss.
//!
//! Underwater photographs differ in light and in drifting particles. Gaussians that have to explain these
//! differences become veils. Each training view has an embedding: a scale and a shift for each hidden unit of
//! a small predictor shared by all views (`shaders/shared/film.wgsl`). A linear layer between embedding and
//! these values would add no expressiveness. The predictor maps the mean colour of a cell of pixels to
//! factors on its colours. It has no batch norm, because a batch is one view. Factors may be above or below
//! 1; the sigmoid of the released code only darkens.
//!
//! The output of a unit without an embedding is subtracted, so a zero embedding is the identity for any
//! weights. Held-out views and exports use the zero embedding. The mean of all embeddings is kept at 0, as
//! the mean exposure is kept at the identity. What all views have in common, such as the brightness of J and
//! the water, thus stays in the model, up to second order in the embeddings. The bound on the factors keeps
//! that order small.

use crate::appearance::adam::{interpolate_log, unbiasing};
use crate::appearance::chain::{Appearance, Gradients, Iteration, Start};
use crate::appearance::exposure::Exposures;
use crate::config::FilmConfig;
use crate::gpu::{FilmUniform, Frame, Gpu, Recorder, Size};
use crate::rng::{Stream, uniform_at};
use crate::{CoreError, Result};

/// Hidden units of the predictor (`shaders/shared/film.wgsl`).
pub const FILM_UNITS: usize = 16;
/// Decay of the Adam moments, of the weights and of the embeddings (`film_step.wgsl`).
const BETAS: [f64; 2] = [0.9, 0.999];
const VIEW_BETAS: [f64; 2] = [0.8, 0.99];

/// Scale and shift of each hidden unit.
pub type FilmEmbedding = [[f32; 2]; FILM_UNITS];

/// One iteration's part of the schedule.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilmStep {
    /// Index of the view.
    pub view: u32,
    /// Width and height of the picture, pixels.
    pub size: [u32; 2],
    /// Learning rate of Adam; `None` without a step.
    pub rate: Option<f32>,
    /// Number of weight steps including this one, from 1.
    pub steps: u32,
    /// Number of steps of the view's embedding including this one, from 1.
    pub view_steps: u32,
}

/// The view embeddings of a run.
pub struct Film {
    views: u32,
    config: FilmConfig,
    uniform: wgpu::Buffer,
    weights: wgpu::Buffer,
    embeddings: wgpu::Buffer,
    moments: wgpu::Buffer,
    sized: Option<Sized>,
}

struct Sized {
    pixels: u64,
    cells: u64,
    filmed: wgpu::Buffer,
    means: wgpu::Buffer,
    maps: wgpu::Buffer,
    v_cells: wgpu::Buffer,
}

impl Film {
    /// Zero embeddings for `views` views, and weights determined by `seed`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn new(gpu: &Gpu, config: &FilmConfig, views: u32, seed: u32) -> Result<Self> {
        let numbers = 2 * FILM_UNITS as u64;
        let film = Self {
            views,
            config: config.clone(),
            uniform: gpu.uniform("film", &FilmUniform::default()),
            weights: gpu.buffer("film weights", 3 * numbers * 16)?,
            embeddings: gpu.buffer("film embeddings", u64::from(views) * numbers * 4)?,
            moments: gpu.buffer("film moments", u64::from(views) * numbers * 8)?,
            sized: None,
        };
        gpu.write(&film.weights, 0, &first_weights(seed));
        Ok(film)
    }

    /// Numbers of cells across and down a picture of `size`.
    pub fn cells(&self, size: [u32; 2]) -> [u32; 2] {
        let cell = self.config.cell.max(1);
        size.map(|side| ((side + cell / 2) / cell).max(1))
    }

    /// The step of an iteration. Steps begin at the start of an epoch, in which each view is used once.
    fn step_at(&self, now: &Iteration<'_>) -> FilmStep {
        let step =
            FilmStep { view: now.view, size: now.photograph.size, rate: None, steps: 0, view_steps: 0 };
        let (film, views) = (&self.config, now.views.max(1));
        let first = (f64::from(film.from) * f64::from(now.iterations)).ceil() as u32;
        let first = first.next_multiple_of(views);
        let progress = now.progress();
        if now.number < first || progress >= film.until {
            return step;
        }
        let share = (progress - film.from) / (film.until - film.from).max(1e-6);
        let rate = interpolate_log(film.lr, film.lr_end, share.clamp(0.0, 1.0));
        let done = now.number - first;
        FilmStep { rate: Some(rate), steps: done + 1, view_steps: done / views + 1, ..step }
    }

    /// Allocates buffers for pictures of `size`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let area = |[width, height]: [u32; 2]| u64::from(width) * u64::from(height);
        let (mut pixels, mut cells) = (area(size), area(self.cells(size)));
        if let Some(sized) = &self.sized {
            if sized.pixels >= pixels && sized.cells >= cells {
                return Ok(());
            }
            (pixels, cells) = (pixels.max(sized.pixels), cells.max(sized.cells));
        }
        self.sized = None;
        self.sized = Some(Sized {
            pixels,
            cells,
            filmed: gpu.buffer("filmed", pixels * 16)?,
            means: gpu.buffer("film means", cells * 16)?,
            maps: gpu.buffer("film maps", cells * 16)?,
            v_cells: gpu.buffer("film v_cells", cells * 32)?,
        });
        Ok(())
    }

    fn sized(&self) -> Result<&Sized> {
        self.sized.as_ref().ok_or_else(|| {
            CoreError::Gpu("a view embedding was recorded before its buffers were made".into())
        })
    }

    /// Records the factors on the picture `image`; returns the picture for the loss, `[H*W]` vec4: rgb,
    /// alpha.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        image: &wgpu::Buffer,
        step: FilmStep,
    ) -> Result<&wgpu::Buffer> {
        let sized = self.sized()?;
        let [unbias1, unbias2] = unbiasing(BETAS, step.steps).map(|value| value as f32);
        let [view_unbias1, view_unbias2] = unbiasing(VIEW_BETAS, step.view_steps).map(|value| value as f32);
        let rate = step.rate.unwrap_or(0.0);
        let uniform = FilmUniform {
            size: step.size,
            cells: self.cells(step.size),
            view: step.view,
            views: self.views,
            rate,
            unbias1,
            unbias2,
            view_rate: Exposures::lr_scale(self.views as usize) * rate,
            view_unbias1,
            view_unbias2,
        };
        gpu.write(&self.uniform, 0, &[uniform]);
        let (film, maps) = (("film", &self.uniform), ("maps", &sized.maps));
        let [columns, rows] = uniform.cells;
        recorder.dispatch(
            "film_cells",
            Size::Groups(columns * rows),
            &[
                film,
                ("weights", &self.weights),
                ("embeddings", &self.embeddings),
                ("image", image),
                ("means", &sized.means),
                maps,
            ],
        )?;
        recorder.dispatch(
            "film",
            Size::Items(step.size[0] * step.size[1], 64),
            &[film, maps, ("image", image), ("filmed", &sized.filmed)],
        )?;
        Ok(&sized.filmed)
    }

    /// Records the backward pass of [`Film::record`], and the step if the schedule has one. Nothing is
    /// stepped if `counters` report an overflowing list. `v_image` holds the gradient of the output of
    /// [`Film::record`] before, and of `image` after.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        image: &wgpu::Buffer,
        v_image: &wgpu::Buffer,
        counters: &wgpu::Buffer,
        step: FilmStep,
    ) -> Result<()> {
        let sized = self.sized()?;
        let (film, maps) = (("film", &self.uniform), ("maps", &sized.maps));
        let (weights, embeddings) = (("weights", &self.weights), ("embeddings", &self.embeddings));
        let (means, v_cells) = (("means", &sized.means), ("v_cells", &sized.v_cells));
        let [columns, rows] = self.cells(step.size);
        recorder.dispatch(
            "film_cells_backward",
            Size::Groups(columns * rows),
            &[film, weights, embeddings, ("image", image), ("v_image", v_image), means, maps, v_cells],
        )?;
        recorder.dispatch(
            "film_backward",
            Size::Items(step.size[0] * step.size[1], 64),
            &[film, maps, v_cells, ("v_image", v_image)],
        )?;
        if step.rate.is_none() {
            return Ok(());
        }
        let moments = ("moments", &self.moments);
        recorder.dispatch(
            "film_step",
            Size::Groups(FILM_UNITS as u32),
            &[film, ("counters", counters), means, v_cells, weights, embeddings, moments],
        )
    }

    /// Buffers that are always written before they are read; tests fill them with garbage first.
    ///
    /// # Errors
    /// When `prepare` was not called.
    pub fn scratch(&self) -> Result<[&wgpu::Buffer; 4]> {
        let sized = self.sized()?;
        Ok([&sized.filmed, &sized.means, &sized.maps, &sized.v_cells])
    }

    /// The arrays that persist across iterations, with their bytes: `[32*3]` vec4, weights and their moments;
    /// `[views*16]` vec2, embeddings; `[views*32]` vec2, their moments.
    pub fn arrays(&self) -> [(&wgpu::Buffer, usize); 3] {
        let numbers = 2 * FILM_UNITS;
        let views = self.views as usize;
        [
            (&self.weights, 3 * numbers * 16),
            (&self.embeddings, views * numbers * 4),
            (&self.moments, views * numbers * 8),
        ]
    }

    /// The embedding of each view.
    ///
    /// # Errors
    /// When the device fails.
    pub fn embeddings(&self, gpu: &Gpu) -> Result<Vec<FilmEmbedding>> {
        gpu.read(&self.embeddings, 0, self.views as usize)
    }

    /// The weights of each unit: for its mean colour and its bias, then for its factors, and 0.
    ///
    /// # Errors
    /// When the device fails.
    pub fn weights(&self, gpu: &Gpu) -> Result<Vec<[[f32; 4]; 2]>> {
        gpu.read(&self.weights, 0, FILM_UNITS)
    }
}

impl Appearance for Film {
    fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        self.prepare(gpu, size)
    }

    fn record<'a>(
        &'a self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &'a wgpu::Buffer,
    ) -> Result<&'a wgpu::Buffer> {
        self.record(now.gpu, recorder, image, self.step_at(now))
    }

    fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &wgpu::Buffer,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        self.record_backward(recorder, image, gradients.v_image, &now.frame.counters, self.step_at(now))
    }

    fn arrays<'a>(&'a self, _frame: &'a Frame) -> Vec<(&'a wgpu::Buffer, usize)> {
        self.arrays().to_vec()
    }
}

/// The embeddings of a run whose water uses them.
///
/// # Errors
/// When the run has no water, or the device cannot hold them.
pub(super) fn start(start: &Start<'_>) -> Result<Box<dyn Appearance>> {
    let (_, water) =
        start.settings.water.ok_or_else(|| CoreError::Config("view embeddings need a water".to_owned()))?;
    let film = Film::new(start.gpu, &water.film, start.views, start.settings.train.seed)?;
    Ok(Box::new(film))
}

/// Initial weights: uniform with the width of He et al. (2015) for ReLU units. Biases range from 0 to 0.5, so
/// that most units are active on dark pictures too.
fn first_weights(seed: u32) -> Vec<[[f32; 4]; 2]> {
    let wide = |inputs: f32| (6.0 / inputs).sqrt();
    let u = |unit: usize, k: u32| uniform_at(seed, Stream::Film, unit as u32, k);
    let even = |unit, k| 2.0 * u(unit, k) - 1.0;
    let unit = |unit| {
        let first = [0, 1, 2].map(|k| wide(3.0) * even(unit, k));
        let second = [3, 4, 5].map(|k| wide(FILM_UNITS as f32) * even(unit, k));
        [[first[0], first[1], first[2], 0.5 * u(unit, 6)], [second[0], second[1], second[2], 0.0]]
    };
    (0..FILM_UNITS).map(unit).collect()
}
