//! Density control: faded Gaussians move to where detail is missing, and new ones are added there, up to a cap.
//!
//! In the spirit of 3DGS-MCMC (Kheradmand et al. 2024: relocation under a hard cap) with the measure of AbsGS
//! (Ye et al. 2024): the sum of absolute pixel gradients of a Gaussian, as a mean over the views that saw it, so that
//! views that do not see it do not dilute it. Sources are drawn without replacement with that weight
//! (Efraimidis and Spirakis 2006), from random numbers that are a function of (seed, iteration, index).

use super::Trainer;
use crate::gpu::{BLOCK_CAPACITY, Recorder, Size, sh_stride};
use crate::rng::{Stream, uniform_at};
use crate::{CoreError, Result};

/// Below this opacity a Gaussian has faded (3DGS-MCMC).
const FADED: f32 = 0.005;
/// Most Gaussians that are split between two submissions: bounds the staging buffer.
const CHUNK: usize = 65_536;

impl Trainer {
    /// Relocates and adds Gaussians by the schedule; the device is idle before and after.
    pub(super) fn refine(&mut self) -> Result<()> {
        let stats = self.read_stats()?;
        let target = self.schedule.target_count(self.iteration, self.initial) as usize;
        let moves = decide(&stats, target, self.config.seed, self.iteration);
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

    /// Opacity and mean pixel gradient of every trainable Gaussian; the sums start anew.
    fn read_stats(&self) -> Result<Vec<[f32; 2]>> {
        let mut stats = Vec::new();
        for (_, block, training) in self.blocks.trainable() {
            if block.count == 0 {
                continue;
            }
            let buffer = self.gpu.buffer("refine stats", u64::from(block.count) * 8)?;
            let mut recorder = Recorder::new(&self.gpu);
            recorder.dispatch(
                "refine_stats",
                Size::Items(block.count, 64),
                &[
                    ("block", &block.uniform),
                    ("transforms", &block.transforms),
                    ("refine", &training.refine),
                    ("stats", &buffer),
                ],
            )?;
            recorder.submit();
            stats.extend(self.gpu.read::<[f32; 2]>(&buffer, 0, block.count as usize)?);
        }
        self.gpu.stages().forget_bind_groups();
        Ok(stats)
    }

    /// Splits each source in two; the second child goes to the destination.
    fn split(&self, moves: &[(u32, u32)]) -> Result<()> {
        let stride = u64::from(3 + sh_stride(self.config.sh_degree));
        let staged = self.gpu.buffer("staged Gaussians", moves.len() as u64 * stride * 16)?;
        let mut recorder = Recorder::new(&self.gpu);
        for (stage, list, by) in [
            ("densify_split", "splits", (|m: &(u32, u32)| m.0) as fn(&(u32, u32)) -> u32),
            ("densify_place", "placements", |m| m.1),
        ] {
            for (index, block, _) in self.blocks.trainable() {
                let first = index as u32 * BLOCK_CAPACITY;
                let rows: Vec<[u32; 2]> = moves
                    .iter()
                    .enumerate()
                    .filter(|(_, m)| (first..first + block.capacity).contains(&by(m)))
                    .map(|(staged_at, m)| [by(m) - first, staged_at as u32])
                    .collect();
                if rows.is_empty() {
                    continue;
                }
                let buffer = self.gpu.buffer("densify rows", rows.len() as u64 * 8)?;
                self.gpu.write(&buffer, 0, &rows);
                let count = self.gpu.uniform("densify", &[rows.len() as u32, 0, 0, 0]);
                let name = if stage == "densify_split" { "split" } else { "place" };
                recorder.dispatch(
                    stage,
                    Size::Items(rows.len() as u32, 64),
                    &[
                        ("block", &block.uniform),
                        (name, &count),
                        (list, &buffer),
                        ("transforms", &block.transforms),
                        ("sh_coeffs", &block.sh_coeffs),
                        ("staged", &staged),
                    ],
                )?;
            }
        }
        recorder.submit();
        self.gpu.stages().forget_bind_groups();
        self.gpu.wait().map_err(|error| match error {
            CoreError::Gpu(message) => CoreError::Gpu(format!("splitting Gaussians: {message}")),
            other => other,
        })
    }
}

/// Which Gaussian is split and where its second child goes: (source, destination), sources ascending.
///
/// `stats` holds (opacity, weight). Destinations are the faded ones in order, then new entries up to `target`.
fn decide(stats: &[[f32; 2]], target: usize, seed: u32, iteration: u32) -> Vec<(u32, u32)> {
    let faded = |opacity: f32| opacity <= FADED;
    let mut destinations: Vec<u32> =
        stats.iter().enumerate().filter(|(_, s)| faded(s[0])).map(|(i, _)| i as u32).collect();
    destinations.extend(stats.len() as u32..target.max(stats.len()) as u32);
    // Exponential keys: the n smallest of -ln(u) / weight are a weighted sample without replacement.
    let mut keys: Vec<(f64, u32)> = stats
        .iter()
        .enumerate()
        .filter(|(_, s)| !faded(s[0]) && s[1] > 0.0 && s[1].is_finite())
        .map(|(i, s)| {
            let u = f64::from(uniform_at(seed, Stream::Densify, i as u32, iteration)).max(1e-9);
            (-u.ln() / f64::from(s[1]), i as u32)
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

    fn stats(n: u32) -> Vec<[f32; 2]> {
        (0..n).map(|i| [if i % 5 == 0 { 0.001 } else { 0.5 }, (i % 7) as f32]).collect()
    }

    #[test]
    fn faded_gaussians_are_refilled_first_and_the_target_is_kept() {
        let stats = stats(1000);
        let moves = decide(&stats, 1300, 1, 100);
        let destinations: Vec<u32> = moves.iter().map(|m| m.1).collect();
        assert_eq!(destinations.len(), 200 + 300);
        assert!(destinations[..200].iter().all(|&d| stats[d as usize][0] < FADED));
        assert_eq!(destinations[200..], (1000..1300).collect::<Vec<u32>>());
        let mut sources: Vec<u32> = moves.iter().map(|m| m.0).collect();
        assert!(sources.iter().all(|&s| stats[s as usize][0] > FADED && stats[s as usize][1] > 0.0));
        sources.dedup();
        assert_eq!(sources.len(), moves.len(), "a source is split once");
    }

    #[test]
    fn heavier_gaussians_are_split_more_often_and_the_draw_depends_on_its_key_only() {
        let stats = stats(7000);
        let moves = decide(&stats, 7000, 3, 50);
        assert_eq!(moves, decide(&stats, 7000, 3, 50));
        assert_ne!(moves, decide(&stats, 7000, 4, 50));
        let share = |weight: f32| {
            let have = stats.iter().filter(|s| s[1] == weight && s[0] > FADED).count();
            moves.iter().filter(|m| stats[m.0 as usize][1] == weight).count() as f64 / have as f64
        };
        assert!(share(6.0) > 2.0 * share(2.0), "{} against {}", share(6.0), share(2.0));
    }

    #[test]
    fn nothing_moves_when_no_gaussian_has_a_gradient() {
        assert!(decide(&[[0.5, 0.0], [0.001, 3.0], [0.5, f32::NAN]], 10, 1, 1).is_empty());
    }
}
