//! AdminService: tenants and their tokens.

use std::collections::{BTreeMap, BTreeSet};

use fathom_proto::admin::v1;

use super::convert::{ServiceError, limit_of};
use super::{Admin, encode};
use crate::access::{Principal, Role, Token, TokenRecord};
use crate::schedule::{Quota, Tenant, Usage};

/// Longest name of a token, bytes.
const MAX_NAME_BYTES: usize = 200;
/// Longest life of a token, seconds: a hundred years, so that its end is a time.
const MAX_LIFE_SECONDS: u64 = 100 * 366 * 24 * 60 * 60;

impl Admin {
    pub(super) async fn tenants(&self) -> Result<Vec<v1::Tenant>, ServiceError> {
        let mut names: BTreeSet<Tenant> =
            self.0.objects.all()?.into_iter().map(|(tenant, _)| tenant).collect();
        names.extend(self.0.store.quotas().await?.into_iter().map(|(tenant, _)| tenant));
        names.extend(self.0.store.tokens().await?.into_iter().filter_map(|token| token.tenant));
        names.extend(self.0.store.usage().await?.into_iter().map(|(tenant, _)| tenant));
        let mut tenants = Vec::with_capacity(names.len());
        for name in names {
            tenants.push(self.tenant(name).await?);
        }
        Ok(tenants)
    }

    async fn tenant(&self, name: Tenant) -> Result<v1::Tenant, ServiceError> {
        let own: BTreeMap<Tenant, Quota> = self.0.store.quotas().await?.into_iter().collect();
        let usage: BTreeMap<Tenant, Usage> = self.0.store.usage().await?.into_iter().collect();
        let Usage { open_jobs, leased_tasks } = usage.get(&name).copied().unwrap_or_default();
        let Quota { max_open_jobs, max_parallel, max_bytes } = self.0.store.quota(&name).await?;
        Ok(v1::Tenant {
            quota: Some(v1::Quota { max_open_jobs, max_parallel, max_bytes }),
            quota_is_own: own.contains_key(&name),
            open_jobs,
            leased_tasks,
            bytes: self.0.objects.of(&name)?.used_bytes(),
            name: name.to_string(),
        })
    }

    pub(super) async fn set_quota(
        &self,
        caller: &Principal,
        request: v1::SetQuotaRequest,
    ) -> Result<v1::Tenant, ServiceError> {
        let tenant: Tenant = request.tenant.parse()?;
        let quota = request.quota.map(|quota| Quota {
            max_open_jobs: quota.max_open_jobs,
            max_parallel: quota.max_parallel,
            max_bytes: quota.max_bytes,
        });
        self.0.store.set_quota(&tenant, quota).await?;
        tracing::info!(%tenant, ?quota, by = %caller.name, "quota set");
        // Tasks that waited for a higher limit may be given out now.
        self.0.changed();
        self.tenant(tenant).await
    }

    pub(super) async fn issue(
        &self,
        caller: &Principal,
        request: v1::IssueTokenRequest,
    ) -> Result<v1::IssueTokenResponse, ServiceError> {
        let wrong = |field, message: &str| ServiceError::BadArgument { field, message: message.to_owned() };
        let role = role(request.role()).ok_or_else(|| wrong("role", "is missing"))?;
        let v1::IssueTokenRequest { name, tenant, expires_in_seconds, .. } = request;
        limit_of("name", &name, MAX_NAME_BYTES)?;
        if name.trim().is_empty() || name.contains(char::is_control) {
            return Err(wrong("name", "is missing; say whom or what the token is for"));
        }
        if expires_in_seconds > MAX_LIFE_SECONDS {
            return Err(wrong("expires_in_seconds", "is more than a hundred years; 0 is for ever"));
        }
        let tenant = Some(tenant).filter(|tenant| !tenant.is_empty());
        let tenant = tenant.map(|tenant| tenant.parse::<Tenant>()).transpose()?;
        if tenant.is_none() && matches!(role, Role::Viewer | Role::Submitter) {
            return Err(wrong("tenant", "is missing; only operators and workers can be of all tenants"));
        }
        let now_ms = self.0.clock.now_ms();
        let expires_ms = (expires_in_seconds > 0).then(|| now_ms + 1000 * expires_in_seconds);
        let secret = Token::random();
        let record = TokenRecord::new(&secret, name, role, tenant, now_ms, expires_ms);
        self.0.store.put_token(&record).await?;
        self.0.access.note(record.clone());
        tracing::info!(token = %record.id, name = %record.name, %role, by = %caller.name, "token issued");
        Ok(v1::IssueTokenResponse { secret: secret.reveal(), token: Some(token(&record)) })
    }

    pub(super) async fn tokens(&self) -> Result<Vec<v1::Token>, ServiceError> {
        let mut all = self.0.store.tokens().await?;
        all.sort_by(|a, b| (a.created_ms, &a.id).cmp(&(b.created_ms, &b.id)));
        Ok(all.iter().map(token).collect())
    }

    pub(super) async fn revoke(&self, caller: &Principal, id: &str) -> Result<v1::Token, ServiceError> {
        let all = self.0.store.tokens().await?;
        let known = all.into_iter().find(|token| token.id == id);
        let mut record = known.ok_or_else(|| ServiceError::NoSuchToken(id.chars().take(40).collect()))?;
        // A repeated call does not move the time.
        record.revoked_ms = record.revoked_ms.or(Some(self.0.clock.now_ms()));
        self.0.store.put_token(&record).await?;
        self.0.access.note(record.clone());
        tracing::info!(token = %record.id, name = %record.name, by = %caller.name, "token revoked");
        Ok(token(&record))
    }
}

fn role(role: v1::Role) -> Option<Role> {
    match role {
        v1::Role::Unspecified => None,
        v1::Role::Viewer => Some(Role::Viewer),
        v1::Role::Submitter => Some(Role::Submitter),
        v1::Role::Operator => Some(Role::Operator),
        v1::Role::Worker => Some(Role::Worker),
    }
}

fn token(record: &TokenRecord) -> v1::Token {
    let role = match record.role {
        Role::Viewer => v1::Role::Viewer,
        Role::Submitter => v1::Role::Submitter,
        Role::Operator => v1::Role::Operator,
        Role::Worker => v1::Role::Worker,
    };
    v1::Token {
        token_id: record.id.clone(),
        name: record.name.clone(),
        role: role.into(),
        tenant: record.tenant.as_ref().map(Tenant::to_string).unwrap_or_default(),
        create_time: Some(encode::timestamp(record.created_ms)),
        expire_time: record.expires_ms.map(encode::timestamp),
        revoke_time: record.revoked_ms.map(encode::timestamp),
    }
}
