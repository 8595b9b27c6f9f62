//! `fathom tenant`: the tenants of a service, their usage and their limits.

use clap::{Args, Subcommand};
use fathom_coordinator::json;
use fathom_proto::admin::v1::{Quota, SetQuotaRequest, Tenant};

use super::ServiceArgs;
use crate::client::Client;
use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom tenant`.
#[derive(Args, Debug)]
pub struct TenantArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// List the tenants of a service with their usage and limits
    List(ListArgs),
    /// Set limits of a tenant; limits that are not given stay unchanged
    Limit(LimitArgs),
}

#[derive(Args, Debug)]
struct ListArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct LimitArgs {
    /// Name of the tenant
    tenant: String,
    /// Maximum number of unfinished jobs; 0: no limit
    #[arg(long, value_name = "N")]
    open_jobs: Option<u32>,
    /// Maximum number of tasks that run at a time; 0: no limit
    #[arg(long, value_name = "N")]
    parallel: Option<u32>,
    /// Maximum size of photographs, checkpoints and results, bytes; 0: no limit
    #[arg(long, value_name = "BYTES")]
    bytes: Option<u64>,
    /// Allow a tenant that has nothing yet: no job, no file, no token
    #[arg(long)]
    new: bool,
    /// Remove the tenant's own limits: those of the configuration apply again
    #[arg(long, conflicts_with_all = ["open_jobs", "parallel", "bytes"])]
    reset: bool,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: TenantArgs) -> Result<()> {
    match args.what {
        What::List(args) => {
            let client = args.service.client().await?;
            let tenants = client.tenants().await?;
            if args.json {
                return output::json(&tenants.iter().map(json::tenant).collect::<Vec<_>>());
            }
            tenants.iter().for_each(|tenant| output::line(tenant_line(tenant)));
            Ok(())
        }
        What::Limit(args) => limit(args).await,
    }
}

async fn limit(args: LimitArgs) -> Result<()> {
    let client = args.service.client().await?;
    let quota = if args.reset {
        None
    } else {
        if args.open_jobs.is_none() && args.parallel.is_none() && args.bytes.is_none() {
            let message = "no limits given: use --open-jobs, --parallel, --bytes or --reset";
            return Err(CliError::Message(message.to_owned()));
        }
        let known = client.tenants().await?.into_iter().find(|tenant| tenant.name == args.tenant);
        if known.is_none() && !args.new && !has_token(&client, &args.tenant).await? {
            return Err(CliError::Message(format!(
                "there is no tenant {} at {}; `fathom tenant list` lists the existing ones, and --new sets \
                 limits for a tenant that has nothing yet",
                args.tenant, client.url
            )));
        }
        let before = known.and_then(|tenant| tenant.quota).unwrap_or_default();
        Some(Quota {
            max_open_jobs: args.open_jobs.unwrap_or(before.max_open_jobs),
            max_parallel: args.parallel.unwrap_or(before.max_parallel),
            max_bytes: args.bytes.unwrap_or(before.max_bytes),
        })
    };
    let tenant = client.set_quota(SetQuotaRequest { tenant: args.tenant, quota }).await?;
    if args.json {
        return output::json(&json::tenant(&tenant));
    }
    output::line(tenant_line(&tenant));
    Ok(())
}

/// Whether a token exists for a tenant that has created nothing yet.
async fn has_token(client: &Client, tenant: &str) -> Result<bool> {
    Ok(client.tokens().await?.iter().any(|token| token.tenant == tenant && token.revoke_time.is_none()))
}

fn tenant_line(tenant: &Tenant) -> String {
    let quota = tenant.quota.unwrap_or_default();
    let of =
        |has: String, most: u64, limit: String| if most == 0 { has } else { format!("{has} of {limit}") };
    let count = |has: u32, most: u32| of(has.to_string(), most.into(), most.to_string());
    format!(
        "{:<16} open jobs {}, tasks {}, {}{}",
        tenant.name,
        count(tenant.open_jobs, quota.max_open_jobs),
        count(tenant.leased_tasks, quota.max_parallel),
        of(output::bytes(tenant.bytes), quota.max_bytes, output::bytes(quota.max_bytes)),
        if tenant.quota_is_own { " (limits of its own)" } else { "" }
    )
}
