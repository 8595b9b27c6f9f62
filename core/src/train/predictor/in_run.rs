//! What a run does with WaterParamPredict: when it is asked, what it is shown, and how its word becomes the
//! water.

use std::sync::Arc;

use super::{Said, Seen};
use crate::Result;
use crate::config::NetworkConfig;
use crate::gpu::{FrameUniform, Gpu, Recorder};
use crate::nets::DepthMap;
use crate::train::start::able_to_move;
use crate::train::{Gathered, Trainer};
use crate::water::Water;

/// Most views that are asked at the end: as many say how much they differ.
const MOST_VIEWS: usize = 64;

/// A prediction for the view of the iteration that is being recorded.
pub(in crate::train) struct AtOnce {
    seen: Seen,
    depth: DepthMap,
}

impl Trainer {
    /// First iteration after the one that is next at whose start the network has something to do.
    pub(in crate::train) fn next_prediction(&self) -> u32 {
        self.predictor.as_ref().map_or(u32::MAX, |predictor| predictor.next_due(self.iteration))
    }

    /// Does what of the network is due at this iteration; the device is idle before.
    pub(in crate::train) fn predict_water(&mut self) -> Result<()> {
        let Some(predictor) = &self.predictor else { return Ok(()) };
        if self.iteration >= predictor.end { self.decide_water() } else { self.exchange_with_network() }
    }

    /// What is between two predictions.
    fn exchange_with_network(&mut self) -> Result<()> {
        let gpu = Arc::clone(&self.gpu);
        let key = self.view_of(self.iteration - 1);
        let seen = self.read_seen(self.picture_of(key).size)?;
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(());
        };
        let learned = predictor.used.clone().zip(usable(medium.take_gathered(&gpu)?));
        // Where it said nothing usable the water stays, and with it the view that it was made of.
        if let Some(Said { depth, raw: Some(raw), .. }) = predictor.take_said()? {
            medium.set_raw(&gpu, &self.frame, raw);
            predictor.used = Some(depth);
        }
        predictor.start(learned, seen)
    }

    /// Makes one water for the run of what the network says of the views; descent begins anew from there.
    fn decide_water(&mut self) -> Result<()> {
        let gpu = Arc::clone(&self.gpu);
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water()) else {
            return Ok(());
        };
        let gathered = usable(medium.take_gathered(&gpu)?);
        // Comes too late to enter; what it has learnt counts.
        predictor.take_said()?;
        if let Some((depth, v_raw)) = predictor.used.take().zip(gathered) {
            predictor.learn(&depth, v_raw, false);
        }
        let count = self.targets.views().len();
        let asked = count.min(MOST_VIEWS);
        let mut said = Vec::with_capacity(asked);
        for view in (0..asked).map(|i| i * count / asked) {
            let seen = self.look(view)?;
            let Some(predictor) = &mut self.predictor else { return Ok(()) };
            let depth = predictor.depth_map(&seen)?;
            if let Some(raw) = predictor.predict(&depth) {
                said.push((f64::from(depth.coverage()), raw.map(f64::from)));
            }
        }
        let (Some(predictor), Some(medium)) = (&mut self.predictor, self.appearances.water_mut()) else {
            return Ok(());
        };
        let (water, spread) = match mean_and_deviation(&said) {
            Some((mean, deviation)) => {
                let water = able_to_move(Water::from_raw(mean, predictor.unit), predictor.unit);
                (water, constrained(&water, deviation, predictor.unit))
            }
            None => (medium.water(&gpu, &self.frame)?, [f64::INFINITY; 9]),
        };
        predictor.report(&water, &spread, said.len());
        let raw = water.to_raw(predictor.unit).map(|value| value as f32);
        let standard_error = predictor.errors_of(&water, spread);
        medium.begin_at(&gpu, &self.frame, raw, standard_error);
        predictor.standard_error = Some(standard_error);
        Ok(())
    }

    /// Renders the ranges of a training view at the size of now.
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

    /// Camera and pose of a view at the size that the next iteration, or the last, has it.
    fn view_at_size(&self, index: usize) -> TrainViewAt {
        let view = &self.targets.views()[index];
        let progress = self.schedule.progress(self.iteration.min(self.config.iterations - 1));
        let level = self.schedule.level(progress, &view.camera);
        let [width, height] = [view.camera.width, view.camera.height].map(|side| (side >> level).max(1));
        let camera = view.camera.resized(width, height);
        TrainViewAt { camera, pose: view.pose, key: (index, level) }
    }

    /// Ranges and alpha of the view that was rendered last, which has `size`. Waits for the device, and
    /// copies 20 bytes a pixel: in the first quarter of a run pictures are at half size or less.
    fn read_seen(&self, size: [u32; 2]) -> Result<Seen> {
        let (targets, pixels) = (self.frame.targets()?, size[0] as usize * size[1] as usize);
        let ranges = self.gpu.read(&targets.range_image, 0, pixels)?;
        let image: Vec<[f32; 4]> = self.gpu.read(&targets.image, 0, pixels)?;
        Ok(Seen { size, ranges, alphas: image.iter().map(|pixel| pixel[3]).collect() })
    }

    /// Puts the water that the network predicts for the view of `size` that was blended in place; `None`
    /// where it says nothing usable, and the water stays.
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

    /// Takes the step of learning for what [`Trainer::predict_at_once`] gave, after the way back through the
    /// water was recorded, and where the depth map has a gradient adds it to those by alpha and by range.
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

