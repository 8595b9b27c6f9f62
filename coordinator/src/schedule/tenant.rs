//! Tenants and their quotas.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::ParseIdError;

/// The owner of a job: a group of users whose data is invisible to others. 1 to 40 lower-case letters, digits
/// and hyphens, a letter first.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Tenant(String);

impl Tenant {
    /// Longest name, bytes. It is the name of a folder.
    pub const MAX_BYTES: usize = 40;

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether it is the default tenant.
    pub fn is_default(&self) -> bool {
        self.0 == "default"
    }
}

/// The tenant of everything where tenants are not used.
impl Default for Tenant {
    fn default() -> Self {
        Self("default".to_owned())
    }
}

impl fmt::Display for Tenant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for Tenant {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let begins_well = text.bytes().next().is_some_and(|b| b.is_ascii_lowercase());
        let may_stand = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
        if begins_well && text.len() <= Self::MAX_BYTES && text.bytes().all(may_stand) {
            Ok(Self(text.to_owned()))
        } else {
            Err(ParseIdError { what: "tenant", text: text.to_owned() })
        }
    }
}

impl TryFrom<String> for Tenant {
    type Error = ParseIdError;

    fn try_from(text: String) -> Result<Self, ParseIdError> {
        text.parse()
    }
}

impl From<Tenant> for String {
    fn from(tenant: Tenant) -> Self {
        tenant.0
    }
}

/// Limits of a tenant; 0 is no limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quota {
    /// Maximum number of jobs that have not ended.
    pub max_open_jobs: u32,
    /// Maximum number of leased tasks.
    pub max_parallel: u32,
    /// Maximum bytes of photographs, checkpoints and results.
    pub max_bytes: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tenant_is_a_name_that_can_be_a_folder_everywhere() {
        for good in ["default", "reef-2026", "a", &"a".repeat(40)] {
            assert_eq!(good.parse::<Tenant>().map(|tenant| tenant.to_string()).as_deref(), Ok(good));
        }
        for wrong in ["", "Reef", "a/b", "..", "-a", "7seas", "a b", "a\0", "\u{e4}", &"a".repeat(41)] {
            assert!(wrong.parse::<Tenant>().is_err(), "{wrong:?}");
        }
        assert!(serde_json::from_str::<Tenant>("\"../etc\"").is_err());
    }
}
