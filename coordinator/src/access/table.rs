//! All tokens in memory, because every call needs them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{PoisonError, RwLock};
use std::time::Duration;

use tokio::sync::watch;

use super::{Principal, Role, Token, TokenRecord};
use crate::clock::Clock;
use crate::schedule::Tenant;
use crate::store::{AccessStore, StoreError};

/// The tokens. They are also stored; the store is written first.
pub struct Access {
    /// By id; `None` where no tokens are required.
    tokens: Option<RwLock<HashMap<String, TokenRecord>>>,
    /// Counts the tokens that this process stored.
    noted: AtomicU64,
    /// Moves when one of them changes.
    changes: watch::Sender<()>,
    /// What [`Access::enter`] takes, once each; `None` where it takes nothing.
    invitation: watch::Sender<Option<Token>>,
}

/// A token may outlast the longest timer.
const LONGEST_SLEEP_MS: u64 = 24 * 60 * 60 * 1000;

/// Why a caller is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// No token.
    #[error(
        "this coordinator requires a token; pass one with --token-file FILE or FATHOM_TOKEN_FILE; operators issue tokens \
         with `fathom token issue`"
    )]
    Missing,
    /// An invalid token. The exact reason would help an attacker more than an owner.
    #[error("the token is not known, has expired or was revoked; ask an operator for another one")]
    NotValid,
}

impl Access {
    /// For a coordinator without tokens.
    pub fn open() -> Self {
        let (changes, invitation) = (watch::channel(()).0, watch::channel(None).0);
        Self { tokens: None, noted: AtomicU64::new(0), changes, invitation }
    }

    /// For a coordinator that requires one of `tokens`.
    pub fn by_tokens(tokens: Vec<TokenRecord>) -> Self {
        let by_id = tokens.into_iter().map(|token| (token.id.clone(), token)).collect();
        Self { tokens: Some(RwLock::new(by_id)), ..Self::open() }
    }

    /// For the page of one process: it requires a token, which only [`Access::enter`] gives.
    pub fn by_invitation() -> Self {
        let invitation = watch::channel(Some(Token::random())).0;
        Self { invitation, ..Self::by_tokens(Vec::new()) }
    }

    /// The invitation that is valid now, and each later one.
    pub fn invitations(&self) -> watch::Receiver<Option<Token>> {
        self.invitation.subscribe()
    }

    /// Takes the invitation in the value of an `authorization` header, which is then void: another one takes
    /// its place. Returns a token for an operator, which is valid as long as this process and stored nowhere.
    ///
    /// # Errors
    /// When it is missing, or not the valid one.
    pub fn enter(&self, authorization: Option<&str>, now_ms: u64) -> Result<Token, Refused> {
        let shown = bearer(authorization)?;
        let taken = self.invitation.send_if_modified(|valid| {
            let is_it = valid.as_ref().is_some_and(|valid| valid.same_as(&shown));
            if is_it {
                *valid = Some(Token::random());
            }
            is_it
        });
        if !taken {
            return Err(Refused::NotValid);
        }
        let token = Token::random();
        self.note(TokenRecord::new(&token, "page".to_owned(), Role::Operator, None, now_ms, None));
        Ok(token)
    }

    /// Whether tokens are required.
    pub fn asks_for_tokens(&self) -> bool {
        self.tokens.is_some()
    }

    /// The caller with this value of the `authorization` header.
    ///
    /// # Errors
    /// When it is missing or invalid.
    pub fn principal(&self, authorization: Option<&str>, now_ms: u64) -> Result<Principal, Refused> {
        let Some(tokens) = &self.tokens else { return Ok(Principal::anonymous()) };
        let token = bearer(authorization)?;
        let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
        let record = tokens.get(token.id()).filter(|record| record.is_of(&token));
        let record = record.filter(|record| holds(&tokens, record, now_ms));
        let record = record.ok_or(Refused::NotValid)?;
        Ok(Principal {
            name: record.name.clone(),
            role: record.role,
            tenant: record.tenant.clone(),
            token_id: Some(record.id.clone()),
            job: record.job.clone(),
        })
    }

