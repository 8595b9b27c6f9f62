//! Bearer tokens: random, shown once, stored as digests.

use std::fmt;

use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::{Principal, Role};
use crate::schedule::{JobId, Tenant};

/// Prefix of every token, so that secret scanners find committed ones.
const PREFIX: &str = "fathom";
/// Longest name, bytes.
const MAX_NAME_BYTES: usize = 200;
/// Longest lifetime, seconds: a hundred years, so that its end is representable.
const MAX_LIFE_SECONDS: u64 = 100 * 366 * 24 * 60 * 60;
/// Hex digits of an id.
const ID_LENGTH: usize = 12;
/// Hex digits of a secret: two random UUIDs with 244 random bits.
const SECRET_LENGTH: usize = 64;

/// A token as it is shown once: `fathom_ID_SECRET`.
#[derive(Clone, PartialEq, Eq)]
pub struct Token {
    id: String,
    secret: String,
}

/// Never prints the secret: debug output ends up in logs.
impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Token").field("id", &self.id).finish_non_exhaustive()
    }
}

impl Token {
    /// A new one.
    pub fn random() -> Self {
        let mut id = Uuid::new_v4().simple().to_string();
        id.truncate(ID_LENGTH);
        Self { id, secret: format!("{}{}", Uuid::new_v4().simple(), Uuid::new_v4().simple()) }
    }

    /// Parses a token; `None` when it is malformed.
    pub fn parse(text: &str) -> Option<Self> {
        let is_hex = |text: &str, length| {
            text.len() == length && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
        };
        let (id, secret) = text.strip_prefix(PREFIX)?.strip_prefix('_')?.split_once('_')?;
        (is_hex(id, ID_LENGTH) && is_hex(secret, SECRET_LENGTH))
            .then(|| Self { id: id.to_owned(), secret: secret.to_owned() })
    }

    /// Its id; not secret.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The whole token, to be shown once to its holder.
    pub fn reveal(&self) -> String {
        format!("{PREFIX}_{}_{}", self.id, self.secret)
    }

    /// Whether both are the same token. Comparing the secrets takes constant time.
    pub fn same_as(&self, other: &Self) -> bool {
        self.digest() == other.digest() && self.id == other.id
    }

    /// The stored digest. The secret is random and long, so a slow hash would not help.
    fn digest(&self) -> blake3::Hash {
        blake3::hash(self.secret.as_bytes())
    }
}

/// Invalid settings of a token.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct IssueError {
    /// The invalid field.
    pub field: &'static str,
    /// The fault, and a remedy.
    pub message: String,
}

/// A token as it is stored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenRecord {
    /// Its id.
    pub id: String,
    /// Its purpose or holder, free text.
    pub name: String,
    /// Its role.
    pub role: Role,
    /// Its tenant; `None`: all tenants.
    pub tenant: Option<Tenant>,
    /// BLAKE3 of the secret, hex.
    pub digest: String,
    /// When it was issued, Unix milliseconds.
    pub created_ms: u64,
    /// When it ends, Unix milliseconds; `None`: never.
    pub expires_ms: Option<u64>,
    /// When it was revoked, Unix milliseconds.
    pub revoked_ms: Option<u64>,
    /// The only job that it reads: the token of a link. `None`: all of its tenant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub job: Option<JobId>,
    /// Of a link: the token with which it was made, without which it is not valid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub issued_by: Option<String>,
}

impl TokenRecord {
    /// The record of `token`.
    pub fn new(
        token: &Token,
        name: String,
        role: Role,
        tenant: Option<Tenant>,
        created_ms: u64,
        expires_ms: Option<u64>,
    ) -> Self {
        let digest = token.digest().to_hex().to_string();
        Self {
            id: token.id.clone(),
            name,
            role,
            tenant,
            digest,
            created_ms,
            expires_ms,
            revoked_ms: None,
            job: None,
            issued_by: None,
        }
    }

    /// Makes the token of a link to one job, which reads this job until it expires.
    pub fn of_link(
        job: JobId,
        tenant: Tenant,
        by: &Principal,
        created_ms: u64,
        expires_ms: u64,
    ) -> (Token, Self) {
        let token = Token::random();
        let mut name = format!("link to {job} by {}", by.name);
        name.truncate(name.floor_char_boundary(MAX_NAME_BYTES));
        let record = Self::new(&token, name, Role::Viewer, Some(tenant), created_ms, Some(expires_ms));
        (token, Self { job: Some(job), issued_by: by.token_id.clone(), ..record })
    }

    /// Whether it is the token of a link that has ended before a time.
    pub fn is_link_ended_before(&self, before_ms: u64) -> bool {
        let ended_ms = self.revoked_ms.into_iter().chain(self.expires_ms).min();
        self.job.is_some() && ended_ms.is_some_and(|ended_ms| ended_ms < before_ms)
    }

