//! Adaptive density control of 3DGS (Kerbl et al. 2023, section 5, and their code) under a hard cap.
//!
//! Where the mean gradient w.r.t. the projected centre is large, detail is missing: small Gaussians are
//! cloned and large ones are split. Transparent Gaussians are removed, and after the first reset of opacities
//! also oversized ones. If 3DGS would exceed the cap, the Gaussians with the largest gradients come first.
//!
//! A child takes the entry of a removed Gaussian, in order, or else a new entry at the end. If more are
//! removed than added, the last Gaussians move into the gaps with their moments. So entries have no gaps, and
//! every order depends only on indices. [`ClassicConfig`] lists the differences from 3DGS.

use super::{CHUNK, Stats};
use crate::Result;
use crate::config::{ClassicConfig, Moments};
use crate::gpu::{Recorder, Size, sh_stride};
use crate::train::Trainer;

/// A parent and the entry of its child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Child {
    parent: u32,
    place: u32,
    /// True: split in two; false: cloned.
    split: bool,
}

/// All changes at one iteration: children first, then moves.
#[derive(Clone, Debug, Default, PartialEq)]
struct Decision {
    /// Parents ascending, places ascending.
    children: Vec<Child>,
    /// (from, to): from beyond `count` to below it, both ascending.
    moves: Vec<(u32, u32)>,
    /// Number of Gaussians afterwards.
    count: u32,
}

impl Trainer {
    pub(super) fn densify_classic(&mut self, stats: &[Stats]) -> Result<()> {
        let limits = Limits::new(&self.config.classic, self.extent, self.schedule.was_reset(self.iteration));
        let decision = decide(stats, &limits, self.config.max_gaussians as usize);
        // Children and moves need both the old and the new entries.
        let most = stats.len().max(decision.count as usize);
        self.blocks.set_trainable_total(&self.gpu, most as u32);
        for chunk in decision.children.chunks(CHUNK) {
            self.add_children(chunk)?;
        }
        for chunk in decision.moves.chunks(CHUNK) {
            self.move_entries(chunk)?;
        }
        self.blocks.set_trainable_total(&self.gpu, decision.count);
        self.finish("adding and removing Gaussians")
    }

    fn add_children(&self, children: &[Child]) -> Result<()> {
        let staged = self.staged(children.len())?;
        let mut recorder = Recorder::new(&self.gpu);
        let parents: Vec<u32> = children.iter().map(|child| child.parent).collect();
        self.by_block(&parents, |block, _, rows| {
            let rows: Vec<[u32; 4]> =
                rows.iter().map(|&[at, n]| [at, n, u32::from(children[n as usize].split), 0]).collect();
            let buffer = self.gpu.buffer("densify rows", rows.len() as u64 * 16)?;
            self.gpu.write(&buffer, 0, &rows);
            let divide =
                self.gpu.uniform("densify", &[rows.len() as u32, self.config.seed, self.iteration, 0]);
            recorder.dispatch(
                "densify_classic",
                Size::Items(rows.len() as u32, 64),
                &[
                    ("block", &block.uniform),
                    ("divide", &divide),
                    ("children", &buffer),
                    ("transforms", &block.transforms),
                    ("sh_coeffs", &block.sh_coeffs),
                    ("staged", &staged),
                ],
            )
        })?;
        let places: Vec<u32> = children.iter().map(|child| child.place).collect();
        self.place(&mut recorder, &staged, &places)?;
        recorder.submit();
        self.finish("adding Gaussians")
    }

    /// Copies entries with all their training state.
    fn move_entries(&self, moves: &[(u32, u32)]) -> Result<()> {
        let (from, to): (Vec<u32>, Vec<u32>) = moves.iter().copied().unzip();
        let stride = sh_stride(self.config.sh_degree);
        let Some((_, first, _)) = self.blocks.trainable().next() else { return Ok(()) };
        for (array, (_, bytes)) in first.arrays(stride).into_iter().enumerate() {
            let staged = self.gpu.buffer("staged rows", moves.len() as u64 * bytes as u64)?;
            let mut recorder = Recorder::new(&self.gpu);
            for (entries, back) in [(&from, false), (&to, true)] {
                self.by_block(entries, |block, _, rows| {
                    let buffer = self.gpu.buffer("densify rows", rows.len() as u64 * 8)?;
                    let own = block.arrays(stride)[array].0;
                    let (rows, source, target) = if back {
                        (rows.iter().map(|&[entry, n]| [n, entry]).collect(), &staged, own)
                    } else {
                        (rows.to_vec(), own, &staged)
                    };
                    self.gpu.write(&buffer, 0, &rows);
                    let words = bytes as u32 / 4;
                    let size = self.gpu.uniform("densify", &[rows.len() as u32, words, 0, 0]);
                    recorder.dispatch(
                        "densify_move",
                        Size::Items(rows.len() as u32 * words, 64),
                        &[("size", &size), ("moves", &buffer), ("rows_in", source), ("rows_out", target)],
                    )
                })?;
            }
            recorder.submit();
            self.finish("moving Gaussians")?;
        }
        Ok(())
    }

