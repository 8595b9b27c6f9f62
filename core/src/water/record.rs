//! The water of a job as stored: the content of `water.json`, which every underwater model also carries in
//! its header.

use serde::{Deserialize, Serialize};

use super::{ByDirection, RangeModulation, Water};
use crate::config::{Blend, Composition, Medium};
use crate::{CoreError, Result};

/// Version of [`WaterRecord`].
const FORMAT: u32 = 2;
/// The formula in the record, without and with range modulation.
const CONSTANT: &str = "I = J*exp(-beta_d*r) + b_inf*(1-exp(-beta_b*r)), linear light, r = distance along the ray in \
                        scene units";
const REFINED: &str = "I = J*exp(-m_d*beta_d*r) + b_inf*(1-exp(-m_b*beta_b*r)), m = scale*sigmoid(w*r/unit + b) with \
                       [w, b] of attenuation for m_d and of backscatter for m_b, linear light, r = expected distance \
                       along the ray of the pixel in scene units";
/// Start of the header line.
const COMMENT: &str = "fathom_water ";

/// Three values, red, green and blue; `None` if undetermined.
pub type Known = [Option<f64>; 3];

/// Standard errors of the water parameters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StandardErrors {
    /// 1/scene unit.
    pub beta_d: Known,
    /// 1/scene unit.
    pub beta_b: Known,
    /// Linear light.
    pub b_inf: Known,
}

impl StandardErrors {
    /// From nine values in the order of eq. 8; non-finite ones are undetermined.
    pub fn from_array(errors: [f64; 9]) -> Self {
        let known = |i: usize| std::array::from_fn(|c| Some(errors[i + c]).filter(|error| error.is_finite()));
        Self { beta_d: known(0), beta_b: known(3), b_inf: known(6) }
    }

    /// All nine in the order of eq. 8; infinite if undetermined.
    pub fn to_array(&self) -> [f64; 9] {
        std::array::from_fn(|i| [self.beta_d, self.beta_b, self.b_inf][i / 3][i % 3].unwrap_or(f64::INFINITY))
    }
}

/// The water of a job and its source. Its JSON is `water.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct WaterRecord {
    /// Version of this layout: 2.
    pub format: u32,
    /// The formula, for readers of the file.
    pub image_formation: String,
    /// Where the water acts, and in which light Gaussians are blended. The file stores it in two keys,
    /// `medium` and `blend`.
    pub composition: Composition,
    /// Attenuation of the direct signal, red, green, blue, 1/scene unit of the input.
    pub beta_d: [f64; 3],
    /// Growth of the backscatter, 1/scene unit of the input.
    pub beta_b: [f64; 3],
    /// Colour of the water at infinity, linear light, sRGB primaries.
    pub b_inf: [f64; 3],
    /// One standard error of each parameter, from the sparse points, open water and the darkest pixels. For a
    /// network it is the standard deviation over the views, combined with the distance to the sparse
    /// estimate. For a consensus it includes the spread of the partitions. Null if undetermined.
    pub standard_error: StandardErrors,
    /// Source of the parameters:
    /// - `sparse`: points seen from several distances, open water and the darkest pixels;
    /// - `fixed`: the configuration;
    /// - `network`: WaterParamPredict, its mean over the training views;
    /// - `descended`: one of these, optimised with the model, each parameter in proportion to its variance in
    ///   the sparse estimate;
    /// - `consensus`: combined from the partitions, which started from the global stage. `water.json` then
    ///   also has `partitions`, a list of [`PartitionWater`](super::PartitionWater).
    pub source: String,
    /// Metres per scene unit; null if unknown.
    pub metres_per_unit: Option<f64>,
    /// `beta_d` in 1/m; null if `metres_per_unit` is unknown.
    pub beta_d_per_m: Option<[f64; 3]>,
    /// `beta_b` in 1/m; null if `metres_per_unit` is unknown.
    pub beta_b_per_m: Option<[f64; 3]>,
    /// Factors on the coefficients (also on those in 1/m), by the range of a pixel in scene units (eq. 9);
    /// absent if there are none.
    pub refinement: Option<RangeModulation>,
    /// Factors on `b_inf` by direction; absent if it is the same in all directions.
    pub by_direction: Option<ByDirection>,
    /// Whether photographs show open water with certainty; absent if they were not searched.
    pub shows_open_water: Option<bool>,
}

/// The JSON form of a [`WaterRecord`].
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    format: u32,
    image_formation: String,
    medium: Medium,
    blend: Blend,
    beta_d: [f64; 3],
    beta_b: [f64; 3],
    b_inf: [f64; 3],
    standard_error: StandardErrors,
    source: String,
    metres_per_unit: Option<f64>,
    beta_d_per_m: Option<[f64; 3]>,
    beta_b_per_m: Option<[f64; 3]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    refinement: Option<RangeModulation>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    by_direction: Option<ByDirection>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    shows_open_water: Option<bool>,
}

