//! A Gaussian near a border in compact form, and the test whether two of them are duplicates.

use fathom_core::config::MergeConfig;
use fathom_core::gaussians::SH_C0;
use glam::{DMat3, DQuat, DVec3};

use crate::ply_rows::Splat;
use crate::thinning::Standing;

/// A row of a partition's result: index of the partition in the plan, and of the row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RowId {
    /// Index into the plan's partitions.
    pub partition: u32,
    /// Row of its file.
    pub row: u32,
}

/// A Gaussian that may be a duplicate. Lengths are scene units, axes the scene's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Its row.
    pub id: RowId,
    /// Hash of its row.
    pub content: u64,
    /// Logit of the opacity.
    pub logit: f32,
    /// Centre.
    pub mean: [f32; 3],
    /// Maximum distance to the centre of a Gaussian that agrees with it.
    pub reach: f32,
    /// xx, xy, xz, yy, yz, zz of the covariance, at least as thick as configured.
    covariance: [f32; 6],
    /// Constant colour, without the offset of 0.5.
    colour: [f32; 3],
    /// [`Splat::set`]: two of different sets are not seen by the same rays.
    set: f32,
}

/// The first one stays: the more opaque one, among equals the one with the smaller content hash. The position
/// of the row breaks ties between bitwise equal rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rank(u32, u64, RowId);

impl Candidate {
    /// What decides whether it stays under the cap.
    pub fn standing(&self) -> Standing {
        Standing { set: self.set, logit: self.logit }
    }

    /// Its rank in the order of decisions.
    pub fn rank(&self) -> Rank {
        Rank(!ascending(self.logit), self.content, self.id)
    }

    /// The covariance for the comparison.
    fn covariance(&self) -> DMat3 {
        let [xx, xy, xz, yy, yz, zz] = self.covariance.map(f64::from);
        DMat3::from_cols_array(&[xx, xy, xz, xy, yy, yz, xz, yz, zz])
    }
}

/// An integer with the same order as a finite f32.
pub fn ascending(value: f32) -> u32 {
    let bits = value.to_bits();
    if bits >> 31 == 1 { !bits } else { bits | 1 << 31 }
}

/// The bounds of [`MergeConfig`], prepared for the checks.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    centre_squared: f64,
    width_squared: f64,
    thickness: f64,
    /// Of the coefficients.
    colour: f32,
    /// Reach of a Gaussian with standard deviation 1.
    reach: f64,
    /// Maximum difference in reach level of two Gaussians that agree, see `duplicates`.
    pub levels_apart: i32,
}

impl Bounds {
    /// The bounds of a configuration.
    pub fn new(config: &MergeConfig) -> Self {
        // For two that agree, |d|^2 <= centre^2 * (largest eigenvalue of the mean covariance), which is at
        // most that of the wider one, and at most width^2 times that of the narrower one. A small margin
        // covers rounding.
        let thickest = (1.0 + config.thickness.powi(2)).sqrt();
        Self {
            centre_squared: config.centre.powi(2),
            width_squared: config.width.powi(2),
            thickness: config.thickness,
            colour: (config.colour / f64::from(SH_C0)) as f32,
            reach: 1.0001 * config.centre * config.width * thickest,
            levels_apart: (1.001 * config.width).log2().ceil() as i32,
        }
    }

    /// Maximum distance from a Gaussian with these standard deviations to the centre of one that agrees with
    /// it.
    pub fn reach(&self, log_scales: [f32; 3]) -> f64 {
        let [x, y, z] = log_scales.map(f64::from);
        self.reach * x.max(y).max(z).exp()
    }

