//! The record of a trained water surface: `surface.json`, and a comment in the header of its model.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{AIR, Surface};
use crate::config::{Reflectance, SurfaceJoin, SurfaceLight};
use crate::{CoreError, Result};

/// Start of the header comment that holds the record.
const COMMENT: &str = "fathom_surface ";
/// Version of the record.
const FORMAT: u32 = 1;

/// Where a surface comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceSource {
    /// From the tracks of the sparse points.
    Tracks,
    /// From the rule of the paper.
    Paper,
    /// From the configuration.
    Given,
}

/// A trained water surface. Lengths are in scene units, directions in scene axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurfaceRecord {
    /// Version of this record.
    pub format: u32,
    /// Unit normal into the air.
    pub normal: [f64; 3],
    /// The surface is where `normal . x = offset`.
    pub offset: f64,
    /// Refractive index of the water.
    pub ior: f64,
    /// How much light it reflects.
    pub reflectance: Reflectance,
    /// How reflected and refracted light add.
    pub light: SurfaceLight,
    /// How the scene above water lies over the water.
    pub join: SurfaceJoin,
    /// Where it comes from.
    pub source: SurfaceSource,
    /// Standard error of the offset at the start; null if it was given.
    pub offset_error: Option<f64>,
    /// Standard error of the normal at the start, degrees; null if it was given.
    pub tilt_error_degrees: Option<f64>,
}

impl SurfaceRecord {
    /// The record of a surface that was given, with exact reflectance in linear light.
    pub fn given(surface: &Surface) -> Self {
        Self {
            format: FORMAT,
            normal: surface.normal.to_array(),
            offset: surface.offset,
            ior: surface.ior,
            reflectance: Reflectance::default(),
            light: SurfaceLight::default(),
            join: SurfaceJoin::default(),
            source: SurfaceSource::Given,
            offset_error: None,
            tilt_error_degrees: None,
        }
    }

    /// The plane and its index.
    pub fn surface(&self) -> Surface {
        Surface { normal: DVec3::from(self.normal), offset: self.offset, ior: self.ior }
    }

    /// The same of a surface that has moved.
    #[must_use]
    pub fn at(self, surface: &Surface) -> Self {
        Self { normal: surface.normal.to_array(), offset: surface.offset, ior: surface.ior, ..self }
    }

    /// The line in a model's header, without the word `comment`.
    ///
    /// # Errors
    /// When the record cannot be written as JSON.
    pub fn to_comment(&self) -> Result<String> {
        let json = serde_json::to_string(self)
            .map_err(|error| CoreError::Config(format!("the water surface cannot be written: {error}")))?;
        Ok(format!("{COMMENT}{json}"))
    }

    /// The record among the comments of a header; `None` if there is none.
    ///
    /// # Errors
    /// When the record is malformed or has an unsupported format.
    pub fn among(comments: &[String]) -> Result<Option<Self>> {
        match comments.iter().find_map(|comment| comment.strip_prefix(COMMENT)) {
            None => Ok(None),
            Some(json) => Self::from_json(json).map(Some),
        }
    }

    /// A record from JSON.
    ///
    /// # Errors
    /// When it is malformed, has an unsupported format, or is no surface.
    pub fn from_json(json: &str) -> Result<Self> {
        let refuse = |why: String| CoreError::Scene(format!("the record of the water surface: {why}"));
        let record: Self = serde_json::from_str(json).map_err(|error| refuse(error.to_string()))?;
        if record.format != FORMAT {
            return Err(refuse(format!("it has format {}; this program reads {FORMAT}", record.format)));
        }
        let length = DVec3::from(record.normal).length();
        let is_sound = (length - 1.0).abs() < 1e-3
            && record.offset.is_finite()
            && record.ior.is_finite()
            && record.ior > AIR;
        if !is_sound {
            return Err(refuse(format!(
                "the normal must have length 1 and the index must be above that of air: {record:?}"
            )));
        }
        Ok(record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record() -> SurfaceRecord {
        let surface = Surface { normal: DVec3::new(0.0, -0.6, 0.8), offset: 1.0 / 3.0, ior: 1.333 };
        SurfaceRecord {
            source: SurfaceSource::Tracks,
            offset_error: Some(1e-4),
            ..SurfaceRecord::given(&surface)
        }
    }

    #[test]
    fn a_surface_in_a_model_header_is_read_back_bit_for_bit() {
        let comment = record().to_comment().unwrap();
        assert!(!comment.contains('\n'));
        assert_eq!(SurfaceRecord::among(&["other".to_owned(), comment]).unwrap(), Some(record()));
        assert_eq!(SurfaceRecord::among(&["other".to_owned()]).unwrap(), None);
    }

    #[test]
    fn records_that_are_no_surface_are_refused() {
        for (wrong, says) in [
            (SurfaceRecord { format: 9, ..record() }, "format 9"),
            (SurfaceRecord { normal: [0.0, 0.0, 2.0], ..record() }, "length 1"),
            (SurfaceRecord { ior: 0.9, ..record() }, "above that of air"),
        ] {
            let error = SurfaceRecord::among(&[wrong.to_comment().unwrap()]).unwrap_err().to_string();
            assert!(error.contains(says), "{error}");
        }
        assert!(SurfaceRecord::from_json("{}").unwrap_err().to_string().contains("format"));
    }
}