impl From<WaterRecord> for Written {
    fn from(record: WaterRecord) -> Self {
        Self {
            format: record.format,
            image_formation: record.image_formation,
            medium: record.composition.medium(),
            blend: record.composition.blend(),
            beta_d: record.beta_d,
            beta_b: record.beta_b,
            b_inf: record.b_inf,
            standard_error: record.standard_error,
            source: record.source,
            metres_per_unit: record.metres_per_unit,
            beta_d_per_m: record.beta_d_per_m,
            beta_b_per_m: record.beta_b_per_m,
            refinement: record.refinement,
            by_direction: record.by_direction,
            shows_open_water: record.shows_open_water,
        }
    }
}

impl TryFrom<Written> for WaterRecord {
    type Error = CoreError;

    fn try_from(written: Written) -> Result<Self> {
        let composition = Composition::of(written.medium, written.blend)?
            .ok_or_else(|| CoreError::Config("a water must act on pixels or on Gaussians".to_owned()))?;
        Ok(Self {
            format: written.format,
            image_formation: written.image_formation,
            composition,
            beta_d: written.beta_d,
            beta_b: written.beta_b,
            b_inf: written.b_inf,
            standard_error: written.standard_error,
            source: written.source,
            metres_per_unit: written.metres_per_unit,
            beta_d_per_m: written.beta_d_per_m,
            beta_b_per_m: written.beta_b_per_m,
            refinement: written.refinement,
            by_direction: written.by_direction,
            shows_open_water: written.shows_open_water,
        })
    }
}

impl WaterRecord {
    /// A record of `water` with parameters from `source`; a `metres_per_unit` of 0 means unknown.
    pub fn new(
        water: &Water,
        composition: Composition,
        standard_error: StandardErrors,
        source: &str,
        metres_per_unit: f64,
    ) -> Self {
        let metres_per_unit = (metres_per_unit > 0.0).then_some(metres_per_unit);
        let per_m = |beta: [f64; 3]| metres_per_unit.map(|metres| beta.map(|value| value / metres));
        Self {
            format: FORMAT,
            image_formation: CONSTANT.to_owned(),
            composition,
            beta_d: water.beta_d,
            beta_b: water.beta_b,
            b_inf: water.b_inf,
            standard_error,
            source: source.to_owned(),
            metres_per_unit,
            beta_d_per_m: per_m(water.beta_d),
            beta_b_per_m: per_m(water.beta_b),
            refinement: None,
            by_direction: None,
            shows_open_water: None,
        }
    }

    /// Sets the change of the open-water colour with direction.
    #[must_use]
    pub fn with_direction(self, by_direction: Option<ByDirection>) -> Self {
        Self { by_direction, ..self }
    }

    /// Sets the dependence of the coefficients on range.
    #[must_use]
    pub fn with_refinement(self, refinement: Option<RangeModulation>) -> Self {
        let formula = if refinement.is_some() { REFINED } else { CONSTANT };
        Self { image_formation: formula.to_owned(), refinement, ..self }
    }

    /// The water parameters at the scene scale, for comparison with other waters when coefficients depend on
    /// range.
    pub fn usual_water(&self) -> Water {
        self.refinement.map_or(self.water(), |refinement| refinement.at(&self.water(), refinement.unit))
    }

    /// The water parameters.
    pub fn water(&self) -> Water {
        Water { beta_d: self.beta_d, beta_b: self.beta_b, b_inf: self.b_inf }
    }

    /// The line in a model's header, without the word `comment`.
    ///
    /// # Errors
    /// When the record cannot be written as JSON.
    pub fn to_comment(&self) -> Result<String> {
        let json = serde_json::to_string(self)
            .map_err(|error| CoreError::Config(format!("the water cannot be written: {error}")))?;
        Ok(format!("{COMMENT}{json}"))
    }

    /// Whether a header comment holds a water.
    pub fn is_in(comment: &str) -> bool {
        comment.starts_with(COMMENT)
    }

