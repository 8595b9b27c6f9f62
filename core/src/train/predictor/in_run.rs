//! How a run uses WaterParamPredict: when it predicts, from what, and how the prediction becomes the water.

use std::sync::Arc;

use super::{Prediction, Seen};
use crate::Result;
use crate::config::NetworkConfig;
use crate::gpu::{FrameUniform, Gpu, Recorder};
use crate::nets::DepthMap;
use crate::train::start::able_to_move;
use crate::train::{Gathered, Trainer};
use crate::water::Water;

/// Largest number of views to predict for at the end: enough to measure their spread.
const MOST_VIEWS: usize = 64;

/// The prediction for the view of the iteration being recorded.
pub(in crate::train) struct AtOnce {
    seen: Seen,
    depth: DepthMap,
}

impl Trainer {
    /// First iteration after the next one at whose start the network has work to do.
    pub(in crate::train) fn next_prediction(&self) -> u32 {
        self.predictor.as_ref().map_or(u32::MAX, |predictor| predictor.next_due(self.iteration))
    }

    /// Runs the work of the network that is due at this iteration; the device is idle before.
    pub(in crate::train) fn predict_water(&mut self) -> Result<()> {
        let Some(predictor) = &self.predictor else { return Ok(()) };
        if self.iteration >= predictor.end { self.decide_water() } else { self.exchange_with_network() }
    }

    /// The work between two predictions.
    fn exchange_with_network(&mut self) -> Result<()> {
        let gpu = Arc::clone(&self.gpu);
        let key = self.view_of(self.iteration - 1);
        let seen = self.read_seen(self.picture_of(key).size)?;
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(());
        };
        let learned = predictor.used.clone().zip(usable(medium.take_gathered(&gpu)?));
        // Without a finite prediction, the water stays, and with it the view that it was predicted from.
        if let Some(Prediction { depth, raw: Some(raw), .. }) = predictor.take_prediction()? {
            medium.set_raw(&gpu, &self.frame, raw);
            predictor.used = Some(depth);
        }
        predictor.start(learned, seen)
    }

    /// Sets the water of the run to the mean prediction over the views. Gradient descent restarts from there.
    fn decide_water(&mut self) -> Result<()> {
        let gpu = Arc::clone(&self.gpu);
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(());
        };
        let gathered = usable(medium.take_gathered(&gpu)?);
        // The prediction comes too late to be used, but the learning step counts.
        predictor.take_prediction()?;
        if let Some((depth, v_raw)) = predictor.used.take().zip(gathered) {
            predictor.learn(&depth, v_raw, false);
        }
        let count = self.targets.views().len();
        let asked = count.min(MOST_VIEWS);
        let mut predictions = Vec::with_capacity(asked);
        for view in (0..asked).map(|i| i * count / asked) {
            let seen = self.look(view)?;
            let Some(predictor) = &mut self.predictor else { return Ok(()) };
            let depth = predictor.depth_map(&seen)?;
            if let Some(raw) = predictor.predict(&depth) {
                predictions.push((f64::from(depth.coverage()), raw.map(f64::from)));
            }
        }
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water_mut()) else {
            return Ok(());
        };
        let (water, spread) = match mean_and_deviation(&predictions) {
            Some((mean, deviation)) => {
                let water = able_to_move(Water::from_raw(mean, predictor.unit), predictor.unit);
                (water, constrained(&water, deviation, predictor.unit))
            }
            None => (medium.water(&gpu, &self.frame)?, [f64::INFINITY; 9]),
        };
        predictor.report(&water, &spread, predictions.len());
        let raw = water.to_raw(predictor.unit).map(|value| value as f32);
        let standard_error = predictor.errors_of(&water, spread);
        medium.begin_at(&gpu, &self.frame, raw, standard_error);
        predictor.standard_error = Some(standard_error);
        Ok(())
    }

    /// Renders the ranges of a training view at the current size.
    fn look(&mut self, view: usize) -> Result<Seen> {
        let gpu = Arc::clone(&self.gpu);
        let TrainViewAt { camera, pose, key } = self.view_at_size(view);
        let frame = FrameUniform {
            iteration: self.iteration,
            mip_filter: u32::from(self.config.mip_filter),
            medium: self.appearances.colouring(),
            ..FrameUniform::of_camera(&camera, &pose, gpu.tile())
        };
        self.frame.prepare_targets(&gpu, frame.size)?;
        loop {
            for band in frame.bands(self.bands.get(&key).copied().unwrap_or(1), gpu.tile()) {
                let mut recorder = Recorder::new(&gpu);
                self.frame.record_forward(&gpu, &mut recorder, &self.blocks, &band)?;
                recorder.submit();
            }
            match self.frame.overflow(&gpu)? {
                None => return self.read_seen(frame.size),
                Some(overflow) => self.make_room(key, overflow)?,
            }
        }
    }

    /// Camera and pose of a view at its size in the next iteration, or in the last one.
    fn view_at_size(&self, index: usize) -> TrainViewAt {
        let view = &self.targets.views()[index];
        let progress = self.schedule.progress(self.iteration.min(self.config.iterations - 1));
        let level = self.schedule.level(progress, &view.camera);
        let [width, height] = [view.camera.width, view.camera.height].map(|side| (side >> level).max(1));
        let camera = view.camera.resized(width, height);
        TrainViewAt { camera, pose: view.pose, key: (index, level) }
    }

    /// Reads ranges and alpha of the view that was rendered last, of the given `size`. Waits for the device
    /// and copies 20 bytes per pixel. In the first quarter of a run, images have half size or less.
    fn read_seen(&self, size: [u32; 2]) -> Result<Seen> {
        let (targets, pixels) = (self.frame.targets()?, size[0] as usize * size[1] as usize);
        let ranges = self.gpu.read(&targets.range_image, 0, pixels)?;
        let image: Vec<[f32; 4]> = self.gpu.read(&targets.image, 0, pixels)?;
        Ok(Seen { size, ranges, alphas: image.iter().map(|pixel| pixel[3]).collect() })
    }

    /// Sets the water to the prediction for the view that was just blended, of the given `size`. `None` if
    /// the prediction is not finite; the water then stays.
    pub(in crate::train) fn predict_at_once(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<Option<AtOnce>> {
        let seen = self.read_seen(size)?;
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(None);
        };
        let depth = predictor.depth_map(&seen)?;
        let Some(raw) = predictor.predict(&depth) else { return Ok(None) };
        medium.set_raw(gpu, &self.frame, raw);
        Ok(Some(AtOnce { seen, depth }))
    }

    /// Takes the learning step for the prediction of [`Trainer::predict_at_once`], after the backward pass
    /// through the water was recorded. If the depth map has a gradient, adds it to the gradients with respect
    /// to alpha and range.
    pub(in crate::train) fn learn_at_once(
        &mut self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        AtOnce { seen, depth }: AtOnce,
    ) -> Result<()> {
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(());
        };
        medium.record_step(recorder, &self.frame)?;
        recorder.flush();
        let Some(v_raw) = usable(medium.take_gathered(gpu)?) else { return Ok(()) };
        let Some(v_depth) = predictor.learn(&depth, v_raw, predictor.config.depth_gradient) else {
            return Ok(());
        };
        let NetworkConfig { width, height, .. } = predictor.config;
        let (v_ranges, v_alphas) =
            DepthMap::render_gradient(&seen.image(), width, height, predictor.unit as f32, &v_depth)?;
        let (v_image, v_range) = (self.loss.v_image()?, self.loss.v_range()?);
        let mut by_pixel: Vec<[f32; 4]> = gpu.read(v_image, 0, v_alphas.len())?;
        let mut by_range: Vec<f32> = gpu.read(v_range, 0, v_ranges.len())?;
        by_pixel.iter_mut().zip(v_alphas).for_each(|(pixel, v)| pixel[3] += v);
        by_range.iter_mut().zip(v_ranges).for_each(|(range, v)| *range += v);
        gpu.write(v_image, 0, &by_pixel);
        gpu.write(v_range, 0, &by_range);
        Ok(())
    }
}

