//! FiLM: factors on a training view's picture before the loss (SMP-UWGS section 3.3, eq. 10).

use serde::{Deserialize, Serialize};

/// View embeddings. They absorb differences between photographs (light, drifting particles, exposure);
/// held-out views and exports have none. Only with a medium. Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilmConfig {
    /// Whether each training view has an embedding that modulates a small predictor of colour factors.
    /// Default false; true in the preset `paper`. Cannot be combined with `train.exposure`: both learn the
    /// brightness of a view.
    pub on: bool,
    /// Side of the cells in which the predictor sees one colour, pixels of the training picture. Default 32
    /// (VastGaussian, SMP-UWGS's code). A picture is divided into round(side / cell) parts along each axis,
    /// at least one, whose sizes differ by at most one pixel.
    pub cell: u32,
    /// Share of the run from which embeddings are trained, beginning with the first epoch that starts there.
    /// Default 0.
    pub from: f32,
    /// Share of the run after which embeddings are fixed. Default 1.
    pub until: f32,
    /// Learning rate of Adam at `from`, for the weights and for the embedding of each view when it is seen.
    /// Default 1e-3 (VastGaussian). For embeddings it is multiplied by the square root of the number of
    /// views, at most by 8 (as for exposures).
    pub lr: f32,
    /// Learning rate at `until`, with exponential decay. Default 1e-4. At a constant rate, a model remains
    /// biased towards the last views.
    pub lr_end: f32,
}

impl Default for FilmConfig {
    fn default() -> Self {
        Self { on: false, cell: 32, from: 0.0, until: 1.0, lr: 1e-3, lr_end: 1e-4 }
    }
}

impl FilmConfig {
    /// With view embeddings, as in the paper.
    pub fn paper() -> Self {
        Self { on: true, ..Self::default() }
    }

    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        require((8..=4096).contains(&self.cell), "water.film.cell must be 8 to 4096 pixels");
        for (name, rate) in [("lr", self.lr), ("lr_end", self.lr_end)] {
            let fault = format!("water.film.{name} must be a finite number, 0 or more");
            require(rate >= 0.0 && rate.is_finite(), &fault);
        }
        for (name, share) in [("from", self.from), ("until", self.until)] {
            let fault = format!("water.film.{name} must be a share of the run, from 0 to 1");
            require((0.0..=1.0).contains(&share), &fault);
        }
        require(self.from <= self.until, "water.film.from must not be after water.film.until");
    }
}

#[cfg(test)]
mod tests {
    use super::super::{JobConfig, Medium, Preset};
    use super::*;

    #[test]
    fn exposures_and_film_are_refused_together() {
        let mut config = JobConfig::of_preset(Preset::Paper);
        assert!(config.water.film.on && config.validate().is_ok());
        config.train.exposure = true;
        let refused = config.validate().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(refused.contains("train.exposure") && refused.contains("water.film.on"), "{refused}");
        config.water.medium = Medium::None;
        assert!(config.validate().is_ok(), "without a medium there is no FiLM");
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        let mut config = JobConfig::default();
        config.water.film = FilmConfig {
            cell: 4,
            from: 0.9,
            until: 0.1,
            lr: -1.0,
            lr_end: f32::NAN,
            ..FilmConfig::default()
        };
        let refused = config.validate().err().map(|error| error.to_string()).unwrap_or_default();
        for name in ["cell", "from", "lr", "lr_end"] {
            assert!(refused.contains(&format!("water.film.{name} ")), "{name}: {refused}");
        }
    }
}
