//! The first token, which can issue all others.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use super::{Role, Token, TokenRecord};
use crate::error::CoordinatorError;
use crate::store::Store;

/// Name of its file in the data directory.
const FILE: &str = "operator.token";

/// Issues a token for an operator of all tenants if there is no valid one, and writes it to a file that only
/// the owner of the process can read. Returns the path of the file if it did.
///
/// # Errors
/// When the file or the store cannot be written.
pub async fn ensure_operator(
    store: &dyn Store,
    data_dir: &Path,
    now_ms: u64,
) -> Result<Option<PathBuf>, CoordinatorError> {
    let is_one = |token: &TokenRecord| token.makes_tokens() && token.holds_at(now_ms);
    if store.tokens().await?.iter().any(is_one) {
        return Ok(None);
    }
    let token = Token::random();
    let path = data_dir.join(FILE);
    // The file first: a token that is stored but written nowhere would lock out everyone for good.
    write_secret(&path, &token.reveal()).map_err(|error| {
        CoordinatorError::Server(format!("cannot write the first token to {}: {error}", path.display()))
    })?;
    let record = TokenRecord::new(&token, "first operator".into(), Role::Operator, None, now_ms, None);
    store.put_token(&record).await?;
    Ok(Some(path))
}

/// Writes a file that no other user can read, completely or not at all.
pub(crate) fn write_secret(path: &Path, secret: &str) -> std::io::Result<()> {
    let staged = path.with_added_extension("new");
    if staged.exists() {
        std::fs::remove_file(&staged)?;
    }
    let mut file = create_private(&staged)?;
    writeln!(file, "{secret}")?;
    file.sync_all()?;
    std::fs::rename(&staged, path)
}

#[cfg(unix)]
fn create_private(path: &Path) -> std::io::Result<File> {
    use std::os::unix::fs::OpenOptionsExt as _;
    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)
}

/// Without file modes, the folder's permissions decide.
#[cfg(not(unix))]
fn create_private(path: &Path) -> std::io::Result<File> {
    OpenOptions::new().write(true).create_new(true).open(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Rules;
    use crate::store::{AccessStore, SledOptions, SledStore};

    #[tokio::test]
    async fn there_is_an_operator_and_only_its_owner_can_read_the_token() {
        let dir = tempfile::tempdir().unwrap();
        let options = SledOptions {
            dir: dir.path().join("store"),
            rules: Rules::default(),
            lease_ms: 1000,
            stall_ms: 0,
        };
        let store = SledStore::open(&options).unwrap();
        let path = ensure_operator(&store, dir.path(), 5).await.unwrap().unwrap();
        let token = Token::parse(std::fs::read_to_string(&path).unwrap().trim()).unwrap();
        let stored = store.tokens().await.unwrap();
        assert!(stored.len() == 1 && stored[0].is_of(&token) && stored[0].role == Role::Operator);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt as _;
            assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        }
        assert_eq!(ensure_operator(&store, dir.path(), 6).await.unwrap(), None, "a second one");

        let revoked = TokenRecord { revoked_ms: Some(7), ..stored[0].clone() };
        store.put_token(&revoked).await.unwrap();
        assert_eq!(ensure_operator(&store, dir.path(), 8).await.unwrap(), Some(path.clone()));
        assert_ne!(Token::parse(std::fs::read_to_string(&path).unwrap().trim()), Some(token));
    }
}
