//! Who may call what: tokens, roles and tenants.

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
pub use rate::RateLimit;
pub use table::{Access, Refused};
pub use token::{IssueError, Token, TokenRecord};

use crate::schedule::{ParseIdError, Tenant};

/// What somebody may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Looks at the jobs of its tenant and fetches their results.
    Viewer,
    /// What viewers do, uploads, creates jobs and steers them.
    Submitter,
    /// Everything that people do, of all tenants or of its own; workers, quotas and tokens only when it is of all.
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

/// Who calls.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Principal {
    /// For people: the name of the token.
    pub name: String,
    /// What they may do.
    pub role: Role,
    /// Whose jobs they see; `None`: all.
    pub tenant: Option<Tenant>,
    /// The token that they showed; `None` where none is asked for.
    pub token_id: Option<String>,
}

impl Principal {
    /// Everybody, where no tokens are asked for.
    pub fn anybody() -> Self {
        Self { name: "anybody".to_owned(), role: Role::Operator, tenant: None, token_id: None }
    }

    /// Whether they may know of what a tenant has.
    pub fn sees(&self, tenant: &Tenant) -> bool {
        self.tenant.as_ref().is_none_or(|own| own == tenant)
    }

    /// Whose what they make is, unless they say otherwise.
    pub fn home(&self) -> Tenant {
        self.tenant.clone().unwrap_or_default()
    }
}