    /// A row as a candidate; `None` where its shape or colour is not finite, or it has no extent.
    pub fn candidate(
        &self,
        id: RowId,
        row: &[u8],
        mean: [f32; 3],
        logit: f32,
        splat: &Splat,
    ) -> Option<Candidate> {
        let [w, x, y, z] = splat.quat_wxyz.map(f64::from);
        let quat = DQuat::from_xyzw(x, y, z, w);
        if !(quat.length() > 0.0 && quat.length().is_finite()) {
            return None;
        }
        let rotation = DMat3::from_quat(quat.normalize());
        let variances = DVec3::from(splat.log_scales.map(|log| (2.0 * f64::from(log)).exp()));
        let least = self.thickness.powi(2) * variances.max_element();
        let full = rotation * DMat3::from_diagonal(variances + least) * rotation.transpose();
        let (a, b, c) = (full.x_axis, full.y_axis, full.z_axis);
        let covariance = [a.x, a.y, a.z, b.y, b.z, c.z].map(|v| v as f32);
        let reach = self.reach(splat.log_scales) as f32;
        let usable = reach > 0.0
            && reach.is_finite()
            && covariance.iter().chain(&splat.colour).all(|value| value.is_finite());
        let content = blake3::hash(row);
        let [a, b, c, d, e, f, g, h, ..] = *content.as_bytes();
        let content = u64::from_le_bytes([a, b, c, d, e, f, g, h]);
        usable.then_some(Candidate {
            id,
            content,
            logit,
            mean,
            reach,
            covariance,
            colour: splat.colour,
            set: splat.set,
        })
    }

    /// Whether two Gaussians are duplicates; symmetric.
    pub fn agree(&self, a: &Candidate, b: &Candidate) -> bool {
        let offset = DVec3::from(a.mean.map(f64::from)) - DVec3::from(b.mean.map(f64::from));
        let colours = (0..3).all(|channel| (a.colour[channel] - b.colour[channel]).abs() <= self.colour);
        if a.set != b.set || !colours || offset.length_squared() > f64::from(a.reach).powi(2) {
            return false;
        }
        let (one, other) = (a.covariance(), b.covariance());
        let within = |narrow: DMat3, wide: DMat3| is_positive(narrow * self.width_squared - wide);
        let distance = ((one + other) * 0.5).inverse() * offset;
        within(one, other) && within(other, one) && offset.dot(distance) <= self.centre_squared
    }
}

