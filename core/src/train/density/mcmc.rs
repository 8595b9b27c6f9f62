//! Relocation under a cap: faded Gaussians move to where detail is missing, and new ones are added there, up
//! to a cap.
//!
//! This combines the relocation under a hard cap of 3DGS-MCMC (Kheradmand et al. 2024) with the measure of
//! AbsGS (Ye et al. 2024). The measure is the sum of absolute pixel gradients of a Gaussian, averaged over
//! the views that saw it, so that other views do not dilute it. Sources are drawn without replacement with
//! that weight (Efraimidis and Spirakis 2006). The random numbers are a function of (seed, iteration, index).

use super::{CHUNK, Stats};
use crate::Result;
use crate::gpu::{Recorder, Size};
use crate::rng::{Stream, uniform_at};
use crate::train::Trainer;

/// Below this opacity a Gaussian has faded (3DGS-MCMC).
const FADED: f32 = 0.005;

/// Whether a Gaussian of this opacity has faded.
pub(super) fn is_faded(opacity: f32) -> bool {
    opacity <= FADED
}

impl Trainer {
    /// Relocates and adds Gaussians according to the schedule.
    pub(super) fn densify_mcmc(&mut self, stats: &[Stats]) -> Result<()> {
        let target = self.schedule.target_count(self.iteration, self.initial) as usize;
        let moves = decide(stats, target, self.config.seed, self.iteration);
        if moves.is_empty() {
            return Ok(());
        }
        let total = stats.len().max(moves.iter().map(|&(_, to)| to as usize + 1).max().unwrap_or(0));
        self.blocks.set_trainable_total(&self.gpu, total as u32);
        for chunk in moves.chunks(CHUNK) {
            self.split(chunk)?;
        }
        Ok(())
    }

    /// Splits each source in two; the second child goes to the destination.
    fn split(&self, moves: &[(u32, u32)]) -> Result<()> {
        let staged = self.staged(moves.len())?;
        let mut recorder = Recorder::new(&self.gpu);
        let (sources, destinations): (Vec<u32>, Vec<u32>) = moves.iter().copied().unzip();
        self.by_block(&sources, |block, _, rows| {
            let buffer = self.gpu.buffer("densify rows", rows.len() as u64 * 8)?;
            self.gpu.write(&buffer, 0, rows);
            // The third number of a disk is not a scale.
            let axes = if self.config.disks { 2 } else { 3 };
            let count = self.gpu.uniform("densify", &[rows.len() as u32, axes, 0, 0]);
            recorder.dispatch(
                "densify_split",
                Size::Items(rows.len() as u32, 64),
                &[
                    ("block", &block.uniform),
                    ("split", &count),
                    ("splits", &buffer),
                    ("transforms", &block.transforms),
                    ("sh_coeffs", &block.sh_coeffs),
                    ("staged", &staged),
                ],
            )
        })?;
        self.place(&mut recorder, &staged, &destinations)?;
        recorder.submit();
        self.finish("splitting Gaussians")
    }
}

/// Pairs of (Gaussian to split, entry of its second child), ascending by the first.
///
/// Weights are pixel gradients. Destinations are the faded Gaussians in order, then new entries up to
/// `target`.
fn decide(stats: &[Stats], target: usize, seed: u32, iteration: u32) -> Vec<(u32, u32)> {
    let mut destinations: Vec<u32> =
        stats.iter().enumerate().filter(|(_, s)| is_faded(s.opacity)).map(|(i, _)| i as u32).collect();
    destinations.extend(stats.len() as u32..target.max(stats.len()) as u32);
    // Exponential keys: the n smallest of -ln(u) / weight are a weighted sample without replacement.
    let mut keys: Vec<(f64, u32)> = stats
        .iter()
        .enumerate()
        .filter(|(_, s)| !is_faded(s.opacity) && s.pixel_gradient > 0.0 && s.pixel_gradient.is_finite())
        .map(|(i, s)| {
            let u = f64::from(uniform_at(seed, Stream::Densify, i as u32, iteration)).max(1e-9);
            (-u.ln() / f64::from(s.pixel_gradient), i as u32)
        })
        .collect();
    let n = destinations.len().min(keys.len());
    if n == 0 {
        return Vec::new();
    }
    let order = |a: &(f64, u32), b: &(f64, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if n < keys.len() {
        keys.select_nth_unstable_by(n - 1, order);
        keys.truncate(n);
    }
    let mut sources: Vec<u32> = keys.into_iter().map(|(_, index)| index).collect();
    sources.sort_unstable();
    sources.into_iter().zip(destinations).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(opacity: f32, pixel_gradient: f32) -> Stats {
        Stats { opacity, pixel_gradient, ..Stats::default() }
    }

    fn stats(n: u32) -> Vec<Stats> {
        (0..n).map(|i| one(if i % 5 == 0 { 0.001 } else { 0.5 }, (i % 7) as f32)).collect()
    }

    #[test]
    fn faded_gaussians_are_replaced_first_and_the_target_is_met() {
        let stats = stats(1000);
        let moves = decide(&stats, 1300, 1, 100);
        let destinations: Vec<u32> = moves.iter().map(|m| m.1).collect();
        assert_eq!(destinations.len(), 200 + 300);
        assert!(destinations[..200].iter().all(|&d| stats[d as usize].opacity < FADED));
        assert_eq!(destinations[200..], (1000..1300).collect::<Vec<u32>>());
        let mut sources: Vec<u32> = moves.iter().map(|m| m.0).collect();
        assert!(
            sources
                .iter()
                .all(|&s| stats[s as usize].opacity > FADED && stats[s as usize].pixel_gradient > 0.0)
        );
        sources.dedup();
        assert_eq!(sources.len(), moves.len(), "a source is split once");
    }

    #[test]
    fn splits_follow_the_weights_and_depend_only_on_the_key() {
        let stats = stats(7000);
        let moves = decide(&stats, 7000, 3, 50);
        assert_eq!(moves, decide(&stats, 7000, 3, 50));
        assert_ne!(moves, decide(&stats, 7000, 4, 50));
        let share = |weight: f32| {
            let have = stats.iter().filter(|s| s.pixel_gradient == weight && s.opacity > FADED).count();
            moves.iter().filter(|m| stats[m.0 as usize].pixel_gradient == weight).count() as f64 / have as f64
        };
        assert!(share(6.0) > 2.0 * share(2.0), "{} against {}", share(6.0), share(2.0));
    }

    #[test]
    fn nothing_moves_when_no_gaussian_has_a_gradient() {
        assert!(decide(&[one(0.5, 0.0), one(0.001, 3.0), one(0.5, f32::NAN)], 10, 1, 1).is_empty());
    }
}
