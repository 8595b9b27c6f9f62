//! The cap of the job: removes Gaussians when the cells together hold more than the user allows.
//!
//! Every partition has its own cap, for its cell and margins together. The split between cell and margins is
//! not known before training ends. So the cells together may exceed the cap by a few percent; then the most
//! transparent Gaussians are removed. A histogram finds them, so memory does not grow with the model.
//!
//! Of a scene with a water surface, each set loses the same share. Disks of the refracted set lie behind each
//! other and are fainter than those in air, so that set would lose most. On a pool of 4 m in 2x2, 12 % of the
//! disks had to go. The water lost 0.71 dB with the faintest of all, and 0.30 dB with those of each set.
//!
//! Partitions with a tenth fewer disks, so that none had to go, were worse: 29.17 dB in place of 29.44 dB.

use crate::candidate::ascending;

/// Bins of the histogram: the upper half of an f32.
const BINS: usize = 1 << 16;
/// Sets that are thinned apart: those of a scene with a water surface.
const SETS: usize = 3;

/// What decides whether a Gaussian stays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standing {
    /// Its set ([`crate::ply_rows::Splat::set`]).
    pub set: f32,
    /// Logit of its opacity.
    pub logit: f32,
}

impl Standing {
    fn set(self) -> usize {
        // Negative numbers and NaN, which no set has, are 0.
        (self.set as usize).min(SETS - 1)
    }
}

/// Histograms of opacities by set; empty for a set without Gaussians.
#[derive(Default)]
pub struct Opacities([Vec<u64>; SETS]);

impl Opacities {
    pub fn add(&mut self, of: Standing) {
        let bins = &mut self.0[of.set()];
        bins.resize(BINS, 0);
        bins[usize::from(bin(of.logit))] += 1;
    }

    /// Removes one that was added.
    pub fn remove(&mut self, of: Standing) {
        self.0[of.set()][usize::from(bin(of.logit))] -= 1;
    }

    pub fn add_all(&mut self, other: &Self) {
        for (sum, bins) in self.0.iter_mut().zip(&other.0) {
            sum.resize(sum.len().max(bins.len()), 0);
            sum.iter_mut().zip(bins).for_each(|(sum, count)| *sum += count);
        }
    }

    fn counts(&self) -> [u64; SETS] {
        [0, 1, 2].map(|set| self.0[set].iter().sum())
    }

    /// Number of Gaussians.
    pub fn count(&self) -> u64 {
        self.counts().iter().sum()
    }

    /// The thinning that keeps at most `cap` of the Gaussians added: of each set the same share.
    pub fn thinning(&self, cap: u64) -> Thinning {
        let all = self.count();
        let (mut before, mut surplus_before) = (0, 0);
        let surplus = all.saturating_sub(cap);
        Thinning(
            self.counts()
                .map(|count| {
                    // Of the sets up to this one, rounded down; so all together lose exactly the surplus.
                    before += count;
                    let so_far = (u128::from(surplus) * u128::from(before) / u128::from(all.max(1))) as u64;
                    let own = so_far - surplus_before;
                    surplus_before = so_far;
                    own
                })
                .into_iter()
                .zip(&self.0)
                .map(|(surplus, bins)| Cut::of(bins, surplus))
                .collect(),
        )
    }
}

/// Decides for each Gaussian, in the order of the merge, whether it stays.
pub struct Thinning(Vec<Cut>);

impl Thinning {
    /// Whether a block stays whole whose most transparent Gaussian is in `lowest_bin`.
    pub fn keeps_all(&self, lowest_bin: u16) -> bool {
        self.0.iter().all(|cut| lowest_bin > cut.bin || (lowest_bin == cut.bin && cut.left == 0))
    }

    pub fn keeps(&mut self, of: Standing) -> bool {
        let (cut, bin) = (&mut self.0[of.set()], bin(of.logit));
        if bin == cut.bin && cut.left > 0 {
            cut.left -= 1;
            return false;
        }
        bin >= cut.bin
    }
}

/// What a set loses.
struct Cut {
    /// All below this bin are removed.
    bin: u16,
    /// Number of Gaussians of the bin itself that are still to be removed, the first ones.
    left: u64,
}

impl Cut {
    /// The cut that removes the `surplus` most transparent of a histogram.
    fn of(bins: &[u64], mut surplus: u64) -> Self {
        for (bin, &count) in bins.iter().enumerate() {
            if surplus <= count {
                return Self { bin: bin as u16, left: surplus };
            }
            surplus -= count;
        }
        Self { bin: 0, left: 0 }
    }
}

/// The bin of a finite value; ascends with it.
pub fn bin(logit: f32) -> u16 {
    (ascending(logit) >> 16) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(logits: &[f32], cap: u64) -> Vec<f32> {
        let all: Vec<_> = logits.iter().map(|&logit| Standing { set: 0.0, logit }).collect();
        kept_of(&all, cap).into_iter().map(|of| of.logit).collect()
    }

    fn kept_of(all: &[Standing], cap: u64) -> Vec<Standing> {
        let mut opacities = Opacities::default();
        all.iter().for_each(|&of| opacities.add(of));
        let mut thinning = opacities.thinning(cap);
        all.iter().copied().filter(|&of| thinning.keeps(of)).collect()
    }

    #[test]
    fn each_set_loses_the_same_share() {
        // The sets differ in opacity by far more than they do within.
        let of =
            |i: u32| Standing { set: (i % 3) as f32, logit: (i % 3) as f32 * 4.0 + (i / 3) as f32 * 0.01 };
        let all: Vec<_> = (0..300).map(of).collect();
        let kept = kept_of(&all, 200);
        assert_eq!(kept.len(), 200);
        for set in [0.0, 1.0, 2.0] {
            let left = kept.iter().filter(|of| of.set == set).count();
            assert!((66..=67).contains(&left), "{left} of set {set}");
            let least =
                |of: &[Standing]| of.iter().filter(|of| of.set == set).map(|of| of.logit).reduce(f32::min);
            assert!(least(&kept) > least(&all), "the faintest of set {set} stays");
        }
        // A number that is no set is one of the first.
        assert_eq!(
            kept_of(&[Standing { set: -7.0, logit: 0.0 }, Standing { set: f32::NAN, logit: 1.0 }], 1).len(),
            1
        );
    }

    #[test]
    fn the_most_transparent_go_first_and_of_equals_the_first() {
        let logits = [0.5, -3.0, 2.0, -7.0, -3.0, 0.0, -3.0];
        assert_eq!(kept(&logits, 7), logits);
        assert_eq!(kept(&logits, 100), logits);
        assert_eq!(kept(&logits, 6), [0.5, -3.0, 2.0, -3.0, 0.0, -3.0]);
        assert_eq!(kept(&logits, 5), [0.5, 2.0, -3.0, 0.0, -3.0]);
        assert_eq!(kept(&logits, 2), [0.5, 2.0]);
        assert!(kept(&logits, 0).is_empty());
        assert!(kept(&[], 3).is_empty());
    }

    #[test]
    fn exactly_the_cap_is_left_of_many() {
        let logits: Vec<f32> = (0..10_000).map(|i| (i * 7919 % 10_007) as f32 / 1000.0 - 5.0).collect();
        for cap in [1, 77, 5000, 9999] {
            let kept = kept(&logits, cap);
            assert_eq!(kept.len() as u64, cap);
            let least = kept.iter().copied().fold(f32::INFINITY, f32::min);
            let above = logits.iter().filter(|&&logit| logit > least + 0.05).count() as u64;
            assert!(above <= cap, "at a cap of {cap} one of {least} stays and more opaque ones went");
        }
    }
}
