//! Logs of jobs and processes, with real processes that are killed.

use std::fs::File;
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::processes::{
    Service, can_train, fail, fathom, free_port, json, output_of, succeed, tiny_scene, under,
};
use serde_json::Value;

/// Much longer than any step here takes on two busy cores.
const PATIENCE: Duration = Duration::from_secs(240);

/// A service that logs JSON to a file.
fn service(arguments: &[&str], log: &str) -> Service {
    let log = File::create(log).expect("a log file");
    let arguments = [arguments, &["--log-format", "json"]].concat();
    Service::logging_to(&arguments, Stdio::piped(), log.into())
}

fn lines(job: &str, url: &str, more: &[&str]) -> Vec<Value> {
    let text = succeed(&[&["logs", job, "--coordinator", url, "--json"][..], more].concat());
    text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
}

/// Waits for a log line of a task with these words.
fn wait_for(job: &str, url: &str, task: &str, words: &str) {
    let begin = Instant::now();
    while !lines(job, url, &["--task", task])
        .iter()
        .any(|line| line["message"].as_str().is_some_and(|message| message.starts_with(words)))
    {
        assert!(begin.elapsed() < PATIENCE, "{task} never logged {words:?}");
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Every log line of a process, as JSON.
fn logged(log: &str) -> Vec<Value> {
    let text = std::fs::read_to_string(log).expect("a log");
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e} in {line}"))).collect()
}

#[test]
fn log_lines_survive_a_killed_worker_and_coordinator() {
    if !can_train("log_lines_survive_a_killed_worker_and_coordinator") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let of = |name: &str| under(folder.path(), name);
    let (data, cache) = (of("data"), of("cache"));
    let scene = tiny_scene(folder.path());
    let port = free_port();
    let (listen, url) = (format!("127.0.0.1:{port}"), format!("http://127.0.0.1:{port}"));
    let coordinate = ["coordinator", "--data-dir", &data, "--listen", &listen, "--lease-ms", "2000"];
    let mut coordinator = service(&coordinate, &of("coordinator.log"));
    coordinator.wait_until_it_listens();
    let work = |name: &'static str| {
        let arguments =
            ["worker", "--coordinator", &url, "--name", name, "--cache-dir", &cache, "--allow-cpu"];
        service(&arguments, &of(&format!("{name}.log")))
    };
    let mut victim = work("victim");
    let settings = ["--partitions=1x1", "--iterations=500", "--max-gaussians=3000"];
    let often = ["--set=train.checkpoint_seconds=1", "--coordinator", &url];
    let job = succeed(&[&["submit", &scene][..], &settings, &often].concat()).trim().to_owned();

    wait_for(&job, &url, "partition-0000", "checkpoint stored");
    victim.kill();
    let of_victim = lines(&job, &url, &["--task", "partition-0000", "--attempt", "1"]);
    let by = |line: &Value, worker: &str| line["worker"] == worker;
    assert!(of_victim.len() >= 2 && of_victim.iter().all(|line| by(line, "victim")), "{of_victim:#?}");
    wait_for(&job, &url, "partition-0000", "the lease was revoked: its worker stopped renewing");

    coordinator.kill();
    let mut coordinator = service(&coordinate, &of("coordinator-again.log"));
    coordinator.wait_until_it_listens();
    let still = lines(&job, &url, &["--task", "partition-0000", "--attempt", "1"]);
    assert_eq!(still[..of_victim.len()], of_victim, "lines were lost with the coordinator");

    // Follows the rest of the job, and ends with it.
    let follower = fathom(&["logs", &job, "--coordinator", &url, "--follow", "--json"])
        .stdout(Stdio::piped())
        .spawn()
        .expect("the binary starts");
    let _watchdog = crate::processes::Watchdog::over(&follower);
    let _successor = work("successor");
    succeed(&["watch", &job, "--coordinator", &url]);
    let followed = follower.wait_with_output().expect("its output");
    assert!(followed.status.success());
    let all = lines(&job, &url, &[]);
    let followed = String::from_utf8(followed.stdout).expect("text");
    let followed: Vec<Value> = followed.lines().map(|l| serde_json::from_str(l).expect("JSON")).collect();
    assert_eq!(followed, all);
    assert!(all.iter().any(|line| by(line, "successor") && line["attempt"] == 2), "{all:#?}");
    let number = all[3]["number"].to_string();
    assert_eq!(lines(&job, &url, &["--after", &number]), all[4..]);
    assert!(lines(&job, &url, &["--level", "warn"]).iter().all(|line| line["level"] != "info"));
    let text = succeed(&["logs", &job, "--coordinator", &url, "--task", "plan"]);
    assert!(text.contains("plan #1 coordinator: task taken"), "{text}");

    // In the processes' own logs, every line of an attempt names the attempt.
    for (log, worker, task) in [
        ("victim", "victim", "partition-0000"),
        ("successor", "successor", "evaluate"),
        ("coordinator", "coordinator", "plan"),
    ] {
        let logged = logged(&of(&format!("{log}.log")));
        let of_task: Vec<&Value> =
            logged.iter().filter(|line| line["task"] == task && line["worker"] == worker).collect();
        assert!(of_task.len() >= 2, "{log}: {logged:#?}");
        for line in of_task {
            assert_eq!(
                (line["job"].as_str(), line["attempt"].as_u64()),
                (Some(job.as_str()), Some(1)),
                "{line}"
            );
            assert!(task != "partition-0000" || line["partition"] == 0, "{line}");
            assert!(
                line["message"].is_string() && line["level"].is_string() && line["time"].is_string(),
                "{line}"
            );
        }
    }
    let refused = fail(&["logs", &job, "--coordinator", &url, "--task", "nonsense"]).1;
    assert!(refused.contains("nonsense"), "{refused}");
}

#[test]
fn an_unknown_log_format_is_refused() {
    let output = output_of(&["ls", "--log-format", "xml"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.contains("text or json"), "{said}");
    let shown = json(&["doctor", "--json", "--log-format", "json"]);
    assert!(shown.is_object() || shown.is_array());
}