/// A view at some size.
struct TrainViewAt {
    camera: crate::scene::PinholeCamera,
    pose: crate::scene::Pose,
    key: (usize, u32),
}

/// The gradient sums, if any iteration contributed to them.
fn usable(gathered: Gathered) -> Option<[f32; 9]> {
    (gathered.iterations > 0).then_some(gathered.v_raw)
}

/// Weighted mean and standard deviation of the raw water parameters over views; `None` without views. Views
/// that show nothing have no weight, unless all do.
fn mean_and_deviation(predictions: &[(f64, [f64; 9])]) -> Option<([f64; 9], [f64; 9])> {
    let total: f64 = predictions.iter().map(|(weight, _)| weight).sum();
    let weight = |own: f64| if total > 0.0 { own / total } else { 1.0 / predictions.len() as f64 };
    if predictions.is_empty() {
        return None;
    }
    let mut mean = [0.0; 9];
    for (own, raw) in predictions {
        mean.iter_mut().zip(raw).for_each(|(mean, raw)| *mean += weight(*own) * raw);
    }
    let mut variance = [0.0; 9];
    for (own, raw) in predictions {
        for i in 0..9 {
            variance[i] += weight(*own) * (raw[i] - mean[i]).powi(2);
        }
    }
    Some((mean, variance.map(f64::sqrt)))
}

/// Deviations of the parameters of `water` from those of its unconstrained parameters, by the slopes of
/// eq. 8.
fn constrained(water: &Water, deviation: [f64; 9], unit: f64) -> [f64; 9] {
    let slopes = water.slopes(unit);
    std::array::from_fn(|i| deviation[i] * slopes[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_deviation_weigh_views_by_their_coverage() {
        let predictions = [(0.75, [1.0; 9]), (0.25, [5.0; 9]), (0.0, [100.0; 9])];
        let Some((mean, deviation)) = mean_and_deviation(&predictions) else { panic!("there are views") };
        assert!(mean.iter().all(|value| (value - 2.0).abs() < 1e-12), "{mean:?}");
        // Root of 0.75 * 1 + 0.25 * 9.
        assert!(deviation.iter().all(|value| (value - 3.0_f64.sqrt()).abs() < 1e-12), "{deviation:?}");
        let Some((mean, _)) = mean_and_deviation(&[(0.0, [1.0; 9]), (0.0, [3.0; 9])]) else {
            panic!("there are views")
        };
        assert_eq!(mean, [2.0; 9], "views that show nothing count equally");
        assert_eq!(mean_and_deviation(&[]), None);
    }

    #[test]
    fn deviations_are_those_of_raw_parameters_times_the_slopes() {
        let (unit, h) = (3.2, 1e-6);
        let raw = Water::COASTAL.to_raw(unit);
        let found = constrained(&Water::COASTAL, [h; 9], unit);
        let moved = Water::from_raw(raw.map(|value| value + h), unit).to_array();
        for ((found, moved), from) in found.iter().zip(moved).zip(Water::COASTAL.to_array()) {
            assert!((found / (moved - from) - 1.0).abs() < 1e-4, "{found} and {}", moved - from);
        }
    }
}