    /// Lowers all opacities to at most 0.01.
    pub(super) fn reset_opacities(&self) -> Result<()> {
        let mut recorder = Recorder::new(&self.gpu);
        for (_, block, training) in self.blocks.trainable() {
            // Words per row of moments, and the words of the opacity: first and second moment share one word
            // or have one each.
            let words = match training.kind {
                Moments::Compact => [16_u32, 3, 3, 0],
                Moments::F32 => [24, 3, 15, 0],
            };
            let reset = self.gpu.uniform("reset", &words);
            recorder.dispatch(
                "densify_reset",
                Size::Items(block.count, 64),
                &[
                    ("block", &block.uniform),
                    ("reset", &reset),
                    ("transforms", &block.transforms),
                    ("moments", &training.moments),
                ],
            )?;
        }
        recorder.submit();
        self.finish("resetting opacities")
    }
}

/// [`ClassicConfig`] in scene units.
struct Limits {
    gradient: f32,
    clone_scale: f32,
    prune_opacity: f32,
    prune_scale: f32,
}

impl Limits {
    fn new(config: &ClassicConfig, extent: f32, was_reset: bool) -> Self {
        let bounded = was_reset && config.prune_scale > 0.0;
        Self {
            gradient: config.gradient,
            clone_scale: config.clone_scale * extent,
            prune_opacity: config.prune_opacity,
            prune_scale: if bounded { config.prune_scale * extent } else { f32::INFINITY },
        }
    }

    fn divides(&self, stats: &Stats) -> bool {
        stats.gradient >= self.gradient && stats.gradient.is_finite()
    }

    fn splits(&self, stats: &Stats) -> bool {
        stats.scale > self.clone_scale
    }

    /// 3DGS divides first and then removes. Here a Gaussian whose children would be removed is not divided.
    fn keeps(&self, stats: &Stats) -> bool {
        let shrinks = self.divides(stats) && self.splits(stats);
        let scale = if shrinks { stats.scale / 1.6 } else { stats.scale };
        stats.opacity >= self.prune_opacity && stats.opacity > 0.0 && scale <= self.prune_scale
    }
}

