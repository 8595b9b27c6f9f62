//! Names of jobs and tasks. A task's name contains its stage, so no lookup is needed.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{Stage, Tasks};

/// Name of a job: 20 hex digits, the first 12 the milliseconds of its creation, so that names sort by time.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct JobId(String);

impl JobId {
    /// Length of every job's name, bytes.
    pub const LENGTH: usize = 20;

    /// The name of a job created at `now_ms`; `random` distinguishes it from others of that millisecond.
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
    /// The text given.
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

/// Name of a task within its job; orders as the job goes. Written as the name of its stage ("merge"). The
/// index of the partition follows where the stage has one task for each ("partition-0003"), and the number of
/// the part where several tasks evaluate ("evaluate-0001").
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskId {
    /// The stage that it belongs to.
    pub stage: Stage,
    /// Index of the partition, from 0, exactly where the stage has one task for each partition. Number of the
    /// part of the held-out views, from 1, where several tasks evaluate.
    pub part: Option<u32>,
}

impl Stage {
    /// The only task of this stage.
    pub const fn task(self) -> TaskId {
        TaskId { stage: self, part: None }
    }

    /// The task of this stage for a partition, or for a part of the held-out views.
    pub const fn task_of(self, part: u32) -> TaskId {
        TaskId { stage: self, part: Some(part) }
    }

    /// Whether it may have a task with this part.
    fn has(self, part: Option<u32>) -> bool {
        match self.spec().tasks {
            Tasks::One => part.is_none(),
            Tasks::Partitions => part.is_some(),
            Tasks::Views => part != Some(0),
        }
    }

    /// The task with a number, of which a store makes its keys; `None` if there is none. See
    /// [`TaskId::number`].
    pub fn numbered(self, number: u32) -> Option<TaskId> {
        let without = self.task();
        match number {
            0 if self.has(None) => Some(without),
            _ => Some(self.task_of(number)).filter(|id| self.has(id.part)),
        }
    }
}

impl TaskId {
    /// Its number among the tasks of its stage, for keys of a store: its part, or 0.
    pub fn number(self) -> u32 {
        self.part.unwrap_or(0)
    }
}

impl fmt::Display for TaskId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.part {
            None => f.write_str(self.stage.name()),
            Some(index) => write!(f, "{}-{index:04}", self.stage.name()),
        }
    }
}

impl FromStr for TaskId {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let fault = || ParseIdError { what: "task", text: text.to_owned() };
        let (name, part) = match text.split_once('-') {
            None => (text, None),
            Some((name, index)) => (name, Some(index.parse().map_err(|_| fault())?)),
        };
        let stage = Stage::all().find(|stage| stage.name() == name).ok_or_else(fault)?;
        let id = Self { stage, part };
        // Only the canonical form of Display: "partition-3" and "partition-0003" would be two keys.
        if stage.has(part) && id.to_string() == text { Ok(id) } else { Err(fault()) }
    }
}

impl Serialize for TaskId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for TaskId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_reads_back_as_itself_and_no_other_name_reads() {
        for stage in Stage::all() {
            let ids = match stage.spec().tasks {
                Tasks::One => vec![stage.task()],
                Tasks::Partitions => vec![stage.task_of(0), stage.task_of(3), stage.task_of(54321)],
                Tasks::Views => vec![stage.task(), stage.task_of(1), stage.task_of(54321)],
            };
            for id in ids {
                assert_eq!(id.to_string().parse(), Ok(id));
                let json = serde_json::to_string(&id).unwrap_or_default();
                assert_eq!(serde_json::from_str::<TaskId>(&json).ok(), Some(id));
            }
        }
        for text in [
            "",
            "partition",
            "partition-3",
            "first_part-3",
            "exchange-0000",
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
