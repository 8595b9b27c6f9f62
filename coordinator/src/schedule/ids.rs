//! Names of jobs and tasks. A task's name says what it is; nothing has to be looked up to know its kind.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Name of a job: 20 hex digits, the first 12 the milliseconds of its creation, so that names sort by time.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct JobId(String);

impl JobId {
    /// Length of every job's name, bytes.
    pub const LENGTH: usize = 20;

    /// The name of a job created at `now_ms`, told apart from others of that millisecond by `random`.
    pub fn new(now_ms: u64, random: u32) -> Self {
        Self(format!("{:012x}{random:08x}", now_ms & 0xffff_ffff_ffff))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A name that no job or task can have.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not the name of a {what}")]
pub struct ParseIdError {
    /// "job", "task", "dataset", ...
    pub what: &'static str,
    /// What was given.
    pub text: String,
}

impl FromStr for JobId {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let is_hex = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        if text.len() == Self::LENGTH && text.bytes().all(is_hex) {
            Ok(Self(text.to_owned()))
        } else {
            Err(ParseIdError { what: "job", text: text.to_owned() })
        }
    }
}

/// What a task does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskKind {
    /// Cuts the scene.
    Plan,
    /// Trains the coarse model of the whole scene.
    Global,
    /// Chooses the cameras of the partitions by what they show of the coarse model.
    Select,
    /// Trains the first part of one partition with a water of its own.
    Refine,
    /// Makes one water of those that the partitions found.
    Consensus,
    /// Trains one partition, or what is left of it after [`TaskKind::Refine`].
    Partition,
    /// Makes one model of the partitions.
    Merge,
    /// Trains what of that model lies near the borders of partitions.
    Borders,
    /// Takes the metrics on held-out views.
    Evaluate,
    /// Lays out the files for the user.
    Artifacts,
}

impl TaskKind {
    /// Kinds that the coordinator does itself.
    pub const OWN: &'static [Self] =
        &[Self::Plan, Self::Select, Self::Consensus, Self::Merge, Self::Artifacts];
    /// Kinds that are leased to workers.
    pub const WORKER: &'static [Self] =
        &[Self::Global, Self::Refine, Self::Partition, Self::Borders, Self::Evaluate];
}

/// Name of a task within its job; orders as the job goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskId {
    /// "plan".
    Plan,
    /// "global".
    Global,
    /// "select".
    Select,
    /// "refine-0003": from 0.
    Refine(u32),
    /// "consensus".
    Consensus,
    /// "partition-0003": from 0.
    Partition(u32),
    /// "merge".
    Merge,
    /// "borders".
    Borders,
    /// "evaluate".
    Evaluate,
    /// "artifacts".
    Artifacts,
}

impl TaskId {
    /// What the task does.
    pub fn kind(self) -> TaskKind {
        match self {
            Self::Plan => TaskKind::Plan,
            Self::Global => TaskKind::Global,
            Self::Select => TaskKind::Select,
            Self::Refine(_) => TaskKind::Refine,
            Self::Consensus => TaskKind::Consensus,
            Self::Partition(_) => TaskKind::Partition,
            Self::Merge => TaskKind::Merge,
            Self::Borders => TaskKind::Borders,
            Self::Evaluate => TaskKind::Evaluate,
            Self::Artifacts => TaskKind::Artifacts,
        }
    }

    /// Index of the partition; 0 for all other tasks.
    pub fn partition(self) -> u32 {
        if let Self::Partition(index) | Self::Refine(index) = self { index } else { 0 }
    }
}

impl fmt::Display for TaskId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Plan => f.write_str("plan"),
            Self::Global => f.write_str("global"),
            Self::Select => f.write_str("select"),
            Self::Refine(index) => write!(f, "refine-{index:04}"),
            Self::Consensus => f.write_str("consensus"),
            Self::Partition(index) => write!(f, "partition-{index:04}"),
            Self::Merge => f.write_str("merge"),
            Self::Borders => f.write_str("borders"),
            Self::Evaluate => f.write_str("evaluate"),
            Self::Artifacts => f.write_str("artifacts"),
        }
    }
}

impl FromStr for TaskId {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let fault = || ParseIdError { what: "task", text: text.to_owned() };
        match text {
            "plan" => Ok(Self::Plan),
            "global" => Ok(Self::Global),
            "select" => Ok(Self::Select),
            "consensus" => Ok(Self::Consensus),
            "merge" => Ok(Self::Merge),
            "borders" => Ok(Self::Borders),
            "evaluate" => Ok(Self::Evaluate),
            "artifacts" => Ok(Self::Artifacts),
            _ => {
                let (kind, index) = text.split_once('-').ok_or_else(fault)?;
                let index = index.parse().map_err(|_| fault())?;
                let id = match kind {
                    "partition" => Self::Partition(index),
                    "refine" => Self::Refine(index),
                    _ => return Err(fault()),
                };
                // Only the name that Display gives: "partition-3" and "partition-0003" would be two keys.
                if id.to_string() == text { Ok(id) } else { Err(fault()) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_reads_back_as_itself_and_no_other_name_reads() {
        for id in [
            TaskId::Plan,
            TaskId::Global,
            TaskId::Select,
            TaskId::Refine(0),
            TaskId::Refine(54321),
            TaskId::Consensus,
            TaskId::Partition(3),
            TaskId::Partition(12345),
            TaskId::Merge,
            TaskId::Borders,
            TaskId::Evaluate,
            TaskId::Artifacts,
        ] {
            assert_eq!(id.to_string().parse(), Ok(id));
        }
        for text in [
            "",
            "partition-3",
            "refine-3",
            "consensus-0000",
            "merge-0001",
            "partition-+003",
            "partition--001",
            "Plan",
            "partition-99999999999",
        ] {
            assert!(text.parse::<TaskId>().is_err(), "{text:?} reads as a task");
        }
        assert!("".parse::<JobId>().is_err());
        assert!("0193a5b2c4d17f3a9c2/".parse::<JobId>().is_err());
    }

    #[test]
    fn names_of_jobs_sort_by_the_time_of_their_creation() {
        assert!(JobId::new(1_700_000_000_000, u32::MAX) < JobId::new(1_700_000_000_001, 0));
        let id = JobId::new(1_700_000_000_000, 7);
        assert_eq!(id.as_str().parse(), Ok(id.clone()));
    }
}
