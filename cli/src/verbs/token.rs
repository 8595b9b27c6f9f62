//! `fathom token`: manages the tokens of a service.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use fathom_coordinator::access;
use fathom_coordinator::json;
use fathom_coordinator::maintenance::{self, Place};
use fathom_proto::admin::v1::{IssueTokenRequest, Role, Token};
use prost_types::Timestamp;
use serde_json::{Value, json};

use super::ServiceArgs;
use super::store::CopyArgs;
use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom token`.
#[derive(Args, Debug)]
pub struct TokenArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Create a token and print it; it is shown only once
    Issue(IssueArgs),
    /// List issued tokens without their secrets
    List(ListArgs),
    /// Revoke a token at once
    Revoke(RevokeArgs),
}

#[derive(Args, Debug)]
struct IssueArgs {
    /// User or purpose of the token
    name: String,
    /// Role of the token
    #[arg(long, value_enum)]
    role: RoleArg,
    /// Tenant whose jobs it may access; without one, an operator or worker token is valid for all tenants
    #[arg(long, default_value = "", hide_default_value = true)]
    tenant: String,
    /// Days until it expires; 0: never
    #[arg(long, default_value_t = 0, value_name = "N")]
    days: u32,
    /// Write the token into the data directory of a stopped coordinator, for when no operator has a token any
    /// more
    #[arg(long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// The same in the PostgreSQL database of a coordinator; valid from its next start
    #[arg(long, value_name = "URL")]
    store: Option<String>,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct ListArgs {
    /// List the tokens in the data directory of a stopped coordinator; the directory is only read
    #[arg(long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// List the tokens in the PostgreSQL database of a coordinator
    #[arg(long, value_name = "URL")]
    store: Option<String>,
    #[command(flatten)]
    copy: CopyArgs,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct RevokeArgs {
    /// Id of the token: its second part, also shown by `fathom token list`
    #[arg(value_name = "ID")]
    id: String,
    /// Revoke even the last operator token for all tenants, after which no token can be created over the
    /// network
    #[arg(long)]
    last: bool,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum RoleArg {
    /// View the jobs of a tenant and fetch their files
    Viewer,
    /// Also upload scenes, create jobs and control them
    Submitter,
    /// All user actions
    Operator,
    /// Take tasks
    Worker,
}

pub async fn run(args: TokenArgs) -> Result<()> {
    match args.what {
        What::Issue(args) => issue(args).await,
        What::List(args) => list(args).await,
        What::Revoke(args) => revoke(args).await,
    }
}

/// The store to read or write instead of calling the service.
fn place(data_dir: Option<&PathBuf>, store: Option<&String>) -> Option<Place> {
    let is_named = data_dir.is_some() || store.is_some();
    is_named.then(|| Place {
        data_dir: data_dir.cloned().unwrap_or_default(),
        store: store.cloned(),
        objects: None,
    })
}

async fn issue(args: IssueArgs) -> Result<()> {
    if let Some(place) = place(args.data_dir.as_ref(), args.store.as_ref()) {
        let role = match args.role {
            RoleArg::Viewer => access::Role::Viewer,
            RoleArg::Submitter => access::Role::Submitter,
            RoleArg::Operator => access::Role::Operator,
            RoleArg::Worker => access::Role::Worker,
        };
        let made = maintenance::issue_token(&place, &args.name, role, &args.tenant, args.days).await;
        let secret = made.map_err(|error| CliError::Message(error.to_string()))?;
        return print_secret(&secret, json!({"token": secret}), args.json);
    }
    let role = match args.role {
        RoleArg::Viewer => Role::Viewer,
        RoleArg::Submitter => Role::Submitter,
        RoleArg::Operator => Role::Operator,
        RoleArg::Worker => Role::Worker,
    };
    let request = IssueTokenRequest {
        name: args.name,
        role: role.into(),
        tenant: args.tenant,
        expires_in_seconds: u64::from(args.days) * 24 * 60 * 60,
    };
    let issued = args.service.client().await?.issue_token(request).await?;
    let mut value = issued.token.as_ref().map(json::token).unwrap_or_default();
    value["token"] = issued.secret.clone().into();
    print_secret(&issued.secret, value, args.json)
}

/// The secret alone on a line, so that it can be redirected into a file.
fn print_secret(secret: &str, value: Value, json: bool) -> Result<()> {
    if json {
        return output::json(&value);
    }
    output::line(secret);
    Ok(())
}

async fn list(args: ListArgs) -> Result<()> {
    let (tokens, of) = match place(args.data_dir.as_ref(), args.store.as_ref()) {
        Some(place) => {
            let stored = maintenance::tokens(&place, args.copy.scratch.as_deref()).await;
            let stored = stored.map_err(|error| CliError::Message(error.to_string()))?;
            (stored.iter().map(of_store).collect(), format!("in {place}"))
        }
        None => {
            let client = args.service.client().await?;
            (client.tokens().await?, format!("at {}", client.url))
        }
    };
    if args.json {
        return output::json(&tokens.iter().map(json::token).collect::<Vec<_>>());
    }
    if tokens.is_empty() {
        output::line(format!("no tokens {of}"));
    }
    tokens.iter().for_each(|token| output::line(token_line(token)));
    Ok(())
}

async fn revoke(args: RevokeArgs) -> Result<()> {
    let token = args.service.client().await?.revoke_token(&args.id, args.last).await?;
    if args.json {
        return output::json(&json::token(&token));
    }
    output::line(token_line(&token));
    Ok(())
}

/// A token of a data directory, in the form that a coordinator reports.
fn of_store(record: &access::TokenRecord) -> Token {
    let time = |ms: u64| Timestamp {
        seconds: i64::try_from(ms / 1000).unwrap_or(i64::MAX),
        nanos: i32::try_from(ms % 1000).unwrap_or_default() * 1_000_000,
    };
    let role = match record.role {
        access::Role::Viewer => Role::Viewer,
        access::Role::Submitter => Role::Submitter,
        access::Role::Operator => Role::Operator,
        access::Role::Worker => Role::Worker,
    };
    Token {
        token_id: record.id.clone(),
        name: record.name.clone(),
        role: role.into(),
        tenant: record.tenant.as_ref().map(ToString::to_string).unwrap_or_default(),
        create_time: Some(time(record.created_ms)),
        expire_time: record.expires_ms.map(time),
        revoke_time: record.revoked_ms.map(time),
        job_id: record.job.as_ref().map(ToString::to_string).unwrap_or_default(),
    }
}

fn token_line(token: &Token) -> String {
    let tenant = if token.tenant.is_empty() { "all tenants" } else { &token.tenant };
    let mut line = format!("{}  {:<9} of {tenant}: {}", token.token_id, json::role(token.role()), token.name);
    if token.revoke_time.is_some() {
        line += ", revoked";
    } else if let Some(end) = &token.expire_time {
        let seconds = std::time::SystemTime::now()
            .duration_since(std::time::UNIX_EPOCH)
            .map_or(0.0, |now| end.seconds as f64 - now.as_secs_f64());
        line += &if seconds > 0.0 {
            format!(", ends in {}", output::duration(seconds))
        } else {
            ", has expired".to_owned()
        };
    }
    line
}
