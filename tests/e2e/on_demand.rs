//! Workers that come and go with the work: started by a double of KEDA, or by the Slurm script. All of them
//! are real processes.

use std::collections::HashMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fathom_proto::dial::Dial;
use fathom_proto::keda::external_scaler_client::ExternalScalerClient;
use fathom_proto::keda::{GetMetricsRequest, ScaledObjectRef};
use serde_json::Value;

use crate::processes::{Service, can_train, fathom, free_port, json, succeed, tiny_scene, under};

const PATIENCE: Duration = Duration::from_secs(300);

/// The metric of a pool of all workers, as KEDA asks for it.
async fn demand(url: &str) -> usize {
    let object = ScaledObjectRef {
        name: "workers".into(),
        namespace: "fathom".into(),
        scaler_metadata: HashMap::new(),
    };
    let mut client = ExternalScalerClient::new(Dial::to(url).lazily().expect("a URL"));
    let spec = client.get_metric_spec(object.clone()).await.expect("a spec").into_inner();
    let metric_name = spec.metric_specs[0].metric_name.clone();
    let request = GetMetricsRequest { scaled_object_ref: Some(object), metric_name };
    let values = client.get_metrics(request).await.expect("a value").into_inner().metric_values;
    usize::try_from(values[0].metric_value).expect("a count")
}

/// Processes that have not ended; each that has must have succeeded.
fn still_running(workers: Vec<Child>) -> Vec<Child> {
    let runs = |mut child: Child| match child.try_wait().expect("a child") {
        None => Some(child),
        Some(status) => {
            assert!(status.success(), "a worker ended with {status}");
            None
        }
    };
    workers.into_iter().filter_map(runs).collect()
}

#[tokio::test]
async fn worker_processes_come_from_zero_and_go_back_to_zero() {
    let test = "worker_processes_come_from_zero_and_go_back_to_zero";
    if !can_train(test) {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| under(folder.path(), name);
    let scene = tiny_scene(folder.path());
    let scaler = format!("127.0.0.1:{}", free_port());
    let flags = ["--data-dir", &at("data"), "--listen", "127.0.0.1:0", "--scaler-listen", &scaler];
    let (_coordinator, url) = Service::coordinator_with(&flags);
    let scaler = format!("http://{scaler}");
    assert_eq!(demand(&scaler).await, 0);
    let submit = ["submit", &scene, "--coordinator", &url, "--partitions", "2x2", "--iterations", "400"];
    let job = succeed(&[&submit[..], &["--max-gaussians", "2000"]].concat()).trim().to_owned();
    let show = || json(&["show", &job, "--coordinator", &url, "--json"]);

    // The strategy `default` of a ScaledJob, with at most 3 jobs.
    let (mut workers, mut most, mut started) = (Vec::new(), 0, 0);
    let begin = Instant::now();
    loop {
        assert!(begin.elapsed() < PATIENCE, "the job does not end: {:#}", show());
        let wanted = demand(&scaler).await.min(3);
        workers = still_running(workers);
        for _ in workers.len()..wanted {
            started += 1;
            let name = format!("on-demand-{started}");
            let worker = ["worker", "--coordinator", &url, "--allow-cpu", "--name", &name];
            let limits = ["--cache-dir", &at("cache"), "--exit-when-idle", "3s"];
            let child = fathom(&[&worker[..], &limits].concat()).stdout(Stdio::null()).spawn();
            workers.push(child.expect("the binary starts"));
        }
        most = most.max(workers.len());
        if show()["state"] == "succeeded" && workers.is_empty() {
            break;
        }
        // Shorter than a partition takes, so that several are waiting when this looks.
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert_eq!((demand(&scaler).await, most), (0, 3));
    assert!(started <= 4, "{started} workers for 4 partitions, at most 3 at a time");
    slurm_returns_its_task(&url, &scene, folder.path()).await;
}

/// The script of `deploy/`, as Slurm runs and stops it: in the middle of a task.
async fn slurm_returns_its_task(url: &str, scene: &str, folder: &Path) {
    let program = Path::new(env!("CARGO_BIN_EXE_fathom")).parent().expect("its folder");
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap_or_default());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/fathom-workers.sbatch");
    let caches = folder.join("caches");
    std::fs::create_dir(&caches).expect("a folder");
    let mut command = Command::new("bash");
    command.arg(&script).env("PATH", path).env("TMPDIR", &caches).env("FATHOM_ALLOW_CPU", "true");
    command.env("SLURM_JOB_ID", "71").env("SLURM_ARRAY_JOB_ID", "70").env("SLURM_ARRAY_TASK_ID", "3");
    let without = command.env_remove("FATHOM_COORDINATOR").output().expect("bash runs");
    assert!(String::from_utf8_lossy(&without.stderr).contains("set FATHOM_COORDINATOR"), "{without:?}");

    let submit = ["submit", scene, "--coordinator", url, "--partitions", "1x1", "--iterations", "50000"];
    let job = succeed(&[&submit[..], &["--max-gaussians", "2000"]].concat()).trim().to_owned();
    let show = || json(&["show", &job, "--coordinator", url, "--json"]);
    let leased = |shown: &Value| {
        let tasks = shown["tasks"].as_array().cloned().unwrap_or_default();
        tasks.into_iter().find(|task| task["worker"] == "slurm-70-3" && task["state"] == "running")
    };
    let mut script = command.env("FATHOM_COORDINATOR", url).spawn().expect("bash starts");
    let begin = Instant::now();
    let task = loop {
        if let Some(task) = leased(&show()) {
            break task["task"].clone();
        }
        assert!(begin.elapsed() < PATIENCE, "the worker of the script takes no task: {:#}", show());
        tokio::time::sleep(Duration::from_millis(200)).await;
    };
    let stop = Command::new("kill").arg("-TERM").arg(script.id().to_string()).status();
    assert!(stop.expect("kill runs").success());
    let status = script.wait().expect("the script ends");
    assert!(status.success(), "the script ended with {status}");
    let shown = show();
    let tasks = shown["tasks"].as_array().expect("a list");
    let task = tasks.iter().find(|found| found["task"] == task).expect("the task");
    assert_eq!((task["state"].as_str(), task["losses"].as_u64()), (Some("ready"), Some(0)), "{task:#}");
    assert_eq!(std::fs::read_dir(&caches).expect("the folder").count(), 0, "a cache stays behind");
}