/// Sums that there is something in.
fn usable(gathered: Gathered) -> Option<[f32; 9]> {
    (gathered.iterations > 0).then_some(gathered.v_raw)
}

/// Weighted mean and standard deviation of nine numbers over views; `None` where there are none. Views that
/// show nothing have no weight, unless all do.
fn mean_and_deviation(said: &[(f64, [f64; 9])]) -> Option<([f64; 9], [f64; 9])> {
    let total: f64 = said.iter().map(|(weight, _)| weight).sum();
    let weight = |own: f64| if total > 0.0 { own / total } else { 1.0 / said.len() as f64 };
    if said.is_empty() {
        return None;
    }
    let mut mean = [0.0; 9];
    for (own, raw) in said {
        mean.iter_mut().zip(raw).for_each(|(mean, raw)| *mean += weight(*own) * raw);
    }
    let mut variance = [0.0; 9];
    for (own, raw) in said {
        for i in 0..9 {
            variance[i] += weight(*own) * (raw[i] - mean[i]).powi(2);
        }
    }
    Some((mean, variance.map(f64::sqrt)))
}

/// Deviations of the nine numbers of `water` from those of its unconstrained numbers, by the slopes of eq. 8.
fn constrained(water: &Water, deviation: [f64; 9], unit: f64) -> [f64; 9] {
    let slopes = water.slopes(unit);
    std::array::from_fn(|i| deviation[i] * slopes[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_count_by_what_they_show_and_their_spread_is_that_of_the_numbers() {
        let said = [(0.75, [1.0; 9]), (0.25, [5.0; 9]), (0.0, [100.0; 9])];
        let Some((mean, deviation)) = mean_and_deviation(&said) else { panic!("there are views") };
        assert!(mean.iter().all(|value| (value - 2.0).abs() < 1e-12), "{mean:?}");
        // Root of 0.75 * 1 + 0.25 * 9.
        assert!(deviation.iter().all(|value| (value - 3.0_f64.sqrt()).abs() < 1e-12), "{deviation:?}");
        let Some((mean, _)) = mean_and_deviation(&[(0.0, [1.0; 9]), (0.0, [3.0; 9])]) else {
            panic!("there are views")
        };
        assert_eq!(mean, [2.0; 9], "views that show nothing count alike");
        assert_eq!(mean_and_deviation(&[]), None);
    }

    #[test]
    fn deviations_of_the_nine_numbers_are_those_of_the_unconstrained_ones_times_the_slope() {
        let (unit, h) = (3.2, 1e-6);
        let raw = Water::COASTAL.to_raw(unit);
        let found = constrained(&Water::COASTAL, [h; 9], unit);
        let moved = Water::from_raw(raw.map(|value| value + h), unit).to_array();
        for ((found, moved), from) in found.iter().zip(moved).zip(Water::COASTAL.to_array()) {
            assert!((found / (moved - from) - 1.0).abs() < 1e-4, "{found} and {}", moved - from);
        }
    }
}