    /// Makes a token that lasts `expires_in_seconds` (0: forever), for a tenant, or for all if `tenant` is
    /// empty. Returns it with its record.
    ///
    /// # Errors
    /// When a setting is invalid, with the name of its field.
    pub fn issue(
        name: String,
        role: Role,
        tenant: &str,
        expires_in_seconds: u64,
        now_ms: u64,
    ) -> Result<(Token, Self), IssueError> {
        let wrong = |field, message: &str| IssueError { field, message: message.to_owned() };
        if name.trim().is_empty() || name.len() > MAX_NAME_BYTES || name.contains(char::is_control) {
            return Err(wrong("name", "must name the holder or purpose of the token in 1 to 200 bytes"));
        }
        if expires_in_seconds > MAX_LIFE_SECONDS {
            return Err(wrong("expires_in_seconds", "is more than a hundred years; 0 means forever"));
        }
        let tenant = Some(tenant).filter(|tenant| !tenant.is_empty()).map(str::parse::<Tenant>);
        let tenant = tenant.transpose().map_err(|error| wrong("tenant", &error.to_string()))?;
        if tenant.is_none() && matches!(role, Role::Viewer | Role::Submitter) {
            return Err(wrong("tenant", "is missing; only operators and workers can be without a tenant"));
        }
        let token = Token::random();
        let expires_ms = (expires_in_seconds > 0).then(|| now_ms + 1000 * expires_in_seconds);
        let record = Self::new(&token, name, role, tenant, now_ms, expires_ms);
        Ok((token, record))
    }

    /// Whether it belongs to an operator of all tenants: only these can issue others.
    pub fn makes_tokens(&self) -> bool {
        self.role == Role::Operator && self.tenant.is_none()
    }

    /// Whether it is valid now.
    pub fn holds_at(&self, now_ms: u64) -> bool {
        self.revoked_ms.is_none() && self.expires_ms.is_none_or(|expires_ms| now_ms < expires_ms)
    }

    /// Whether `token` is this one. The comparison takes constant time.
    pub fn is_of(&self, token: &Token) -> bool {
        let stored = blake3::Hash::from_hex(&self.digest);
        stored.is_ok_and(|stored| stored == token.digest()) && self.id == token.id
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_reads_back_and_is_known_by_its_digest_alone() {
        let (token, other) = (Token::random(), Token::random());
        let text = token.reveal();
        assert_eq!(Token::parse(&text).as_ref(), Some(&token));
        let record = TokenRecord::new(&token, "ci".into(), Role::Submitter, None, 1, None);
        assert!(record.is_of(&token) && !record.is_of(&other));
        let forged = Token { id: token.id.clone(), ..other };
        assert!(!record.is_of(&forged), "the id alone is enough");
        let stored = serde_json::to_string(&record).unwrap_or_default();
        assert!(!stored.contains(&token.secret), "the secret is stored");
        assert!(!format!("{token:?}").contains(&token.secret), "the secret is printed");
    }

    #[test]
    fn malformed_tokens_do_not_parse() {
        let good = Token::random().reveal();
        for wrong in ["", "fathom", "fathom__", &good[1..], &good[..good.len() - 1], &good.to_uppercase()] {
            assert_eq!(Token::parse(wrong), None, "{wrong}");
        }
        assert_eq!(Token::parse(&format!("{good} ")), None);
    }

    #[test]
    fn invalid_token_settings_are_refused_by_field() {
        let issue =
            |name: &str, role, tenant, seconds| TokenRecord::issue(name.to_owned(), role, tenant, seconds, 5);
        let field = |issued: Result<_, IssueError>| issued.err().map(|error| error.field);
        assert_eq!(field(issue(" ", Role::Worker, "", 0)), Some("name"));
        assert_eq!(field(issue(&"x".repeat(201), Role::Worker, "", 0)), Some("name"));
        assert_eq!(field(issue("ci", Role::Viewer, "", 0)), Some("tenant"));
        assert_eq!(field(issue("ci", Role::Viewer, "../reef", 0)), Some("tenant"));
        assert_eq!(field(issue("ci", Role::Worker, "", u64::MAX)), Some("expires_in_seconds"));
        let issued =
            issue("ci", Role::Viewer, "reef", 2).map(|(token, record)| (record.is_of(&token), record));
        assert!(issued.is_ok_and(|(is_its, record)| is_its && record.expires_ms == Some(2005)));
    }

    #[test]
    fn a_token_holds_until_it_expires_or_is_revoked() {
        let record = TokenRecord::new(&Token::random(), "ci".into(), Role::Viewer, None, 1, Some(10));
        assert!(record.holds_at(9) && !record.holds_at(10));
        assert!(!TokenRecord { revoked_ms: Some(5), ..record }.holds_at(6));
    }
}
