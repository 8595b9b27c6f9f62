//! A server sends text that moves cursors, forges lines and reverses the reading order; none of it reaches a
//! terminal.

use std::process::Stdio;

use crate::processes::fathom;
use fathom_proto::v1;
use fathom_proto::v1::job_event::Event;
use fathom_proto::v1::job_service_server::{JobService, JobServiceServer};
use futures::stream::BoxStream;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, async_trait};

/// Clears the screen, starts a line, rings, colours by C1, breaks a line by Unicode, reverses the reading
/// order.
const EVIL: &str = "reef\u{1b}[2J\nforged line\u{7}\u{7f}\u{9b}31m\u{2028}\u{202e}";
/// The same text as it must be printed.
const SEEN: &str = r"reef\u{1b}[2J\nforged line\u{7}\u{7f}\u{9b}31m\u{2028}\u{202e}";

/// Answers with such text in every text field.
struct Hostile;

fn job() -> v1::Job {
    let task = v1::Task {
        task_id: EVIL.into(),
        state: v1::TaskState::Leased.into(),
        worker: EVIL.into(),
        second_worker: EVIL.into(),
        last_errors: vec![EVIL.into()],
        ..Default::default()
    };
    v1::Job {
        job_id: EVIL.into(),
        name: EVIL.into(),
        tenant: EVIL.into(),
        state: v1::JobState::Failed.into(),
        error: EVIL.into(),
        waiting_reason: EVIL.into(),
        pause_reason: EVIL.into(),
        tasks: vec![task],
        ..Default::default()
    }
}

type Stream<T> = BoxStream<'static, Result<T, Status>>;

fn once<T: Send + 'static>(items: Vec<T>) -> Result<Response<Stream<T>>, Status> {
    Ok(Response::new(Box::pin(futures::stream::iter(items.into_iter().map(Ok)))))
}

#[async_trait]
impl JobService for Hostile {
    async fn get_job(&self, _: Request<v1::GetJobRequest>) -> Result<Response<v1::Job>, Status> {
        Ok(Response::new(job()))
    }

    async fn list_jobs(
        &self,
        _: Request<v1::ListJobsRequest>,
    ) -> Result<Response<v1::ListJobsResponse>, Status> {
        Ok(Response::new(v1::ListJobsResponse { jobs: vec![job()], next_page_token: String::new() }))
    }

    type WatchJobStream = Stream<v1::JobEvent>;

    async fn watch_job(
        &self,
        _: Request<v1::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let changed = v1::TaskChanged {
            task_id: EVIL.into(),
            state: v1::TaskState::Leased.into(),
            message: EVIL.into(),
            ..Default::default()
        };
        let progress = v1::TaskProgress {
            task_id: EVIL.into(),
            progress: Some(v1::Progress { iteration: 1, iterations: 2, ..Default::default() }),
            job_progress: 0.5,
        };
        let warning = v1::Warning { message: EVIL.into() };
        let event = |event| v1::JobEvent { job_id: EVIL.into(), seq: 1, time: None, event: Some(event) };
        once(
            [Event::TaskChanged(changed), Event::Progress(progress), Event::Warning(warning)]
                .map(event)
                .into(),
        )
    }

    type StreamLogsStream = Stream<v1::LogEntry>;

    async fn stream_logs(
        &self,
        _: Request<v1::StreamLogsRequest>,
    ) -> Result<Response<Self::StreamLogsStream>, Status> {
        let (task_id, worker, message) = (EVIL.into(), EVIL.into(), EVIL.into());
        once(vec![v1::LogEntry { task_id, worker, message, ..Default::default() }])
    }

    async fn create_job(&self, _: Request<v1::CreateJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn cancel_job(&self, _: Request<v1::CancelJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn pause_job(&self, _: Request<v1::PauseJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn resume_job(&self, _: Request<v1::ResumeJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn retry_job(&self, _: Request<v1::RetryJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn update_job(&self, _: Request<v1::UpdateJobRequest>) -> Result<Response<v1::Job>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn get_history(&self, _: Request<v1::GetHistoryRequest>) -> Result<Response<v1::History>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn share_job(
        &self,
        _: Request<v1::ShareJobRequest>,
    ) -> Result<Response<v1::ShareJobResponse>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn delete_job(
        &self,
        _: Request<v1::DeleteJobRequest>,
    ) -> Result<Response<v1::DeleteJobResponse>, Status> {
        Err(Status::invalid_argument(EVIL))
    }

    async fn list_artifacts(
        &self,
        _: Request<v1::ListArtifactsRequest>,
    ) -> Result<Response<v1::ListArtifactsResponse>, Status> {
        Err(Status::invalid_argument(EVIL))
    }
}

#[test]
fn server_text_is_escaped_before_it_reaches_a_terminal() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let url = runtime.block_on(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let served = tonic::transport::Server::builder().add_service(JobServiceServer::new(Hostile));
        tokio::spawn(served.serve_with_incoming(TcpListenerStream::new(listener)));
        url
    });
    for verb in [
        &["ls"][..],
        &["show", "j"],
        &["watch", "j"],
        &["logs", "j"],
        &["cancel", "j"],
        &["retry", "j"],
        &["pause", "j"],
        &["download", "j", "-o", "nowhere"],
    ] {
        let is_error = matches!(verb[0], "cancel" | "retry" | "pause");
        for more in [&[][..], &["--json"]] {
            let arguments = [verb, more, &["--coordinator", &url]].concat();
            let run = fathom(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).output().unwrap();
            let said = [run.stdout, run.stderr].map(|text| String::from_utf8(text).unwrap()).concat();
            let unseen = said.chars().find(|&c| fathom_observe::is_unseen(c) && c != '\n');
            assert_eq!(unseen, None, "{verb:?} {more:?}: {said:?}");
            // A log message may have several lines; all but the first are indented.
            assert!(!said.lines().any(|line| line.starts_with("forged")), "{verb:?} {more:?}: {said}");
            if more.is_empty() && !matches!(verb[0], "logs" | "download") || is_error {
                assert!(said.contains(SEEN), "{verb:?}: {said}");
            }
        }
    }
}