    /// Whether the token of an accepted caller is still valid: a stream may outlive it.
    pub fn still_holds(&self, caller: &Principal, now_ms: u64) -> bool {
        let (Some(tokens), Some(id)) = (&self.tokens, &caller.token_id) else { return true };
        let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
        tokens.get(id).is_some_and(|record| holds(&tokens, record, now_ms))
    }

    /// Links of a tenant that were issued since a time, valid or not.
    pub fn links_since(&self, tenant: &Tenant, since_ms: u64) -> usize {
        let Some(tokens) = &self.tokens else { return 0 };
        let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
        let is_new = |token: &&TokenRecord| {
            token.job.is_some() && token.tenant.as_ref() == Some(tenant) && token.created_ms > since_ms
        };
        tokens.values().filter(is_new).count()
    }

    /// Forgets a token that is no longer stored.
    pub fn forget(&self, id: &str) {
        if let Some(tokens) = &self.tokens {
            let mut tokens = tokens.write().unwrap_or_else(PoisonError::into_inner);
            self.noted.fetch_add(1, Ordering::Relaxed);
            tokens.remove(id);
        }
    }

    /// Waits until the token of an accepted caller becomes invalid.
    pub async fn until_void(&self, caller: &Principal, clock: Clock) {
        let mut changes = self.changes.subscribe();
        while self.still_holds(caller, clock.now_ms()) {
            let expires_ms = self.expires_ms(caller);
            let expiry = async {
                match expires_ms {
                    Some(expires_ms) => {
                        let left_ms = expires_ms.saturating_sub(clock.now_ms()).max(1);
                        tokio::time::sleep(Duration::from_millis(left_ms.min(LONGEST_SLEEP_MS))).await;
                    }
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                changed = changes.changed() => if changed.is_err() { return },
                () = expiry => {}
            }
        }
    }

    /// When the token of an accepted caller expires, Unix milliseconds; `None`: never.
    pub fn expires_ms(&self, caller: &Principal) -> Option<u64> {
        let tokens = self.tokens.as_ref()?.read().unwrap_or_else(PoisonError::into_inner);
        tokens.get(caller.token_id.as_ref()?)?.expires_ms
    }

    /// Records a stored token.
    pub fn note(&self, token: TokenRecord) {
        if let Some(tokens) = &self.tokens {
            let mut tokens = tokens.write().unwrap_or_else(PoisonError::into_inner);
            self.noted.fetch_add(1, Ordering::Relaxed);
            tokens.insert(token.id.clone(), token);
            self.changes.send_replace(());
        }
    }

    /// Reads all tokens again, which another process may have written.
    ///
    /// # Errors
    /// When they cannot be read; those that are known stay.
    pub async fn read_again(&self, store: &dyn AccessStore) -> Result<(), StoreError> {
        let Some(tokens) = &self.tokens else { return Ok(()) };
        let noted = self.noted.load(Ordering::Relaxed);
        let read: HashMap<String, TokenRecord> =
            store.tokens().await?.into_iter().map(|token| (token.id.clone(), token)).collect();
        let mut tokens = tokens.write().unwrap_or_else(PoisonError::into_inner);
        // What was read may be older than a token that this process has just revoked.
        if noted == self.noted.load(Ordering::Relaxed) && *tokens != read {
            *tokens = read;
            self.changes.send_replace(());
        }
        Ok(())
    }
}

/// The token in the value of an `authorization` header.
fn bearer(authorization: Option<&str>) -> Result<Token, Refused> {
    let shown = authorization.ok_or(Refused::Missing)?;
    // The name of a scheme is case-insensitive (RFC 9110, 11.1).
    let is_bearer = |scheme: &&str| scheme.eq_ignore_ascii_case("bearer");
    let token = shown.split_once(' ').filter(|(scheme, _)| is_bearer(scheme));
    token.and_then(|(_, token)| Token::parse(token.trim())).ok_or(Refused::NotValid)
}

/// Whether a token is valid now, and so is the one with which it was made.
fn holds(tokens: &HashMap<String, TokenRecord>, record: &TokenRecord, now_ms: u64) -> bool {
    let issuer = record.issued_by.as_ref();
    let issuer_holds = |id: &String| tokens.get(id).is_some_and(|issuer| issuer.holds_at(now_ms));
    record.holds_at(now_ms) && issuer.is_none_or(issuer_holds)
}

#[cfg(test)]
mod tests {
    use tonic::async_trait;

