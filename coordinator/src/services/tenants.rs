//! AdminService: tenants and their tokens.

use std::collections::{BTreeMap, BTreeSet};

use fathom_proto::admin::v1;

use super::{Admin, encode};
use crate::access::{Principal, Role, TokenRecord};
use crate::schedule::{Quota, Tenant, Usage};
use crate::service_error::ServiceError;
use crate::store::Revoked;

impl Admin {
    /// All tenants with a job, a quota or a token, by name.
    pub(super) async fn tenants(&self) -> Result<Vec<v1::Tenant>, ServiceError> {
        let (store, objects) = (&self.0.store, &self.0.objects);
        let own: BTreeMap<Tenant, Quota> = store.quotas().await?.into_iter().collect();
        let usage: BTreeMap<Tenant, Usage> = store.usage().await?.into_iter().collect();
        let mut names: BTreeSet<Tenant> =
            objects.all().await?.into_iter().map(|(tenant, _)| tenant).collect();
        names.extend(own.keys().chain(usage.keys()).cloned());
        names.extend(store.tokens().await?.into_iter().filter_map(|token| token.tenant));
        let mut tenants = Vec::with_capacity(names.len());
        for name in names {
            let has = usage.get(&name).copied().unwrap_or_default();
            tenants.push(self.tenant(&name, has, own.contains_key(&name)).await?);
        }
        Ok(tenants)
    }

    async fn tenant(&self, name: &Tenant, has: Usage, is_own: bool) -> Result<v1::Tenant, ServiceError> {
        let Quota { max_open_jobs, max_parallel, max_bytes } = self.0.store.quota(name).await?;
        Ok(v1::Tenant {
            name: name.to_string(),
            quota: Some(v1::Quota { max_open_jobs, max_parallel, max_bytes }),
            quota_is_own: is_own,
            open_jobs: has.open_jobs,
            leased_tasks: has.leased_tasks,
            bytes: self.0.objects.used_bytes(name).await?,
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
        // Tasks that waited for a higher limit may be assigned now.
        self.0.wakeups.changed();
        let usage = self.0.store.usage().await?;
        let has = usage.into_iter().find(|(name, _)| *name == tenant).map(|(_, has)| has);
        self.tenant(&tenant, has.unwrap_or_default(), quota.is_some()).await
    }

    pub(super) async fn issue(
        &self,
        caller: &Principal,
        request: v1::IssueTokenRequest,
    ) -> Result<v1::IssueTokenResponse, ServiceError> {
        let Some(role) = role(request.role()) else {
            return Err(ServiceError::BadArgument { field: "role", message: "is missing".into() });
        };
        let v1::IssueTokenRequest { name, tenant, expires_in_seconds, .. } = request;
        let (secret, record) =
            TokenRecord::issue(name, role, &tenant, expires_in_seconds, self.0.clock.now_ms())?;
        self.0.store.put_token(&record).await?;
        self.0.access.note(record.clone());
        tracing::info!(token_id = %record.id, name = %record.name, %role, by = %caller.name, "token issued");
        Ok(v1::IssueTokenResponse { secret: secret.reveal(), token: Some(token(&record)) })
    }

    pub(super) async fn tokens(&self) -> Result<Vec<v1::Token>, ServiceError> {
        let mut all = self.0.store.tokens().await?;
        all.sort_by(|a, b| (a.created_ms, &a.id).cmp(&(b.created_ms, &b.id)));
        Ok(all.iter().map(token).collect())
    }

    pub(super) async fn revoke(
        &self,
        caller: &Principal,
        request: v1::RevokeTokenRequest,
    ) -> Result<v1::Token, ServiceError> {
        let v1::RevokeTokenRequest { token_id: id, even_last } = request;
        // Two revocations at once could each count on the other's token.
        let _alone = self.0.revoking.lock().await;
        let record = match self.0.store.revoke_token(&id, self.0.clock.now_ms(), even_last).await? {
            Revoked::Token(record) => record,
            Revoked::Last => return Err(ServiceError::LastOperator(id)),
            Revoked::Unknown => return Err(ServiceError::NoSuchToken(id.chars().take(40).collect())),
        };
        self.0.access.note(record.clone());
        tracing::info!(token_id = %record.id, name = %record.name, by = %caller.name, "token revoked");
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

pub(super) fn encode_role(role: Role) -> v1::Role {
    match role {
        Role::Viewer => v1::Role::Viewer,
        Role::Submitter => v1::Role::Submitter,
        Role::Operator => v1::Role::Operator,
        Role::Worker => v1::Role::Worker,
    }
}

fn token(record: &TokenRecord) -> v1::Token {
    v1::Token {
        token_id: record.id.clone(),
        name: record.name.clone(),
        role: encode_role(record.role).into(),
        tenant: record.tenant.as_ref().map(Tenant::to_string).unwrap_or_default(),
        create_time: Some(encode::timestamp(record.created_ms)),
        expire_time: record.expires_ms.map(encode::timestamp),
        revoke_time: record.revoked_ms.map(encode::timestamp),
        job_id: record.job.as_ref().map(ToString::to_string).unwrap_or_default(),
    }
}
