//! A scene with a water surface: its three sets of disks.

use std::path::Path;

use glam::DVec3;

use super::SurfaceRecord;
use crate::gaussians::Gaussians;
use crate::ply;
use crate::{CoreError, Result};

/// Masked disks fainter than a step of 8-bit colour are no part of the dry scene.
const LEAST_OPACITY: f32 = 1.0 / 255.0;

/// A scene with a water surface.
#[derive(Clone, Debug, PartialEq)]
pub struct SurfaceModel {
    /// What cameras see straight.
    pub straight: Gaussians,
    /// `[N]` logits of the masks of the straight set: whether a disk belongs to the scene above water.
    pub masks: Vec<f32>,
    /// What the surface reflects.
    pub reflected: Gaussians,
    /// What lies in the water.
    pub refracted: Gaussians,
    /// The surface.
    pub record: SurfaceRecord,
}

impl SurfaceModel {
    /// The number of the reflected set in [`SurfaceModel::sets`].
    pub const REFLECTED: usize = 1;

    /// Disks of all sets.
    pub fn len(&self) -> usize {
        self.straight.len() + self.reflected.len() + self.refracted.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Splits every set by where its disks are.
    pub fn split_by(&self, mut is_first: impl FnMut([f32; 3]) -> bool) -> (Self, Self) {
        let sets = self.sets();
        self.split_where(|set, index| is_first(sets[set].means[index]))
    }

    /// The straight, the reflected and the refracted set.
    pub fn sets(&self) -> [&Gaussians; 3] {
        [&self.straight, &self.reflected, &self.refracted]
    }

    /// Splits every set: `is_first` gets the number of the set in [`SurfaceModel::sets`], and the index of a
    /// disk in it.
    pub fn split_where(&self, mut is_first: impl FnMut(usize, usize) -> bool) -> (Self, Self) {
        let mut masks = [Vec::new(), Vec::new()];
        let straight = self.straight.split_where(|index| {
            let first = is_first(0, index);
            masks[usize::from(!first)].extend(self.masks.get(index));
            first
        });
        let reflected = self.reflected.split_where(|index| is_first(1, index));
        let refracted = self.refracted.split_where(|index| is_first(2, index));
        let record = || self.record.clone();
        let [first_masks, other_masks] = masks;
        (
            Self {
                straight: straight.0,
                masks: first_masks,
                reflected: reflected.0,
                refracted: refracted.0,
                record: record(),
            },
            Self {
                straight: straight.1,
                masks: other_masks,
                reflected: reflected.1,
                refracted: refracted.1,
                record: record(),
            },
        )
    }

    /// Adds the disks of another part of the same scene.
    pub fn append(&mut self, other: &Self) {
        self.masks.extend(&other.masks);
        for (set, other) in [
            (&mut self.straight, &other.straight),
            (&mut self.reflected, &other.reflected),
            (&mut self.refracted, &other.refracted),
        ] {
            (0..other.len()).for_each(|index| set.push_from(other, index));
        }
    }

    /// The scene without the surface: the straight set, as far as it is above water, and what lies in the
    /// water, where it is. Every viewer shows it.
    pub fn dry(&self) -> Gaussians {
        let mut dry = Gaussians::empty(self.straight.sh_degree);
        for (index, mask) in self.masks.iter().enumerate() {
            let share = |logit: f32| 1.0 / (1.0 + (-logit).exp());
            let opacity = share(self.straight.opacity_logits[index]) * share(*mask);
            if opacity >= LEAST_OPACITY {
                dry.push_from(&self.straight, index);
                if let Some(logit) = dry.opacity_logits.last_mut() {
                    *logit = (opacity / (1.0 - opacity)).ln();
                }
            }
        }
        // No ray through the water sees those that have left it.
        let surface = self.record.surface();
        let is_below = |mean: [f32; 3]| surface.height(DVec3::from(mean.map(f64::from))) < 0.0;
        for index in (0..self.refracted.len()).filter(|&index| is_below(self.refracted.means[index])) {
            dry.push_from(&self.refracted, index);
        }
        dry
    }

    /// Its sets as files: the straight, the reflected and the refracted one. The first has the masks and the
    /// record of the surface.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn set_files(&self) -> Result<[Vec<u8>; 3]> {
        let none = || Gaussians::empty(self.straight.sh_degree);
        let base = Self { reflected: none(), refracted: none(), ..self.clone() };
        let plain = |set: &Gaussians| ply::to_bytes(set, &[ply::DISKS.to_owned()]);
        Ok([ply::surface_to_bytes(&base, &[])?, plain(&self.reflected)?, plain(&self.refracted)?])
    }

    /// Reads the sets of a result from its folder `sets`.
    ///
    /// # Errors
    /// When a file is missing or not what [`SurfaceModel::set_files`] gives.
    pub fn read_sets(folder: &Path) -> Result<Self> {
        let base = folder.join("base.ply");
        let Some(base) = ply::read_surface_model(&base)? else {
            return Err(CoreError::Scene(format!("{} has no water surface", base.display())));
        };
        let other = |name: &str| ply::read_model(&folder.join(name));
        Ok(Self { reflected: other("reflected.ply")?, refracted: other("refracted.ply")?, ..base })
    }
}
