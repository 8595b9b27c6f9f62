//! The method of a job: the representation of a scene, and its training.

use serde::{Deserialize, Serialize};

/// The method that trains a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Method {
    /// 3D Gaussian splats, with or without a medium.
    #[default]
    Splats,
    /// 2D Gaussians: disks on surfaces (2DGS, Huang et al. 2024).
    #[serde(rename = "2dgs")]
    Disks,
    /// Disks in air and below a calm water surface that reflects and refracts (WSGS).
    #[serde(rename = "wsgs")]
    Surface,
}

impl Method {
    /// Every method of this program.
    pub const ALL: [Self; 3] = [Self::Splats, Self::Disks, Self::Surface];

    /// Its name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::Splats => "splats",
            Self::Disks => "2dgs",
            Self::Surface => "wsgs",
        }
    }

    /// Whether it looks through a water surface. Its jobs need the pixels where photographs see sparse
    /// points.
    pub fn through_surface(self) -> bool {
        match self {
            Self::Splats | Self::Disks => false,
            Self::Surface => true,
        }
    }
}

impl From<Method> for String {
    fn from(method: Method) -> Self {
        method.name().to_owned()
    }
}

impl TryFrom<String> for Method {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        let names = Self::ALL.map(|method| format!("{:?}", method.name())).join(", ");
        let known = Self::ALL.into_iter().find(|method| method.name() == name);
        known.ok_or_else(|| format!("there is no method {name:?}; the available methods are {names}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::JobConfig;

    #[test]
    fn a_job_trains_splats_unless_it_names_another_method() {
        let of = |json: &str| JobConfig::from_json(json).map(|config| config.method);
        assert_eq!(of("{}").ok(), Some(Method::Splats));
        for method in Method::ALL {
            assert_eq!(of(&format!(r#"{{"method": "{}"}}"#, method.name())).ok(), Some(method));
        }
    }

    #[test]
    fn unknown_method_is_refused_with_the_available_ones() {
        let error = JobConfig::from_json(r#"{"method": "fields"}"#).err().map(|error| error.to_string());
        let error = error.unwrap_or_default();
        assert!(error.contains(r#"no method "fields""#) && error.contains(r#""splats""#), "{error}");
    }
}
