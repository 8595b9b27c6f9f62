//! Files that workers and people send to a bucket and fetch from there themselves.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;

use crate::processes::{Service, can_train, fail, free_port, json, succeed, tiny_scene, under};
use crate::s3::S3Server;

/// A counter of a coordinator.
fn counter(metrics: &str, name: &str) -> u64 {
    let mut stream = TcpStream::connect(metrics).expect("metrics are served");
    let request = format!("GET /metrics HTTP/1.1\r\nhost: {metrics}\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).expect("a request");
    let mut page = String::new();
    stream.read_to_string(&mut page).expect("a page");
    let line = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix("_bytes_total "));
    line.unwrap_or_else(|| panic!("no {name}: {page}")).parse().expect("a number")
}

/// The files from this length on.
fn large_files(folder: &Path, bytes: u64) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    let large = |path: std::path::PathBuf| match path.is_dir() {
        true => large_files(&path, bytes),
        false if path.metadata().expect("a file").len() >= bytes => vec![path],
        false => Vec::new(),
    };
    entries.flat_map(large).collect()
}

#[test]
fn large_files_bypass_the_coordinator_and_are_still_checked() {
    if !can_train("large_files_bypass_the_coordinator_and_are_still_checked") {
        return;
    }
    let bucket = S3Server::start();
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| under(folder.path(), name);
    let keys = bucket.environment();
    let keys = keys.each_ref().map(|(name, value)| (*name, value.as_str()));
    let (data, objects) = (path("data"), bucket.url("scenes"));
    let start = |more: &[&str]| {
        let metrics = format!("127.0.0.1:{}", free_port());
        let flags = ["coordinator", "--listen=127.0.0.1:0", "--data-dir", &data, "--objects", &objects];
        // The model of this job has 300 kB.
        let own = ["--metrics-listen", &metrics, "--direct-uploads-from-bytes=262144"];
        let flags = [&flags[..], &own, more].concat();
        let mut service = Service::with_environment(&flags, Stdio::piped(), Stdio::inherit(), &keys);
        let url = service.wait_until_it_listens();
        (service, url, metrics)
    };
    let (service, url, metrics) = start(&[]);
    let worker = Service::worker(&url, "reef-1", &path("cache"));
    let scene = tiny_scene(folder.path());
    let words =
        ["submit", &scene, "--iterations=60", "--max-gaussians=4000", "--json", "--coordinator", &url];
    let job = json(&words)["job"].as_str().expect("an id").to_owned();
    succeed(&["watch", &job, "--coordinator", &url]);
    succeed(&["download", &job, "--output", &path("model"), "--coordinator", &url]);
    let model = std::fs::read(path("model/model.ply")).expect("a model");
    assert!(model.len() > 300_000, "{} bytes", model.len());
    assert!(counter(&metrics, "fathom_uploaded_directly") > 300_000, "the worker sent nothing directly");
    assert!(
        counter(&metrics, "fathom_served_directly") >= model.len() as u64,
        "nothing was fetched directly"
    );
    drop((worker, service));

    let (service, url, metrics) = start(&["--direct-transfers=false"]);
    succeed(&["download", &job, "--output", &path("again"), "--coordinator", &url]);
    assert!(std::fs::read(path("again/model.ply")).expect("a model") == model);
    assert_eq!(counter(&metrics, "fathom_served_directly"), 0);
    drop(service);

    // The bucket changes the model: the client notices, and the coordinator says so.
    let (_service, url, _) = start(&[]);
    for path in large_files(&bucket.folder("scenes/objects/cas"), 300_000) {
        let mut content = std::fs::read(&path).expect("a file");
        content[1000] ^= 1;
        std::fs::write(&path, content).expect("written");
    }
    let (_, said) = fail(&["download", &job, "--output", &path("damaged"), "--coordinator", &url]);
    assert!(said.contains("has another digest"), "{said}");
    assert!(!Path::new(&path("damaged/model.ply")).exists());
}
