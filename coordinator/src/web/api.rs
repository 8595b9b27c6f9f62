//! The JSON interface: one handler for each call, with the values of `crate::json`.

use axum::Json;
use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use fathom_proto::admin::v1::{GetCallerRequest, ListTenantsRequest, ListTokensRequest, ListWorkersRequest};
use fathom_proto::v1;
use serde::Deserialize;
use serde_json::{Value, json};
use uuid::Uuid;

use super::Web;
use super::answer::{Answer, Fault};
use super::events;
use super::files;
use super::read::{Asked, At, Caller, Said};
use crate::json;

/// Log lines of an answer, unless the request names another number; and at most.
const LINES: usize = 1000;
const MOST_LINES: usize = 10_000;
/// An answer with log lines ends behind this many bytes of messages.
const LINE_BYTES: usize = 4 << 20;

/// All routes below `/api/v1`.
pub fn router() -> Router<Web> {
    Router::new()
        .route("/jobs", get(list_jobs).post(create_job))
        .route("/jobs/{job}", get(get_job).patch(update_job).delete(delete_job))
        .route("/jobs/{job}/pause", post(pause_job))
        .route("/jobs/{job}/resume", post(resume_job))
        .route("/jobs/{job}/retry", post(retry_job))
        .route("/jobs/{job}/cancel", post(cancel_job))
        .route("/jobs/{job}/events", get(events::watch))
        .route("/jobs/{job}/logs", get(logs))
        .route("/jobs/{job}/history", get(history))
        .route("/jobs/{job}/share", post(share_job))
        .route("/jobs/{job}/files", get(files::list))
        .route("/jobs/{job}/files/{*path}", get(files::read))
        .route("/jobs/{job}/blobs/{digest}", get(files::blob))
        .route("/datasets", get(list_datasets))
        .route("/datasets/{dataset}", get(get_dataset))
        .route("/datasets/{dataset}/inspect", post(inspect_dataset))
        .route("/caller", get(get_caller))
        .route("/workers", get(list_workers))
        .route("/tenants", get(list_tenants))
        .route("/tokens", get(list_tokens))
        .fallback(async || Fault::not_found("there is no such call; docs/operating/http.md lists them"))
        .method_not_allowed_fallback(async || {
            let message = "this address has other methods; docs/operating/http.md lists them";
            Fault::with(StatusCode::METHOD_NOT_ALLOWED, "METHOD_NOT_ALLOWED", message)
        })
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Listed {
    state: String,
    name: String,
    tenant: String,
    page_size: u32,
    page_token: String,
}

async fn list_jobs(State(web): State<Web>, caller: Caller, Asked(asked): Asked<Listed>) -> Answer {
    let words = asked.state.split(',').filter(|word| !word.is_empty());
    let states = words.map(state_of).collect::<Result<Vec<_>, _>>()?;
    let request = v1::ListJobsRequest {
        page_size: asked.page_size,
        page_token: asked.page_token,
        states: states.into_iter().map(Into::into).collect(),
        name_contains: asked.name,
        tenant: asked.tenant,
    };
    let page = web.jobs().list_jobs(caller.asks(request)).await?.into_inner();
    Ok(Json(json!({
        "jobs": page.jobs.iter().map(json::job).collect::<Vec<_>>(),
        "next_page_token": some_text(page.next_page_token),
    })))
}

fn state_of(word: &str) -> Result<v1::JobState, Fault> {
    use v1::JobState::{Cancelled, Failed, Paused, Running, Succeeded};
    let all = [Running, Succeeded, Failed, Cancelled, Paused];
    all.into_iter().find(|&state| json::job_state(state) == word).ok_or_else(|| {
        let known: Vec<_> = all.into_iter().map(json::job_state).collect();
        Fault::bad(format!("state: there is no {word:?}; states are {}", known.join(", ")))
    })
}

/// `null` for an empty text.
pub fn some_text(text: String) -> Option<String> {
    (!text.is_empty()).then_some(text)
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Created {
    dataset: String,
    name: String,
    /// Settings that differ from their defaults.
    config: Option<Value>,
    priority: i32,
    max_parallel: u32,
    request_id: String,
}

async fn create_job(
    State(web): State<Web>,
    caller: Caller,
    Said(said): Said<Created>,
) -> Result<Response, Fault> {
    if said.dataset.is_empty() {
        return Err(Fault::bad("dataset: is missing; name a dataset, which GET /api/v1/datasets lists"));
    }
    let request = v1::CreateJobRequest {
        // Without an id of the client, a repeated request makes another job.
        request_id: some_text(said.request_id).unwrap_or_else(|| Uuid::new_v4().to_string()),
        name: said.name,
        config_json: said.config.map_or_else(|| "{}".to_owned(), |config| config.to_string()),
        priority: said.priority,
        max_parallel: said.max_parallel,
        dataset_id: said.dataset,
        ..Default::default()
    };
    let job = web.jobs().create_job(caller.asks(request)).await?.into_inner();
    let place = [(header::LOCATION, format!("/api/v1/jobs/{}", job.job_id))];
    Ok((StatusCode::CREATED, place, Json(json::job(&job))).into_response())
}

async fn get_job(State(web): State<Web>, At(job_id): At<String>, caller: Caller) -> Answer {
    let job = web.jobs().get_job(caller.asks(v1::GetJobRequest { job_id })).await?.into_inner();
    let mut value = json::job(&job);
    // Only here: in a list it would be most of the answer.
    value["config"] = serde_json::from_str(&job.config_json).unwrap_or_default();
    Ok(Json(value))
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Updated {
    priority: Option<i32>,
    max_parallel: Option<u32>,
}

async fn update_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Updated { priority, max_parallel }): Said<Updated>,
) -> Answer {
    let request = v1::UpdateJobRequest { job_id, priority, max_parallel };
    Ok(Json(json::job(web.jobs().update_job(caller.asks(request)).await?.get_ref())))
}

/// The body of a call that takes nothing.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Nothing {}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Why {
    reason: String,
}