    /// The record among the comments of a header; `None` if there is none.
    ///
    /// # Errors
    /// When the record is malformed or has an unsupported format.
    pub fn among(comments: &[String]) -> Result<Option<Self>> {
        let Some(json) = comments.iter().find_map(|comment| comment.strip_prefix(COMMENT)) else {
            return Ok(None);
        };
        let refuse = |why: String| CoreError::Scene(format!("the water in the model's header: {why}"));
        let record: Self = serde_json::from_str(json).map_err(|error| refuse(error.to_string()))?;
        if record.format != FORMAT {
            return Err(refuse(format!("it has format {}; this program reads {FORMAT}", record.format)));
        }
        if !record.water().is_physical() {
            return Err(refuse(format!("its water parameters are not physical: {:?}", record.water())));
        }
        if let Some(refinement) = &record.refinement
            && !(refinement.is_sound() && record.composition.acts_on_pixels())
        {
            return Err(refuse(format!(
                "its refinement must have finite numbers and act on pixels; it is {refinement:?}, and the water acts \
                 on {:?}",
                record.composition.medium()
            )));
        }
        if let Some(by_direction) = &record.by_direction
            && !by_direction.is_sound()
        {
            return Err(refuse(format!(
                "its colours by direction need finite numbers, a middle of length 1 and a limit; they are {by_direction:?}"
            )));
        }
        Ok(Some(record))
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    fn record() -> WaterRecord {
        let mut errors = [0.01; 9];
        errors[8] = f64::INFINITY;
        WaterRecord::new(
            &Water::COASTAL,
            Composition::GaussiansSrgb,
            StandardErrors::from_array(errors),
            "sparse",
            0.5,
        )
    }

    #[test]
    fn record_in_a_model_header_is_read_back_bit_for_bit() {
        let comment = record().to_comment().unwrap();
        assert!(!comment.contains('\n'));
        let found = WaterRecord::among(&["by a program".to_owned(), comment]).unwrap().unwrap();
        assert_eq!(found, record());
        assert_eq!(found.standard_error.b_inf[2], None, "undetermined errors are null");
        assert!(found.standard_error.to_array()[8].is_infinite());
        assert_eq!(found.beta_d_per_m.unwrap()[0], 0.32, "half a metre a unit");
        assert_eq!(WaterRecord::among(&["fathom".to_owned()]).unwrap(), None);
    }

    #[test]
    fn record_over_black_must_have_its_water_on_pixels() {
        let over_black = WaterRecord { composition: Composition::PixelsOverBlack, ..record() };
        let comment = over_black.to_comment().unwrap();
        assert!(comment.contains(r#""blend":"over_black""#), "{comment}");
        assert_eq!(WaterRecord::among(&[comment]).unwrap(), Some(over_black.clone()));
        for (medium, says) in [("per_gaussian", "needs water.medium"), ("none", "must act on")] {
            let json = over_black.to_comment().unwrap().replace("per_pixel", medium);
            let error = WaterRecord::among(&[json]).unwrap_err().to_string();
            assert!(error.contains(says), "{error}");
        }
    }

    #[test]
    fn refinement_is_stored_and_its_absence_is_the_identity() {
        let refinement = RangeModulation::identity(2.0, 3.2).with_array([0.1, -0.25, 1.0 / 3.0, 0.7]);
        let refined = WaterRecord { composition: Composition::PixelsSrgb, ..record() }
            .with_refinement(Some(refinement));
        let found = WaterRecord::among(&[refined.to_comment().unwrap()]).unwrap().unwrap();
        assert_eq!(found, refined);
        assert!(found.image_formation.contains("sigmoid"));
        assert_eq!(found.usual_water(), refinement.at(&Water::COASTAL, 3.2));
        assert_eq!(record().usual_water(), Water::COASTAL);
        // Records from before range modulation have no such key.
        assert!(!record().to_comment().unwrap().contains("refinement"));
        let on_gaussians = record().with_refinement(Some(refinement)).to_comment().unwrap();
        assert!(WaterRecord::among(&[on_gaussians]).unwrap_err().to_string().contains("act on pixels"));
    }

    #[test]
    fn colour_by_direction_is_stored_and_must_be_sound() {
        let by_direction =
            ByDirection { middle: [0.0, 0.0, 1.0], slopes: [[0.0, -1.0 / 3.0, 0.0]; 3], most: 0.7 };
        let directed = record().with_direction(Some(by_direction));
        assert_eq!(WaterRecord::among(&[directed.to_comment().unwrap()]).unwrap(), Some(directed));
        assert!(!record().to_comment().unwrap().contains("by_direction"));
        let broken = record().with_direction(Some(ByDirection { most: -1.0, ..by_direction }));
        let error = WaterRecord::among(&[broken.to_comment().unwrap()]).unwrap_err().to_string();
        assert!(error.contains("by direction"), "{error}");
    }

    #[test]
    fn unreadable_record_is_refused_with_the_reason() {
        let refused = |json: &str| WaterRecord::among(&[format!("{COMMENT}{json}")]).unwrap_err().to_string();
        assert!(refused("{").contains("header"));
        let mut other = record();
        for format in [1, 9] {
            other.format = format;
            assert!(refused(&serde_json::to_string(&other).unwrap()).contains(&format!("format {format}")));
        }
        let mut unphysical = record();
        unphysical.beta_d[1] = -1.0;
        assert!(refused(&serde_json::to_string(&unphysical).unwrap()).contains("not physical"));
    }
}