    use super::*;
    use crate::schedule::{Quota, Rules, Usage};
    use crate::store::MemoryStore;

    #[test]
    fn an_invitation_opens_one_page() {
        let access = Access::by_invitation();
        let mut invitations = access.invitations();
        let mut shown = || {
            let valid = invitations.borrow_and_update().as_ref().map(Token::reveal).unwrap_or_default();
            format!("Bearer {valid}")
        };
        let (first, stranger) = (shown(), format!("Bearer {}", Token::random().reveal()));
        assert_eq!(access.enter(None, 5), Err(Refused::Missing));
        assert_eq!(access.enter(Some(&stranger), 5), Err(Refused::NotValid));
        assert_eq!(access.principal(Some(&first), 5), Err(Refused::NotValid), "it reads nothing itself");
        let token = access.enter(Some(&first), 5).unwrap_or_else(|error| panic!("{error}"));
        let caller = access.principal(Some(&format!("Bearer {}", token.reveal())), 6);
        assert_eq!(caller.map(|caller| caller.role), Ok(Role::Operator));
        assert_eq!(access.enter(Some(&first), 5), Err(Refused::NotValid), "a second time");
        let second = shown();
        assert!(second != first && access.enter(Some(&second), 7).is_ok(), "the next one");
        assert_eq!(Access::by_tokens(Vec::new()).enter(Some(&second), 7), Err(Refused::NotValid));
    }

    #[test]
    fn only_a_valid_token_is_admitted() {
        let token = Token::random();
        let record = TokenRecord::new(&token, "ci".into(), Role::Viewer, None, 0, Some(100));
        let access = Access::by_tokens(vec![record.clone()]);
        let with = |text: &str| access.principal(Some(text), 50);
        let shown = format!("Bearer {}", token.reveal());
        assert_eq!(with(&shown).map(|caller| (caller.name, caller.role)), Ok(("ci".into(), Role::Viewer)));
        assert!(with(&shown.replace("Bearer", "bearer")).is_ok());
        assert_eq!(access.principal(None, 50), Err(Refused::Missing));
        let stranger = Token::random().reveal();
        let forged = format!("Bearer fathom_{}_{}", token.id(), &stranger[stranger.len() - 64..]);
        for wrong in ["", "Bearer", "Bearer x", &token.reveal(), &forged, &format!("Bearer {stranger}")] {
            assert_eq!(with(wrong), Err(Refused::NotValid), "{wrong}");
        }
        assert_eq!(access.principal(Some(&shown), 100), Err(Refused::NotValid), "it has expired");

        let caller = with(&shown).unwrap_or_else(|error| panic!("{error}"));
        assert!(access.still_holds(&caller, 50));
        access.note(TokenRecord { revoked_ms: Some(60), ..record });
        assert!(!access.still_holds(&caller, 60));
        assert_eq!(with(&shown), Err(Refused::NotValid), "it was revoked");
    }

    #[test]
    fn a_link_is_valid_only_with_the_token_that_made_it() {
        let issuer = Token::random();
        let by = TokenRecord::new(&issuer, "ana".into(), Role::Submitter, None, 0, None);
        let access = Access::by_tokens(vec![by.clone()]);
        let caller = access.principal(Some(&format!("Bearer {}", issuer.reveal())), 1).unwrap();
        let job = "01a21ea5539c6b5f23ab".parse::<crate::schedule::JobId>().unwrap();
        let (token, link) = TokenRecord::of_link(job.clone(), Tenant::default(), &caller, 5, 100);
        assert_eq!(link.issued_by.as_deref(), Some(issuer.id()));
        access.note(link.clone());
        let shown = format!("Bearer {}", token.reveal());
        let guest = access.principal(Some(&shown), 10).unwrap();
        assert_eq!((guest.job, guest.role), (Some(job), Role::Viewer));
        assert_eq!(access.links_since(&Tenant::default(), 4), 1);
        assert_eq!(access.links_since(&Tenant::default(), 5), 0);
        access.note(TokenRecord { revoked_ms: Some(20), ..by });
        assert_eq!(access.principal(Some(&shown), 30), Err(Refused::NotValid));
        assert!(link.is_link_ended_before(101) && !link.is_link_ended_before(100));
    }

