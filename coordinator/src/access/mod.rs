//! Authentication and authorisation: tokens, roles and tenants.

pub mod calls;
mod first;
pub mod guard;
pub mod places;
mod rate;
mod table;
mod token;

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

pub use first::ensure_operator;
pub(crate) use first::write_secret;
pub use rate::RateLimit;
pub use table::{Access, Refused};
pub use token::{IssueError, Token, TokenRecord};

use crate::schedule::{JobId, ParseIdError, Tenant};

/// The role of a caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Reads the jobs of its tenant and fetches their results.
    Viewer,
    /// Does what viewers do; also uploads, creates jobs and controls them.
    Submitter,
    /// All calls of users, for all tenants or its own; workers, quotas and tokens only without a tenant.
    Operator,
    /// Takes tasks, of all tenants or of its own.
    Worker,
}

impl Role {
    /// All roles.
    pub const ALL: [Self; 4] = [Self::Viewer, Self::Submitter, Self::Operator, Self::Worker];
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Viewer => "viewer",
            Self::Submitter => "submitter",
            Self::Operator => "operator",
            Self::Worker => "worker",
        })
    }
}

impl FromStr for Role {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let found = Self::ALL.into_iter().find(|role| role.to_string() == text);
        found.ok_or_else(|| ParseIdError { what: "role", text: text.to_owned() })
    }
}

/// A caller.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Principal {
    /// The name of the token, for display.
    pub name: String,
    /// Its role.
    pub role: Role,
    /// The tenant whose jobs it sees; `None`: all.
    pub tenant: Option<Tenant>,
    /// The id of its token; `None` where none is required.
    pub token_id: Option<String>,
    /// The only job that it sees; `None`: all of its tenant.
    pub job: Option<JobId>,
}

impl Principal {
    /// The caller where no tokens are required.
    pub fn anonymous() -> Self {
        Self { name: "anybody".to_owned(), role: Role::Operator, tenant: None, token_id: None, job: None }
    }

    /// Whether it may see a job, if the job is one of a tenant that it sees.
    pub fn sees_job(&self, job: &JobId) -> bool {
        self.job.as_ref().is_none_or(|own| own == job)
    }

    /// Whether it may see objects of a tenant.
    pub fn sees(&self, tenant: &Tenant) -> bool {
        self.tenant.as_ref().is_none_or(|own| own == tenant)
    }

    /// The tenant of new objects, unless the call names another.
    pub fn home(&self) -> Tenant {
        self.tenant.clone().unwrap_or_default()
    }
}