/// Whether a symmetric matrix is positive definite (Sylvester's criterion).
fn is_positive(m: DMat3) -> bool {
    let (a, b) = (m.x_axis, m.y_axis);
    a.x > 0.0 && a.x * b.y - a.y * b.x > 0.0 && m.determinant() > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLAT: [f32; 3] = [0.2, 0.2, 0.001];

    fn gaussian(mean: [f32; 3], scales: [f32; 3], quat: DQuat, colour: [f32; 3]) -> Candidate {
        let splat = Splat {
            log_scales: scales.map(f32::ln),
            quat_wxyz: [quat.w, quat.x, quat.y, quat.z].map(|v| v as f32),
            colour,
            set: 0.0,
        };
        let id = RowId { partition: 0, row: 0 };
        Bounds::new(&MergeConfig::default()).candidate(id, &[1, 2, 3], mean, 0.0, &splat).unwrap()
    }

    fn agree(a: &Candidate, b: &Candidate) -> bool {
        let bounds = Bounds::new(&MergeConfig::default());
        assert_eq!(bounds.agree(a, b), bounds.agree(b, a), "in one order only");
        bounds.agree(a, b)
    }

    #[test]
    fn bounds_are_in_the_gaussians_own_sizes() {
        for unit in [1e-4_f32, 1.0, 1e4] {
            let at = |x: f32, z: f32, scale: f32| {
                gaussian([x * unit, 0.0, z * unit], FLAT.map(|s| s * scale * unit), DQuat::IDENTITY, [0.0; 3])
            };
            let one = at(0.0, 0.0, 1.0);
            // Half a standard deviation: 0.2 along the disc, a tenth of that across it.
            assert!(agree(&one, &at(0.099, 0.0, 1.0)) && !agree(&one, &at(0.102, 0.0, 1.0)), "{unit}");
            assert!(agree(&one, &at(0.0, 0.0099, 1.0)) && !agree(&one, &at(0.0, 0.0102, 1.0)), "{unit}");
            assert!(agree(&one, &at(0.0, 0.0, 1.49)) && !agree(&one, &at(0.0, 0.0, 1.51)), "{unit}");
            assert!(agree(&one, &at(0.0, 0.0, 0.68)) && !agree(&one, &at(0.0, 0.0, 0.66)), "{unit}");
        }
    }

    #[test]
    fn orientation_counts_where_visible_and_equal_shapes_agree() {
        let of = |scales: [f32; 3], quat: DQuat| gaussian([1.0; 3], scales, quat, [0.0; 3]);
        let turned = |angle: f64| DQuat::from_rotation_x(angle.to_radians());
        let disc = of(FLAT, DQuat::IDENTITY);
        assert!(agree(&disc, &of(FLAT, DQuat::from_rotation_z(1.2))), "about its own axis");
        assert!(agree(&disc, &of(FLAT, -DQuat::IDENTITY)) && agree(&disc, &of(FLAT, turned(180.0))));
        assert!(agree(&disc, &of(FLAT, turned(4.0))) && !agree(&disc, &of(FLAT, turned(15.0))), "tilted");
        let ball = of([0.2; 3], DQuat::IDENTITY);
        assert!(agree(&ball, &of([0.2; 3], turned(77.0))), "a ball looks the same from everywhere");
        let swapped = of([0.001, 0.2, 0.2], DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2));
        assert!(agree(&disc, &swapped), "axes in another order");
        assert!(!agree(&disc, &ball), "flat and round");
    }

    #[test]
    fn colours_within_a_tenth_of_white_agree() {
        let of = |red: f32| gaussian([0.0; 3], [0.1; 3], DQuat::IDENTITY, [red / SH_C0, 0.0, 0.0]);
        assert!(agree(&of(0.3), &of(0.399)) && !agree(&of(0.3), &of(0.401)));
    }

    #[test]
    fn disks_of_different_sets_do_not_agree() {
        let one = gaussian([0.0; 3], [0.1; 3], DQuat::IDENTITY, [0.0; 3]);
        assert!(agree(&one, &one) && !agree(&one, &Candidate { set: 1.0, ..one }));
    }

    #[test]
    fn gaussians_that_agree_are_within_reach_of_each_other() {
        let narrow = gaussian([0.0; 3], [0.1; 3], DQuat::IDENTITY, [0.0; 3]);
        let wide = |x: f32| gaussian([x, 0.0, 0.0], [0.1499; 3], DQuat::IDENTITY, [0.0; 3]);
        let furthest = (0..200).rev().map(|i| i as f32 * 1e-3).find(|&x| agree(&narrow, &wide(x))).unwrap();
        assert!(furthest > 0.06 && furthest < narrow.reach && furthest < wide(0.0).reach, "{furthest}");
    }

    #[test]
    fn gaussians_without_a_shape_are_no_candidates() {
        let bounds = Bounds::new(&MergeConfig::default());
        let sound =
            Splat { log_scales: [0.0; 3], quat_wxyz: [1.0, 0.0, 0.0, 0.0], colour: [0.0; 3], set: 0.0 };
        let is_one = |splat: Splat| {
            bounds.candidate(RowId { partition: 0, row: 0 }, &[], [0.0; 3], 0.0, &splat).is_some()
        };
        assert!(is_one(sound));
        assert!(!is_one(Splat { log_scales: [f32::NAN, 0.0, 0.0], ..sound }));
        assert!(!is_one(Splat { log_scales: [0.0, 200.0, 0.0], ..sound }));
        assert!(!is_one(Splat { log_scales: [f32::NEG_INFINITY; 3], ..sound }));
        assert!(!is_one(Splat { quat_wxyz: [0.0; 4], ..sound }));
        assert!(!is_one(Splat { colour: [0.0, f32::INFINITY, 0.0], ..sound }));
    }

    #[test]
    fn the_more_opaque_one_ranks_first_and_the_hash_breaks_ties() {
        let base = gaussian([0.0; 3], [0.1; 3], DQuat::IDENTITY, [0.0; 3]);
        let of = |logit: f32, content: u64| Candidate { logit, content, ..base };
        assert!(of(2.0, 9).rank() < of(1.0, 1).rank());
        assert!(of(-1.0, 9).rank() < of(-2.0, 1).rank());
        assert!(of(0.5, 9).rank() < of(-0.5, 1).rank());
        assert!(of(1.0, 1).rank() < of(1.0, 2).rank());
    }
}