/// Decides which Gaussians are cloned, split and removed to stay within `cap`, and the entries of all
/// results.
fn decide(stats: &[Stats], limits: &Limits, cap: usize) -> Decision {
    let mut kept: Vec<bool> = stats.iter().map(|s| limits.keeps(s)).collect();
    if !kept.contains(&true) {
        // A run cannot continue without Gaussians: the most opaque one stays.
        let order = |a: &usize, b: &usize| stats[*a].opacity.total_cmp(&stats[*b].opacity).then(b.cmp(a));
        let Some(last) = (0..stats.len()).max_by(order) else { return Decision::default() };
        kept[last] = true;
    }
    let left = kept.iter().filter(|&&kept| kept).count();
    let mut parents: Vec<u32> =
        (0..stats.len()).filter(|&i| kept[i] && limits.divides(&stats[i])).map(|i| i as u32).collect();
    let gradient = |i: &u32| stats[*i as usize].gradient;
    parents.sort_unstable_by(|a, b| gradient(b).total_cmp(&gradient(a)).then(a.cmp(b)));
    parents.truncate(cap.saturating_sub(left));
    parents.sort_unstable();

    let count = left + parents.len();
    // Gaps, then new entries. Gaps below `count` that remain are filled from beyond it.
    let mut places = (0..count).filter(|&i| i >= stats.len() || !kept[i]).map(|i| i as u32);
    let children = parents
        .into_iter()
        .zip(places.by_ref())
        .map(|(parent, place)| Child { parent, place, split: limits.splits(&stats[parent as usize]) })
        .collect();
    let beyond = (count..stats.len()).filter(|&i| kept[i]).map(|i| i as u32);
    Decision { children, moves: beyond.zip(places).collect(), count: count as u32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Stream, uniform_at};

    const LIMITS: Limits =
        Limits { gradient: 1.0, clone_scale: 1.0, prune_opacity: 0.005, prune_scale: 10.0 };

    fn stats(opacity: f32, gradient: f32, scale: f32) -> Stats {
        Stats { opacity, gradient, scale, pixel_gradient: 0.0 }
    }

    /// Carries out a decision on names: a child has the name of its parent.
    fn carried_out(n: u32, decision: &Decision) -> Vec<u32> {
        let mut names: Vec<u32> = (0..n).collect();
        names.resize(names.len().max(decision.count as usize), u32::MAX);
        for child in &decision.children {
            names[child.place as usize] = child.parent;
        }
        for &(from, to) in &decision.moves {
            names[to as usize] = names[from as usize];
        }
        names.truncate(decision.count as usize);
        names
    }

    #[test]
    fn small_are_cloned_large_split_transparent_or_huge_removed() {
        let all = [
            stats(0.5, 1.0, 1.0),      // at the threshold and small
            stats(0.5, 0.99, 1.0),     // below the threshold
            stats(0.5, 2.0, 1.01),     // large
            stats(0.0049, 5.0, 1.0),   // transparent
            stats(0.5, 0.0, 10.5),     // huge
            stats(0.5, 3.0, 15.9),     // huge, but its halves are not
            stats(0.5, 3.0, 16.1),     // huge, and so are its halves
            stats(0.5, f32::NAN, 1.0), // no gradient
        ];
        let decision = decide(&all, &LIMITS, 100);
        let child = |parent, place, split| Child { parent, place, split };
        assert_eq!(decision.children, [child(0, 3, false), child(2, 4, true), child(5, 6, true)]);
        assert_eq!((decision.moves.len(), decision.count), (0, 8));
        // Size does not matter before the first reset.
        let early = Limits { prune_scale: f32::INFINITY, ..LIMITS };
        let decision = decide(&all, &early, 100);
        assert_eq!(decision.count, 7 + 4);
        assert_eq!(decision.children.iter().map(|c| c.place).collect::<Vec<_>>(), [3, 8, 9, 10]);
    }

    #[test]
    fn under_the_cap_the_largest_gradients_are_divided_first() {
        let all: Vec<Stats> = (0..10).map(|i| stats(0.5, [2.0, 3.0][i % 2], 0.5)).collect();
        for (cap, parents) in [
            (9, vec![]),
            (10, vec![]),
            (12, vec![1, 3]),
            (17, vec![0, 1, 2, 3, 5, 7, 9]),
            (30, (0..10).collect::<Vec<u32>>()),
        ] {
            let decision = decide(&all, &LIMITS, cap);
            assert_eq!(decision.children.iter().map(|c| c.parent).collect::<Vec<_>>(), parents, "cap {cap}");
            assert_eq!(decision.count as usize, 10 + parents.len());
        }
    }

    #[test]
    fn gaps_are_closed_and_no_gaussian_is_lost() {
        for seed in 0..40 {
            let u = |i, k| uniform_at(seed, Stream::Test, i, k);
            let n = 1 + seed * 7;
            let transparent = 0.9 * u(0, 9);
            let all: Vec<Stats> = (0..n)
                .map(|i| {
                    let opacity = if u(i, 0) < transparent { 0.001 } else { 0.5 };
                    stats(opacity, 1.2 * u(i, 1), 2.0 * u(i, 2))
                })
                .collect();
            let decision = decide(&all, &LIMITS, (n + n / 8) as usize);
            let mut names = carried_out(n, &decision);
            names.sort_unstable();
            let mut expected: Vec<u32> = (0..n).filter(|&i| LIMITS.keeps(&all[i as usize])).collect();
            if expected.is_empty() {
                assert!((1..=2).contains(&names.len()), "seed {seed}");
                continue;
            }
            expected.extend(decision.children.iter().map(|c| c.parent));
            expected.sort_unstable();
            assert_eq!(names, expected, "seed {seed}");
            assert!(decision.count <= n + n / 8);
            // Each entry is written once, and no entry that is read later is written.
            let reads = decision.children.iter().map(|c| c.parent).chain(decision.moves.iter().map(|m| m.0));
            let writes = decision.children.iter().map(|c| c.place).chain(decision.moves.iter().map(|m| m.1));
            let writes: std::collections::BTreeSet<u32> = writes.collect();
            assert_eq!(writes.len(), decision.children.len() + decision.moves.len());
            assert!(reads.into_iter().all(|read| !writes.contains(&read)), "seed {seed}");
        }
    }

    #[test]
    fn a_run_never_becomes_empty() {
        let all = [stats(0.001, 0.0, 1.0), stats(0.002, 9.0, 1.0), stats(0.002, 9.0, 1.0)];
        let decision = decide(&all, &LIMITS, 2);
        assert_eq!((decision.count, carried_out(3, &decision)), (2, vec![1, 1]));
        assert_eq!(decide(&[stats(0.0, 0.0, f32::NAN)], &LIMITS, 10).count, 1);
        assert_eq!(decide(&[], &LIMITS, 10), Decision::default());
    }

    #[test]
    fn limits_scale_with_the_extent_and_size_counts_after_a_reset() {
        let config = ClassicConfig::default();
        let limits = Limits::new(&config, 50.0, true);
        assert_eq!((limits.clone_scale, limits.prune_scale), (0.5, 5.0));
        assert_eq!(Limits::new(&config, 50.0, false).prune_scale, f32::INFINITY);
        let endless = ClassicConfig { prune_scale: 0.0, ..config };
        assert_eq!(Limits::new(&endless, 50.0, true).prune_scale, f32::INFINITY);
    }
}
