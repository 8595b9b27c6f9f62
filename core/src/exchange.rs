//! Data that the partitions of a job exchange between the first and the second part of their runs.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::scene::BlobRef;
use crate::water::Consensus;
use crate::{CoreError, Result};

/// Version of [`Exchange`]'s layout.
const FORMAT: u32 = 1;

/// The input of the second parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exchange {
    /// Version of this layout: 1.
    pub format: u32,
    /// The water for the rest of the job; `None` if partitions do not refine it.
    pub water: Option<Consensus>,
    /// By partition, the Gaussians of its own cell at the end of its first part (PLY, world axes, scene
    /// units). A partition without anything to train has no entry. Empty if partitions do not use the
    /// Gaussians of their neighbours.
    pub rows: BTreeMap<u32, BlobRef>,
}

impl Exchange {
    /// An exchange of the current format.
    pub fn new(water: Option<Consensus>, rows: BTreeMap<u32, BlobRef>) -> Self {
        Self { format: FORMAT, water, rows }
    }

    /// Reads an exchange from JSON.
    ///
    /// # Errors
    /// When the JSON is malformed or has an unsupported format.
    pub fn from_json(json: &[u8]) -> Result<Self> {
        let refuse = |why: String| CoreError::Scene(format!("the exchange of the partitions: {why}"));
        let read: Self = serde_json::from_slice(json).map_err(|error| refuse(error.to_string()))?;
        if read.format != FORMAT {
            return Err(refuse(format!("it has format {}; this program reads {FORMAT}", read.format)));
        }
        read.water.as_ref().map_or(Ok(()), Consensus::check).map_err(refuse)?;
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exchange_survives_json_and_unknown_content_is_refused() {
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
