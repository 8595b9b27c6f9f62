//! The HTTP interface over loopback: JSON, server-sent events, gRPC-Web, and who is kept out.

use std::time::Duration;

use fathom_coordinator::json;
use fathom_proto::admin::v1::{ListTokensRequest, Role};
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use fathom_worker::blobs::to_proto;
use prost::Message as _;
use reqwest::header::{HeaderMap, HeaderName, HeaderValue};
use reqwest::{Client, Method, StatusCode};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::access::Authority;
use crate::callers::{GuardedCluster, blob};
use crate::support::{FakeTrainer, TestCluster, is_durable};

/// Longest wait for something that must come.
const PATIENCE: Duration = Duration::from_secs(60);

fn client() -> Client {
    // Of a process, once; a second call changes nothing.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
    Client::new()
}

/// One caller of an interface.
struct Http {
    client: Client,
    base: String,
    token: Option<String>,
}

impl Http {
    fn to(base: impl std::fmt::Display, token: Option<&str>) -> Self {
        Self { client: client(), base: format!("http://{base}/api/v1"), token: token.map(str::to_owned) }
    }

    fn request(&self, method: Method, path: &str) -> reqwest::RequestBuilder {
        let request = self.client.request(method, format!("{}{path}", self.base)).timeout(PATIENCE);
        match &self.token {
            Some(token) => request.header("authorization", format!("Bearer {token}")),
            None => request,
        }
    }

    async fn get(&self, path: &str) -> (u16, Value) {
        answer(self.request(Method::GET, path)).await
    }

    /// A call with a body of JSON; `Null` for none.
    async fn say(&self, method: Method, path: &str, body: Value) -> (u16, Value) {
        let request = self.request(method, path);
        answer(match body {
            Value::Null => request,
            body => request.header("content-type", "application/json").body(body.to_string()),
        })
        .await
    }
}

/// Status, and the body as JSON; `Null` where it is none.
async fn answer(request: reqwest::RequestBuilder) -> (u16, Value) {
    let answer = request.send().await.unwrap();
    let status = answer.status().as_u16();
    (status, serde_json::from_str(&answer.text().await.unwrap()).unwrap_or_default())
}

fn reason((status, body): &(u16, Value)) -> (u16, &str) {
    (*status, body["error"]["reason"].as_str().unwrap_or_default())
}

async fn with_web() -> (TestCluster, Http) {
    let cluster = TestCluster::with(|config| config.web = Some(([127, 0, 0, 1], 0).into())).await;
    let http = Http::to(cluster.web_address(), None);
    (cluster, http)
}

