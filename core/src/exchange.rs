//! What the partitions of a job give one another between the first and the second part of their runs.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::scene::BlobRef;
use crate::water::Consensus;
use crate::{CoreError, Result};

/// Version of [`Exchange`]'s layout.
const FORMAT: u32 = 1;

/// What second parts go on with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exchange {
    /// Version of this layout: 1.
    pub format: u32,
    /// The water of the rest of the job; `None` where partitions do not refine it.
    pub water: Option<Consensus>,
    /// By partition, the Gaussians of its own cell at the end of its first part (PLY, world axes, scene
    /// units); none of one that had nothing to train, and empty where partitions do not end beside their
    /// neighbours.
    pub rows: BTreeMap<u32, BlobRef>,
}

impl Exchange {
    /// Of these two.
    pub fn new(water: Option<Consensus>, rows: BTreeMap<u32, BlobRef>) -> Self {
        Self { format: FORMAT, water, rows }
    }

    /// Reads what was written as JSON.
    ///
    /// # Errors
    /// When it is none that this program can read.
    pub fn from_json(json: &[u8]) -> Result<Self> {
        let refuse = |why: String| CoreError::Scene(format!("the exchange of the partitions: {why}"));
        let read: Self = serde_json::from_slice(json).map_err(|error| refuse(error.to_string()))?;
        if read.format != FORMAT {
            return Err(refuse(format!("it has format {}, and this program reads {FORMAT}", read.format)));
        }
        read.water.as_ref().map_or(Ok(()), Consensus::check).map_err(refuse)?;
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_and_what_is_not_understood_is_refused() {
        let rows = BTreeMap::from([(3, BlobRef { digest: "ab".repeat(32), bytes: 7 })]);
        let exchange = Exchange::new(None, rows);
        let json = serde_json::to_string(&exchange).unwrap();
        assert_eq!(Exchange::from_json(json.as_bytes()).unwrap(), exchange);
        for wrong in
            [json.replace("\"format\":1", "\"format\":2"), json.replace("rows", "columns"), "{}".into()]
        {
            let error = Exchange::from_json(wrong.as_bytes()).unwrap_err().to_string();
            assert!(error.contains("exchange of the partitions"), "{error}");
        }
    }
}
