//! Covers bare surfaces at the last density decision. Faded Gaussians move there first, then new ones are
//! added as far as there is room, then the faintest Gaussians are moved.
//!
//! Earlier, this would not last. The photographs hardly constrain such a Gaussian, so it soon becomes small
//! and faint again, and it prevents the bare place from being found. After the last decision nothing pulls on
//! it (`TrainConfig::opacity_reg`).

use super::mcmc::is_faded;
use super::{CHUNK, Stats};
use crate::Result;
use crate::config::Strategy;
use crate::gpu::Recorder;
use crate::train::Trainer;

/// Below this opacity a Gaussian may be replaced by one that covers a surface.
const FAINT: f32 = 0.1;

impl Trainer {
    /// At the last decision, puts a Gaussian at each bare place, the barest first. Updates `stats` to include
    /// them.
    pub(super) fn cover_surfaces(&mut self, stats: &mut Vec<Stats>) -> Result<()> {
        let (Some(surfaces), Some(medium)) = (&self.surfaces, self.appearances.water()) else {
            return Ok(());
        };
        if !self.schedule.decides_last_at(self.iteration) {
            return Ok(());
        }
        let target = match self.config.strategy {
            Strategy::Mcmc => self.schedule.target_count(self.iteration, self.initial),
            Strategy::Classic => self.config.max_gaussians,
        };
        let mut trained = self.blocks.transforms(&self.gpu)?;
        let gone = stats.iter().zip(&mut trained).filter(|(one, _)| is_faded(one.opacity));
        gone.for_each(|(_, transform)| transform[0][3] = f32::NEG_INFINITY);
        let bare = surfaces.bare(&trained, medium.run().least_cover());
        let places = places(stats, target, bare.len());
        tracing::info!(bare = bare.len(), covered = places.len(), "bare surfaces are covered");
        let (points, places): (Vec<u32>, Vec<u32>) = bare.into_iter().zip(places).unzip();
        let Some(last) = places.iter().max() else { return Ok(()) };
        stats.resize(stats.len().max(*last as usize + 1), Stats::default());
        self.blocks.set_trainable_total(&self.gpu, stats.len() as u32);
        for (points, places) in points.chunks(CHUNK).zip(places.chunks(CHUNK)) {
            let staged = self.staged(points.len())?;
            self.gpu.write(&staged, 0, &self.blocks.staged_rows(&surfaces.model, points));
            let mut recorder = Recorder::new(&self.gpu);
            self.place(&mut recorder, &staged, places)?;
            recorder.submit();
            self.finish("covering surfaces")?;
        }
        // The new Gaussian is not faded, and is not split before any view has seen it.
        places.iter().for_each(|&at| stats[at as usize] = Stats { opacity: 1.0, ..Stats::default() });
        Ok(())
    }
}

/// Entries for `count` covering Gaussians: faded ones, then new entries up to `target`, then the faintest.
fn places(stats: &[Stats], target: u32, count: usize) -> Vec<u32> {
    let opacity = |at: u32| stats[at as usize].opacity;
    let (faded, alive): (Vec<u32>, Vec<u32>) = (0..stats.len() as u32).partition(|&at| is_faded(opacity(at)));
    let mut places: Vec<u32> = faded.into_iter().chain(stats.len() as u32..target).take(count).collect();
    let mut faint: Vec<u32> = alive.into_iter().filter(|&at| opacity(at) < FAINT).collect();
    faint.sort_by(|a, b| opacity(*a).total_cmp(&opacity(*b)).then(a.cmp(b)));
    places.extend(faint.into_iter().take(count - places.len()));
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_faded_ones_then_new_ones_then_the_faintest() {
        let stats: Vec<Stats> = [0.5, 0.004, 0.09, 0.9, 0.0, 0.02, 0.11]
            .map(|opacity| Stats { opacity, ..Stats::default() })
            .to_vec();
        assert_eq!(places(&stats, 9, 9), [1, 4, 7, 8, 5, 2], "visible Gaussians stay");
        assert_eq!(places(&stats, 9, 3), [1, 4, 7]);
        assert_eq!(places(&stats, 7, 3), [1, 4, 5], "no room for more");
        assert!(places(&stats, 9, 0).is_empty());
    }
}