    #[tokio::test(start_paused = true)]
    async fn a_wait_ends_when_the_token_is_revoked_or_expires() {
        let clock = Clock::starting_at(1000);
        let [revoked, expires] = [(); 2].map(|()| Token::random());
        let record =
            |token: &Token, ends| TokenRecord::new(token, String::new(), Role::Viewer, None, 0, ends);
        let access = Access::by_tokens(vec![record(&revoked, None), record(&expires, Some(61_000))]);
        let caller =
            |token: &Token| Principal { token_id: Some(token.id().to_owned()), ..Principal::anonymous() };
        let (first, second) = (caller(&revoked), caller(&expires));
        let (mut first, mut second) = (
            std::pin::pin!(access.until_void(&first, clock)),
            std::pin::pin!(access.until_void(&second, clock)),
        );
        let waits = Duration::from_secs(59);
        assert!(tokio::time::timeout(waits, futures::future::select(&mut first, &mut second)).await.is_err());
        access.note(TokenRecord { revoked_ms: Some(60_000), ..record(&revoked, None) });
        let soon = Duration::from_secs(2);
        assert!(tokio::time::timeout(Duration::from_millis(1), first).await.is_ok(), "it was revoked");
        assert!(tokio::time::timeout(soon, second).await.is_ok(), "it has expired");
        let anonymous = Principal::anonymous();
        assert!(tokio::time::timeout(waits, access.until_void(&anonymous, clock)).await.is_err());
    }

    #[tokio::test]
    async fn tokens_of_another_process_count_and_a_revocation_stays() {
        let store = MemoryStore::new(Rules::default(), 1000, 0);
        let access = Access::by_tokens(Vec::new());
        let token = Token::random();
        let record = TokenRecord::new(&token, "ci".into(), Role::Viewer, None, 0, None);
        let shown = format!("Bearer {}", token.reveal());
        store.put_token(&record).await.unwrap();
        assert_eq!(access.principal(Some(&shown), 1), Err(Refused::NotValid));
        access.read_again(&store).await.unwrap();
        let caller = access.principal(Some(&shown), 1).unwrap();
        let changes = access.changes.subscribe();
        access.read_again(&store).await.unwrap();
        assert!(!changes.has_changed().unwrap(), "callers wake although nothing has changed");

        // This process revokes it while it reads what was before.
        let revoked = TokenRecord { revoked_ms: Some(2), ..record };
        let slow = Slow { store: &store, access: &access, revoked: &revoked };
        access.read_again(&slow).await.unwrap();
        assert!(!access.still_holds(&caller, 3), "a revocation was undone");
        store.put_token(&revoked).await.unwrap();
        access.read_again(&store).await.unwrap();
        assert!(!access.still_holds(&caller, 3));
        assert!(changes.has_changed().unwrap());
    }

    /// A store whose answer comes after a revocation, and is from before it.
    struct Slow<'a> {
        store: &'a MemoryStore,
        access: &'a Access,
        revoked: &'a TokenRecord,
    }

    #[async_trait]
    impl AccessStore for Slow<'_> {
        async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
            let tokens = self.store.tokens().await;
            self.access.note(self.revoked.clone());
            tokens
        }

        async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError> {
            self.store.set_quota(tenant, quota).await
        }

        async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError> {
            self.store.quota(tenant).await
        }

        async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
            self.store.quotas().await
        }

        async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError> {
            self.store.usage().await
        }

        async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError> {
            self.store.put_token(token).await
        }

        async fn forget_token(&self, id: &str) -> Result<(), StoreError> {
            self.store.forget_token(id).await
        }
    }

    #[test]
    fn every_caller_is_admitted_where_no_token_is_required() {
        let access = Access::open();
        assert_eq!(access.principal(None, 0), Ok(Principal::anonymous()));
        assert!(access.still_holds(&Principal::anonymous(), u64::MAX));
    }
}