async fn pause_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Why { reason }): Said<Why>,
) -> Answer {
    let request = v1::PauseJobRequest { job_id, reason };
    Ok(Json(json::job(web.jobs().pause_job(caller.asks(request)).await?.get_ref())))
}

async fn cancel_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Why { reason }): Said<Why>,
) -> Answer {
    let request = v1::CancelJobRequest { job_id, reason };
    Ok(Json(json::job(web.jobs().cancel_job(caller.asks(request)).await?.get_ref())))
}

async fn resume_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Nothing {}): Said<Nothing>,
) -> Answer {
    let request = v1::ResumeJobRequest { job_id };
    Ok(Json(json::job(web.jobs().resume_job(caller.asks(request)).await?.get_ref())))
}

async fn retry_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Nothing {}): Said<Nothing>,
) -> Answer {
    let request = v1::RetryJobRequest { job_id };
    Ok(Json(json::job(web.jobs().retry_job(caller.asks(request)).await?.get_ref())))
}

async fn delete_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Nothing {}): Said<Nothing>,
) -> Result<StatusCode, Fault> {
    web.jobs().delete_job(caller.asks(v1::DeleteJobRequest { job_id })).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct OfTask {
    task: String,
}

async fn history(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Asked(OfTask { task }): Asked<OfTask>,
) -> Answer {
    let request = v1::GetHistoryRequest { job_id, task_id: task };
    let history = web.jobs().get_history(caller.asks(request)).await?.into_inner();
    Ok(Json(json!({"tasks": history.tasks.iter().map(json::task_history).collect::<Vec<_>>()})))
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Share {
    expires_in_seconds: u64,
}

async fn share_job(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Said(Share { expires_in_seconds }): Said<Share>,
) -> Result<Response, Fault> {
    let request = v1::ShareJobRequest { job_id, expires_in_seconds };
    let link = web.jobs().share_job(caller.asks(request)).await?.into_inner();
    let value = json!({
        "token": link.secret,
        "token_id": link.token_id,
        "expires_unix_seconds": json::unix_seconds(&link.expire_time),
    });
    Ok((StatusCode::CREATED, Json(value)).into_response())
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Lines {
    task: String,
    attempt: u32,
    level: String,
    after: u64,
    limit: Option<usize>,
}

/// Lines of a job's log. `next_after` is where the next request goes on, `more` whether there is more now.
async fn logs(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Asked(asked): Asked<Lines>,
) -> Answer {
    let limit = asked.limit.unwrap_or(LINES).clamp(1, MOST_LINES);
    let request = v1::StreamLogsRequest {
        job_id,
        task_id: asked.task,
        attempt: asked.attempt,
        min_severity: severity_of(&asked.level)?.into(),
        after_number: asked.after,
        follow: false,
    };
    let mut stream = web.jobs().stream_logs(caller.asks(request)).await?.into_inner();
    let (mut lines, mut bytes, mut next_after, mut more) = (Vec::new(), 0, asked.after, false);
    while let Some(line) = stream.message().await? {
        if lines.len() >= limit || bytes >= LINE_BYTES {
            more = true;
            break;
        }
        bytes += line.message.len();
        next_after = line.number;
        lines.push(json::log_line(&line));
    }
    Ok(Json(json!({"lines": lines, "next_after": next_after, "more": more})))
}

fn severity_of(word: &str) -> Result<v1::LogSeverity, Fault> {
    use v1::LogSeverity::{Debug, Error, Info, Trace, Unspecified, Warn};
    if word.is_empty() {
        return Ok(Unspecified);
    }
    let all = [Trace, Debug, Info, Warn, Error];
    all.into_iter().find(|&level| json::severity(level) == word).ok_or_else(|| {
        let known: Vec<_> = all.into_iter().map(json::severity).collect();
        Fault::bad(format!("level: there is no {word:?}; levels are {}", known.join(", ")))
    })
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Page {
    pub page_size: u32,
    pub page_token: String,
}

async fn list_datasets(
    State(web): State<Web>,
    caller: Caller,
    Asked(Page { page_size, page_token }): Asked<Page>,
) -> Answer {
    let request = v1::ListDatasetsRequest { page_size, page_token };
    let page = web.uploads().list_datasets(caller.asks(request)).await?.into_inner();
    Ok(Json(json!({
        "datasets": page.datasets.iter().map(json::dataset).collect::<Vec<_>>(),
        "next_page_token": some_text(page.next_page_token),
    })))
}

async fn get_dataset(State(web): State<Web>, At(dataset_id): At<String>, caller: Caller) -> Answer {
    let request = v1::GetDatasetRequest { dataset_id };
    Ok(Json(json::dataset(web.uploads().get_dataset(caller.asks(request)).await?.get_ref())))
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Inspected {
    /// Settings that differ from their defaults.
    config: Option<Value>,
}

async fn inspect_dataset(
    State(web): State<Web>,
    At(dataset_id): At<String>,
    caller: Caller,
    Said(Inspected { config }): Said<Inspected>,
) -> Answer {
    let config_json = config.map_or_else(String::new, |config| config.to_string());
    let request = v1::InspectDatasetRequest { dataset_id, config_json };
    Ok(Json(json::inspection(web.uploads().inspect_dataset(caller.asks(request)).await?.get_ref())))
}

async fn get_caller(State(web): State<Web>, caller: Caller) -> Answer {
    let known = web.admin().get_caller(caller.asks(GetCallerRequest {})).await?.into_inner();
    Ok(Json(json::caller(&known)))
}

async fn list_workers(State(web): State<Web>, caller: Caller) -> Answer {
    let all = web.admin().list_workers(caller.asks(ListWorkersRequest {})).await?.into_inner();
    Ok(Json(json!({"workers": all.workers.iter().map(json::worker).collect::<Vec<_>>()})))
}

async fn list_tenants(State(web): State<Web>, caller: Caller) -> Answer {
    let all = web.admin().list_tenants(caller.asks(ListTenantsRequest {})).await?.into_inner();
    Ok(Json(json!({"tenants": all.tenants.iter().map(json::tenant).collect::<Vec<_>>()})))
}

async fn list_tokens(State(web): State<Web>, caller: Caller) -> Answer {
    let all = web.admin().list_tokens(caller.asks(ListTokensRequest {})).await?.into_inner();
    Ok(Json(json!({"tokens": all.tokens.iter().map(json::token).collect::<Vec<_>>()})))
}
