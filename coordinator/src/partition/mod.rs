//! The cut of a scene on its x-z plane (SMP-UWGS section 3.1).
//!
//! [`plan`] is a pure function: the same views, points and configuration give the same [`Plan`], on any
//! machine and with any number of threads. It reads no file, no clock and no random number.

mod plan;

use fathom_core::config::JobConfig;
use fathom_core::scene::Points;
use fathom_core::views::TrainView;

pub use plan::*;

/// What a plan is made from.
pub struct PlanInput<'a> {
    /// All views of the scene, held-out ones too, strictly ascending by name, with their undistorted
    /// cameras at full size.
    pub views: &'a [TrainView],
    /// Sparse points; may be empty (see [`Plan::require_points`]).
    pub points: &'a Points,
    /// Resolved configuration of the job.
    pub config: &'a JobConfig,
}

/// Why there is no plan, and what helps.
#[derive(Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The configuration contradicts itself.
    #[error("{0}")]
    Config(String),
}

/// Cuts the scene.
///
/// # Errors
/// When the input cannot be cut as the configuration asks; the message says what would help.
pub fn plan(_input: &PlanInput<'_>) -> Result<Plan, PlanError> {
    Err(PlanError::Config("being written".into()))
}