/// A dataset of the cluster's scene.
async fn commit_dataset(cluster: &TestCluster, id: &str) {
    let text = bytes::Bytes::from(cluster.manifest.to_json().unwrap());
    let manifest = cluster.blobs().upload(&fathom_worker::blobs::BlobSource::Bytes(text)).await.unwrap();
    let file = |path: String, blob| v1::DatasetFile { path, blob: Some(to_proto(blob)) };
    let mut files =
        vec![file("points.bin".into(), &cluster.manifest.points), file("manifest.json".into(), &manifest)];
    let views = cluster.manifest.views.iter();
    files.extend(views.map(|view| file(format!("images/{}", view.name), &view.image)));
    let begin =
        v1::BeginUploadRequest { dataset_id: id.into(), request_id: id.into(), files, ..Default::default() };
    cluster.uploads().begin_upload(begin).await.unwrap();
    cluster.uploads().commit_dataset(v1::CommitDatasetRequest { dataset_id: id.into() }).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn json_calls_say_and_do_what_grpc_does() {
    let (cluster, http) = with_web().await;
    commit_dataset(&cluster, "wreck").await;
    let (status, datasets) = http.get("/datasets").await;
    assert_eq!((status, &datasets["datasets"][0]["dataset"]), (200, &json!("wreck")));
    assert_eq!(http.get("/datasets/wreck").await.1["files"], 18);
    let asked = v1::InspectDatasetRequest { dataset_id: "wreck".into(), ..Default::default() };
    let inspection = cluster.uploads().inspect_dataset(asked).await.unwrap().into_inner();
    let inspected = http.say(Method::POST, "/datasets/wreck/inspect", Value::Null).await;
    assert_eq!(inspected, (200, json::inspection(&inspection)));
    let wrong = json!({"config": {"train": {"iterations": "many"}}});
    assert_eq!(http.say(Method::POST, "/datasets/wreck/inspect", wrong).await.0, 400);
    let new = json!({
        "dataset": "wreck", "name": "over HTTP", "request_id": "one",
        "config": {"partition": {"columns": 2}, "train": {"iterations": 400}},
    });
    let made = http.request(Method::POST, "/jobs").header("content-type", "application/json; charset=utf-8");
    let made = made.body(new.to_string()).send().await.unwrap();
    assert_eq!(made.status(), StatusCode::CREATED);
    let place = made.headers()["location"].to_str().unwrap().to_owned();
    let job_id = serde_json::from_str::<Value>(&made.text().await.unwrap()).unwrap()["job"].clone();
    let job_id = job_id.as_str().unwrap();
    assert_eq!(place, format!("/api/v1/jobs/{job_id}"));
    // The same id of a request is the same job.
    assert_eq!(http.say(Method::POST, "/jobs", new).await.1["job"], job_id);

    let path = format!("/jobs/{job_id}");
    let mut found = http.get(&path).await.1;
    let config = found.as_object_mut().unwrap().remove("config").unwrap();
    assert_eq!(config["train"]["iterations"], 400);
    assert_eq!(found, json::job(&cluster.get(job_id).await));
    let listed = http.get("/jobs?state=running,paused&name=over").await.1;
    assert_eq!((&listed["jobs"][0]["job"], &listed["next_page_token"]), (&json!(job_id), &Value::Null));
    assert_eq!(http.get("/jobs?state=failed").await.1["jobs"], json!([]));

    let paused = http.say(Method::POST, &format!("{path}/pause"), json!({"reason": "tea"})).await;
    assert_eq!(
        (&paused.1["state"], &paused.1["pause_reason"]),
        (&json!("paused"), &json!("tea")),
        "{paused:?}"
    );
    // Without a body, and with an empty one that says it is JSON.
    assert_eq!(http.say(Method::POST, &format!("{path}/resume"), Value::Null).await.1["state"], "running");
    let empty =
        http.request(Method::POST, &format!("{path}/pause")).header("content-type", "application/json");
    assert_eq!(answer(empty).await.1["state"], "paused");
    http.say(Method::POST, &format!("{path}/resume"), json!({})).await;
    let updated = http.say(Method::PATCH, &path, json!({"priority": 5, "max_parallel": 1})).await.1;
    assert_eq!((&updated["priority"], &updated["max_parallel"]), (&json!(5), &json!(1)));

    assert_eq!(reason(&http.say(Method::DELETE, &path, Value::Null).await), (409, "JOB_NOT_ENDED"));
    let worker = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(job_id).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    // One that has left calls no more, so that two looks see the same.
    worker.leave().await;
    let workers = http.get("/workers").await.1;
    assert_eq!(workers["workers"], Value::from_iter(cluster.workers().await.iter().map(json::worker)));
    assert_eq!(http.get("/tenants").await.1["tenants"][0]["open_jobs"], 0);

    let files = http.get(&format!("{path}/files?page_size=1000")).await.1;
    let artifacts = cluster.artifacts(job_id).await;
    let names: Vec<_> =
        files["files"].as_array().unwrap().iter().map(|file| file["path"].as_str().unwrap()).collect();
    assert_eq!(names.len(), artifacts.len());
    for (name, content) in &artifacts {
        let file = http.request(Method::GET, &format!("{path}/files/{name}")).send().await.unwrap();
        assert_eq!(file.headers()["content-length"], content.len().to_string().as_str());
        let tag = file.headers()["etag"].clone();
        assert_eq!(file.bytes().await.unwrap(), content.as_slice(), "{name}");
        let known = http.request(Method::GET, &format!("{path}/files/{name}")).header("if-none-match", tag);
        let known = known.send().await.unwrap();
        let kept = (StatusCode::NOT_MODIFIED, &HeaderValue::from_static("private, no-cache"));
        assert_eq!((known.status(), &known.headers()["cache-control"]), kept);
    }
    let model = http.request(Method::GET, &format!("{path}/files/model.ply")).header("range", "bytes=100-");
    let model = model.send().await.unwrap();
    let whole = &artifacts["model.ply"];
    assert_eq!(
        model.headers()["content-range"],
        format!("bytes 100-{}/{}", whole.len() - 1, whole.len()).as_str()
    );
    assert_eq!(
        (model.status(), model.bytes().await.unwrap()),
        (StatusCode::PARTIAL_CONTENT, whole[100..].to_vec().into())
    );
    let plan = http.get(&path).await.1["plan"].as_str().unwrap().to_owned();
    let plan = http.request(Method::GET, &format!("{path}/blobs/{plan}")).send().await.unwrap();
    assert_eq!(plan.headers()["content-type"], "application/octet-stream");
    assert_eq!(plan.bytes().await.unwrap(), artifacts["plan.json"].as_slice());
    assert_eq!(reason(&http.get(&format!("{path}/blobs/{}", "0".repeat(64))).await), (404, "BLOB_NOT_FOUND"));
    let head = http.request(Method::HEAD, &format!("{path}/files/model.ply")).send().await.unwrap();
    assert_eq!(head.headers()["content-length"], whole.len().to_string().as_str());
    // A weak tag among others, as a proxy that compresses sends it.
    let tag = format!("\"other\", W/{}", head.headers()["etag"].to_str().unwrap());
    let known = http.request(Method::GET, &format!("{path}/files/model.ply")).header("if-none-match", tag);
    assert_eq!(known.send().await.unwrap().status(), StatusCode::NOT_MODIFIED);
    let metrics = cluster.page("/metrics").await.1;
    let reads: Vec<_> = metrics.lines().filter(|line| line.contains("UploadService/ReadBlob")).collect();
    assert!(!reads.is_empty() && !reads.iter().any(|line| line.contains("cancelled")), "{reads:?}");
    let beyond =
        http.request(Method::GET, &format!("{path}/files/model.ply")).header("range", "bytes=99999999-");
    assert_eq!(answer(beyond).await.0, 416);
    assert_eq!(reason(&http.get(&format!("{path}/files/no.ply")).await), (404, "NOT_FOUND"));

    assert_eq!(http.say(Method::DELETE, &path, Value::Null).await.0, 204);
    assert_eq!(reason(&http.get(&path).await), (404, "JOB_NOT_FOUND"));
}

#[tokio::test]
async fn a_log_comes_in_pages_and_by_level() {
    let (cluster, http) = with_web().await;
    let job = cluster.submit("a job", 1).await;
    let (mut worker, claim) = cluster.worker_by_hand("by hand").await;
    let lease = worker.claim(claim).await.unwrap().into_inner().assignment.unwrap().lease.unwrap();
    let line = |number: u64| {
        let severity = if number == 4 { v1::LogSeverity::Warn } else { v1::LogSeverity::Info };
        worker_v1::LogLine {
            number,
            time: None,
            severity: severity.into(),
            message: format!("line {number}"),
        }
    };
    let request =
        worker_v1::AppendLogsRequest { lease: Some(lease.clone()), lines: (1..=5).map(line).collect() };
    worker.append_logs(request).await.unwrap();
    let path = format!("/jobs/{job}/logs?task={}", lease.task_id);
    let (mut after, mut all, mut pages) = (0, Vec::new(), 0);
    loop {
        let page = http.get(&format!("{path}&after={after}&limit=2")).await.1;
        all.extend(page["lines"].as_array().unwrap().clone());
        after = page["next_after"].as_u64().unwrap();
        pages += 1;
        if page["more"] == false {
            break;
        }
    }
    let wanted = v1::StreamLogsRequest { job_id: job.clone(), task_id: lease.task_id, ..Default::default() };
    let lines = cluster.logs(wanted).await;
    assert_eq!((all, pages), (lines.iter().map(json::log_line).collect(), 3));
    // Where the next line will be found.
    let none = http.get(&format!("{path}&after={after}")).await.1;
    assert_eq!(none, json!({"lines": [], "next_after": after, "more": false}));
    let warnings = http.get(&format!("{path}&level=warn")).await.1;
    assert_eq!(
        (warnings["lines"].as_array().unwrap().len(), &warnings["lines"][0]["message"]),
        (1, &json!("line 4"))
    );
}

#[tokio::test]
async fn wrong_requests_are_answered_with_what_is_wrong() {
    let (cluster, http) = with_web().await;
    let job = cluster.submit("a job", 1).await;
    let pause = format!("/jobs/{job}/pause");
    let bad = (400, "BAD_ARGUMENT");
    let said = |body: Value, part: &str| {
        let text = body["error"]["message"].as_str().unwrap_or_default().to_owned();
        assert!(text.contains(part), "{text}");
    };
    for (path, part) in [
        ("/jobs?stat=failed", "stat"),
        ("/jobs?state=lost", "running, succeeded"),
        ("/jobs?page_size=many", "page_size"),
        ("/jobs/not-an-id", "job"),
        ("/jobs/%ff", "UTF-8"),
        (&*format!("/jobs/{job}/logs?level=loud"), "trace, debug"),
    ] {
        let found = http.get(path).await;
        assert_eq!(reason(&found), bad, "{path}: {found:?}");
        said(found.1, part);
    }
    let found = http.say(Method::POST, &pause, json!({"why": "tea"})).await;
    assert_eq!(reason(&found), bad);
    said(found.1, "`why`");
    let found = http.say(Method::POST, "/jobs", json!({"name": "no dataset"})).await;
    assert_eq!(reason(&found), bad);
    said(found.1, "dataset");
    let found = http.say(Method::PATCH, &format!("/jobs/{job}"), json!({"priority": 5000})).await;
    assert_eq!((reason(&found), &found.1["error"]["fields"][0]["field"]), (bad, &json!("priority")));
    assert_eq!(http.say(Method::POST, &format!("/jobs/{job}/resume"), json!({"a": 1})).await.0, 400);

    let form = http.request(Method::POST, &pause).body("reason=tea");
    assert_eq!(answer_of(form).await, (415, "BAD_ARGUMENT".into()));
    let long = http.say(Method::POST, &pause, json!({"reason": "a".repeat(70_000)})).await;
    assert_eq!(reason(&long), (413, "TOO_LARGE"));
    // In pieces, without a length.
    let pieces = futures::stream::iter(["{\"rea", "son\": \"pieces\"}"].map(Ok::<_, std::io::Error>));
    let pieces = reqwest::Body::wrap_stream(pieces);
    let pieces = http.request(Method::POST, &pause).header("content-type", "application/json").body(pieces);
    assert_eq!(answer(pieces).await.1["pause_reason"], "pieces");

    assert_eq!(reason(&http.get("/nothing").await), (404, "NOT_FOUND"));
    assert_eq!(reason(&http.say(Method::PUT, "/jobs", Value::Null).await), (405, "METHOD_NOT_ALLOWED"));
    let events = http.request(Method::GET, &format!("/jobs/{job}/events")).header("last-event-id", "first");
    assert_eq!(answer_of(events).await, (400, "BAD_ARGUMENT".into()));
    for path in ["index.html", "assets/none.js", "assets/../view.html", "handover.html"] {
        let beside = answer(http.client.get(format!("http://{}/{path}", cluster.web_address()))).await;
        assert_eq!(reason(&beside), (404, "NOT_FOUND"), "{path}");
    }
    let found = http.request(Method::GET, "/jobs").send().await.unwrap();
    assert_eq!(found.headers()["x-content-type-options"], "nosniff");
    assert_eq!(found.headers()["cache-control"], "no-store");
    assert!(found.headers()["content-security-policy"].to_str().unwrap().starts_with("default-src 'none'"));
}

async fn answer_of(request: reqwest::RequestBuilder) -> (u16, String) {
    let answer = answer(request).await;
    let (status, reason) = reason(&answer);
    (status, reason.to_owned())
}

#[tokio::test]
async fn another_website_reaches_nothing() {
    let (cluster, http) = with_web().await;
    let here = cluster.web_address();
    let asks = async |pairs: &[(&'static str, &str)]| {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(HeaderName::from_static(name), HeaderValue::from_str(value).unwrap());
        }
        answer(http.request(Method::GET, "/jobs").headers(headers)).await
    };
    let own = format!("http://{here}");
    assert_eq!(asks(&[("origin", &own), ("sec-fetch-site", "same-origin")]).await.0, 200);
    let refused = (403, "OTHER_SITE");
    assert_eq!(reason(&asks(&[("origin", "http://wreck.example")]).await), refused);
    let foreign = http.request(Method::GET, "/jobs").header("origin", "http://wreck.example");
    assert_eq!(foreign.send().await.unwrap().headers()["x-content-type-options"], "nosniff");
    assert_eq!(reason(&asks(&[("sec-fetch-site", "cross-site")]).await), refused);
    // A name that somebody made to point here.
    let rebound = format!("wreck.example:{}", here.port());
    assert_eq!(reason(&asks(&[("host", &rebound), ("origin", &format!("http://{rebound}"))]).await), refused);
    let localhost = format!("localhost:{}", here.port());
    assert_eq!(asks(&[("host", &localhost), ("origin", &format!("http://{localhost}"))]).await.0, 200);
    // gRPC-Web is behind the same door.
    let call = http.client.post(format!("http://{here}/fathom.v1.JobService/ListJobs"));
    let call =
        call.header("content-type", "application/grpc-web+proto").header("origin", "http://wreck.example");
    assert_eq!(call.body(vec![0; 5]).send().await.unwrap().status(), StatusCode::FORBIDDEN);
}

#[tokio::test]
async fn tokens_roles_and_tenants_are_those_of_grpc() {
    let cluster = GuardedCluster::start(|config, _| {
        (config.web, config.backoff_ms) = (Some(([127, 0, 0, 1], 0).into()), 60_000);
    })
    .await;
    let address = cluster.coordinator.web_address().unwrap();
    let http = |token: Option<&str>| Http::to(address, token);
    let (reef, _) = cluster.issue(Role::Submitter, "reef").await;
    let (looks, _) = cluster.issue(Role::Viewer, "reef").await;
    let (wreck, wreck_id) = cluster.issue(Role::Submitter, "wreck").await;
    let job = cluster.with(Some(&reef)).job("one").await.unwrap().job_id;
    let pause = format!("/jobs/{job}/pause");

    let missing = http(None).request(Method::GET, "/jobs").send().await.unwrap();
    assert_eq!(
        (missing.status(), &missing.headers()["www-authenticate"]),
        (StatusCode::UNAUTHORIZED, &HeaderValue::from_static("Bearer"))
    );
    assert_eq!(reason(&http(None).get("/jobs").await), (401, "TOKEN_MISSING"));
    assert_eq!(reason(&http(Some("nonsense")).get("/nothing").await), (401, "TOKEN_REFUSED"));
    // Refused before the body, which never comes.
    let mut raw = TcpStream::connect(address).await.unwrap();
    let head = format!(
        "POST /api/v1{pause} HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
    );
    raw.write_all(head.as_bytes()).await.unwrap();
    let mut begin = [0; 12];
    tokio::time::timeout(Duration::from_secs(10), raw.read_exact(&mut begin)).await.unwrap().unwrap();
    assert_eq!(&begin, b"HTTP/1.1 401");

    assert_eq!(http(Some(&looks)).get("/jobs").await.1["jobs"][0]["job"], job);
    assert_eq!(
        reason(&http(Some(&looks)).say(Method::POST, &pause, Value::Null).await),
        (403, "ROLE_REFUSED")
    );
    assert_eq!(reason(&http(Some(&reef)).get("/workers").await), (403, "ROLE_REFUSED"));
    assert_eq!(reason(&http(Some(&wreck)).get(&format!("/jobs/{job}")).await), (404, "JOB_NOT_FOUND"));
    assert_eq!(http(Some(&wreck)).get("/jobs").await.1["jobs"], json!([]));
    assert_eq!(reason(&http(Some(&reef)).get("/tokens").await), (403, "ROLE_REFUSED"));
    let operator = http(Some(&cluster.first_token()));
    assert_eq!(operator.get("/workers").await.0, 200);
    let tokens =
        cluster.operator().admin().list_tokens(ListTokensRequest {}).await.unwrap().into_inner().tokens;
    assert!(tokens.len() > 3, "{tokens:?}");
    assert_eq!(operator.get("/tokens").await.1["tokens"], Value::from_iter(tokens.iter().map(json::token)));
    // Only the page of one process has invitations.
    assert_eq!(reason(&operator.say(Method::POST, "/enter", Value::Null).await), (401, "TOKEN_REFUSED"));

    // A stream ends with the token that opened it.
    let own = cluster.lasting_job(&cluster.with(Some(&wreck)), "wreck", "two").await.job_id;
    let mut events =
        http(Some(&wreck)).request(Method::GET, &format!("/jobs/{own}/events")).send().await.unwrap();
    let mut begun = String::new();
    while !begun.contains("event: job_state") {
        begun += std::str::from_utf8(&events.chunk().await.unwrap().unwrap()).unwrap();
    }
    let revoke = fathom_proto::admin::v1::RevokeTokenRequest { token_id: wreck_id, even_last: false };
    cluster.operator().admin().revoke_token(revoke).await.unwrap();
    let rest = tokio::time::timeout(PATIENCE, events.text()).await.unwrap().unwrap_or_default();
    assert!(!rest.contains("event: end"), "{rest}");
    assert!(rest.contains("event: fault") && rest.contains("TOKEN_REFUSED"), "{rest}");
    assert_eq!(reason(&http(Some(&wreck)).get("/jobs").await), (401, "TOKEN_REFUSED"));
}

/// The blocks of a stream of server-sent events: (event, id, data).
fn blocks(text: &str) -> Vec<(String, Option<u64>, Value)> {
    let field = |block: &str, name: &str| {
        block.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": ").map(str::to_owned))
    };
    let blocks = text.split("\n\n").filter(|block| block.contains("data: "));
    blocks
        .map(|block| {
            let data = serde_json::from_str(&field(block, "data").unwrap()).unwrap();
            (field(block, "event").unwrap(), field(block, "id").map(|id| id.parse().unwrap()), data)
        })
        .collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_go_on_behind_the_last_and_end_with_the_job() {
    let (mut cluster, http) = with_web().await;
    let job = cluster.submit("a job", 2).await;
    let path = format!("/jobs/{job}/events");
    let mut first = http.request(Method::GET, &path).timeout(PATIENCE).send().await.unwrap();
    assert_eq!(first.headers()["content-type"], "text/event-stream");
    let mut text = String::new();
    while !text.contains("event: job_state") {
        text += std::str::from_utf8(&first.chunk().await.unwrap().unwrap()).unwrap();
    }
    // The stream of a coordinator that stops says nothing of an end, and does not hold it up.
    cluster.restart().await;
    while let Ok(Some(piece)) = first.chunk().await {
        text += std::str::from_utf8(&piece).unwrap();
    }
    let seen = blocks(&text);
    assert!(seen.iter().all(|(event, _, _)| event != "end"), "{text}");
    let last = seen.iter().filter_map(|(_, id, _)| *id).max().unwrap();

    let http = Http::to(cluster.web_address(), None);
    let rest = http.request(Method::GET, &path).header("last-event-id", last).send().await.unwrap();
    let _worker = cluster.worker(FakeTrainer::quick());
    let rest = blocks(&tokio::time::timeout(PATIENCE, rest.text()).await.unwrap().unwrap());
    let (end, _, state) = rest.last().unwrap();
    assert_eq!((end.as_str(), &state["state"]), ("end", &json!("succeeded")));

    let durable: Vec<_> = cluster.events(&job, 0).await.into_iter().filter(is_durable).collect();
    let sent: Vec<_> = seen.iter().chain(&rest).filter(|(_, id, _)| id.is_some()).collect();
    assert_eq!(sent.len(), durable.len(), "an event is missing or there twice");
    for ((_, id, data), event) in sent.iter().zip(&durable) {
        assert_eq!((id.unwrap(), data), (event.seq, &json::event(event).unwrap()));
    }
    let whole =
        http.request(Method::GET, &format!("{path}?after={}", durable.len() - 1)).send().await.unwrap();
    assert_eq!(blocks(&whole.text().await.unwrap()).len(), 2, "the last event and the end");
    assert_eq!(http.get(&path.replace(&job, &"0".repeat(job.len()))).await.0, 404);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_waits_for_no_client_and_frees_the_store() {
    let (mut cluster, _) = with_web().await;
    let job = cluster.submit("a job", 1).await;
    let address = cluster.web_address();
    let begin = |request: String| async move {
        let mut stream = TcpStream::connect(address).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        stream
    };
    let post = format!("POST /api/v1/jobs/{job}/pause HTTP/1.1\r\nHost: {address}\r\n");
    let open = [
        // Half a header, a body that does not come, and events that nobody reads.
        begin(format!("GET /api/v1/jobs HTTP/1.1\r\nHost: {address}")).await,
        begin(format!("{post}Content-Type: application/json\r\nContent-Length: 9\r\n\r\n")).await,
        begin(format!("GET /api/v1/jobs/{job}/events HTTP/1.1\r\nHost: {address}\r\n\r\n")).await,
    ];
    // The store belongs to one coordinator, so the next one could not start.
    cluster.restart().await;
    assert_eq!(cluster.get(&job).await.job_id, job);
    drop(open);
}

/// A message in a frame of gRPC-Web.
fn frame(message: &impl prost::Message) -> Vec<u8> {
    let bytes = message.encode_to_vec();
    [&[0][..], &(bytes.len() as u32).to_be_bytes(), &bytes].concat()
}

/// The messages and the trailers of an answer.
fn frames(mut bytes: &[u8]) -> (Vec<&[u8]>, String) {
    let (mut messages, mut trailers) = (Vec::new(), String::new());
    while let [kind, a, b, c, d, rest @ ..] = bytes {
        let (content, after) = rest.split_at(u32::from_be_bytes([*a, *b, *c, *d]) as usize);
        if *kind & 0x80 == 0 {
            messages.push(content)
        } else {
            trailers += std::str::from_utf8(content).unwrap()
        }
        bytes = after;
    }
    (messages, trailers)
}

#[tokio::test]
async fn a_page_calls_the_services_of_users_by_grpc_web() {
    let cluster = GuardedCluster::start(|config, _| config.web = Some(([127, 0, 0, 1], 0).into())).await;
    let address = cluster.coordinator.web_address().unwrap();
    let (token, _) = cluster.issue(Role::Submitter, "reef").await;
    let client = client();
    let call = async |token: Option<&str>, method: &str, body: Vec<u8>| {
        let mut request = client.post(format!("http://{address}/{method}"));
        request = request.header("content-type", "application/grpc-web+proto").header("x-grpc-web", "1");
        request = request.header("origin", format!("http://{address}")).body(body);
        if let Some(token) = token {
            request = request.header("authorization", format!("Bearer {token}"));
        }
        let answer = request.send().await.unwrap();
        let refused = answer.headers().get("grpc-status").map(|code| code.to_str().unwrap().to_owned());
        (refused, answer.bytes().await.unwrap())
    };
    // A file in pieces, by a call for each: this is how a page uploads.
    let content: Vec<u8> = (0..300_000u32).map(|i| (i % 251) as u8).collect();
    let whole = blob(&content);
    for (index, piece) in content.chunks(100_000).enumerate() {
        let offset_bytes = 100_000 * index as u64;
        let finish = index == 2;
        let data = piece.to_vec().into();
        let message = v1::WriteBlobRequest {
            blob: Some(whole.clone()),
            offset_bytes,
            data,
            finish,
            ..Default::default()
        };
        let (refused, answer) =
            call(Some(&token), "fathom.v1.UploadService/WriteChunk", frame(&message)).await;
        assert_eq!(refused, None);
        let (messages, trailers) = frames(&answer);
        assert!(trailers.contains("grpc-status:0") || trailers.contains("grpc-status: 0"), "{trailers}");
        let said = v1::WriteBlobResponse::decode(messages[0]).unwrap();
        assert_eq!((said.committed_size_bytes, said.complete), (offset_bytes + piece.len() as u64, finish));
    }
    // The same piece again: the blob is there.
    let again = v1::WriteBlobRequest { blob: Some(whole.clone()), ..Default::default() };
    let (_, answer) = call(Some(&token), "fathom.v1.UploadService/WriteChunk", frame(&again)).await;
    assert!(v1::WriteBlobResponse::decode(frames(&answer).0[0]).unwrap().complete);
    let long = v1::BlobRef { digest: whole.digest.clone(), size_bytes: (256 << 20) + 1 };
    let long = v1::WriteBlobRequest { blob: Some(long), ..Default::default() };
    let (refused, _) = call(Some(&token), "fathom.v1.UploadService/WriteChunk", frame(&long)).await;
    assert_eq!(refused, Some((tonic::Code::InvalidArgument as i32).to_string()));
    // A stream of the server comes as several messages.
    let read = v1::ReadBlobRequest { digest: whole.digest.clone(), ..Default::default() };
    let (_, answer) = call(Some(&token), "fathom.v1.UploadService/ReadBlob", frame(&read)).await;
    let pieces = frames(&answer).0.into_iter().map(|piece| v1::ReadBlobResponse::decode(piece).unwrap().data);
    assert_eq!(pieces.collect::<Vec<_>>().concat(), content);

    let list = frame(&v1::ListJobsRequest::default());
    let unauthenticated = Some((tonic::Code::Unauthenticated as i32).to_string());
    assert_eq!(call(None, "fathom.v1.JobService/ListJobs", list.clone()).await.0, unauthenticated);
    let denied = Some((tonic::Code::PermissionDenied as i32).to_string());
    assert_eq!(call(Some(&token), "fathom.admin.v1.AdminService/ListWorkers", Vec::new()).await.0, denied);
    // Workers have no business here.
    let nowhere = client.post(format!("http://{address}/fathom.worker.v1.WorkerService/Claim")).body(list);
    assert_eq!(nowhere.send().await.unwrap().status(), StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn over_tls_both_versions_of_http_are_spoken() {
    let dir = tempfile::tempdir().unwrap();
    let authority = Authority::new(dir.path(), "ours");
    let (cert, key) = authority.certify("server");
    let cluster = GuardedCluster::start(|config, _| {
        config.web = Some(([127, 0, 0, 1], 0).into());
        (config.tls_cert, config.tls_key) = (Some(cert.clone()), Some(key.clone()));
        // Asked of workers, at the other address.
        config.client_ca = Some(authority.ca());
    })
    .await;
    let address = cluster.coordinator.web_address().unwrap();
    let token = std::fs::read_to_string(cluster.dir.path().join("data/operator.token")).unwrap();
    let _ = client();
    let root = reqwest::Certificate::from_pem(&std::fs::read(authority.ca()).unwrap()).unwrap();
    for (http1, version) in [(true, reqwest::Version::HTTP_11), (false, reqwest::Version::HTTP_2)] {
        let mut client = Client::builder().tls_certs_only([root.clone()]);
        if http1 {
            client = client.http1_only();
        }
        let request = client.build().unwrap().get(format!("https://{address}/api/v1/jobs"));
        let request = request.header("authorization", format!("Bearer {}", token.trim())).timeout(PATIENCE);
        let answer = request.header("origin", format!("https://{address}")).send().await.unwrap();
        assert_eq!((answer.status(), answer.version()), (StatusCode::OK, version));
    }
}
