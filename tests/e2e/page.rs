//! The page of `fathom train --web`: who sees it, and that it shows the run.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::Stdio;

use serde_json::Value;

use crate::processes::{can_train, fathom, tiny_scene, under};

/// Status and content of an answer.
fn get(address: &str, path: &str, headers: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, content) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), content.to_owned())
}

#[test]
fn the_page_of_a_run_is_for_the_one_who_started_it() {
    if !can_train("the_page_of_a_run_is_for_the_one_who_started_it") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let scene = tiny_scene(folder.path());
    let train = ["train", &scene, "-o", &under(folder.path(), "out"), "--allow-cpu", "--web"];
    let settings = ["--iterations", "2000", "--max-gaussians", "2000"];
    let mut run = fathom(&[&train[..], &settings].concat());
    let mut run = run.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(run.stderr.take().unwrap()).lines();
    let link =
        lines.by_ref().find_map(|line| Some(line.ok()?.split_once("see the run at http://")?.1.to_owned()));
    // The process must not wait for a reader.
    std::thread::spawn(move || lines.for_each(drop));
    let link = link.expect("a link");
    let (address, token) = link.split_once("/#token=").expect("a token behind the address");
    let host = format!("Host: {address}\r\n");
    let with = |token: &str| format!("{host}Authorization: Bearer {token}\r\n");

    let (status, html) = get(address, "/", &host);
    assert!(status == 200 && html.contains("<title>"), "{status}: {html}");
    assert!(!html.contains(token), "the token is in the page");
    let caller = get(address, "/api/v1/caller", &with(token));
    let caller: Value =
        (caller.0 == 200).then(|| serde_json::from_str(&caller.1).unwrap()).expect("a caller");
    assert_eq!((&caller["role"], &caller["tokens_required"]), (&"operator".into(), &false.into()));
    assert_eq!(get(address, "/api/v1/jobs", &host).0, 401, "without a token");
    let other = format!("fathom_{}_{}", "a".repeat(12), "b".repeat(64));
    assert_eq!(get(address, "/api/v1/jobs", &with(&other)).0, 401, "with another token");
    let foreign = format!("Host: wreck.example\r\nAuthorization: Bearer {token}\r\n");
    assert_eq!(get(address, "/api/v1/jobs", &foreign).0, 403, "under a name that leads to it");
    let from = format!("{}Sec-Fetch-Site: cross-site\r\n", with(token));
    assert_eq!(get(address, "/api/v1/jobs", &from).0, 403, "from another website");

    // The curve of the run, while it trains.
    let begin = std::time::Instant::now();
    loop {
        let jobs: Value = serde_json::from_str(&get(address, "/api/v1/jobs", &with(token)).1).unwrap();
        let job = jobs["jobs"][0]["job"].as_str().unwrap_or_default().to_owned();
        let (_, history) = get(address, &format!("/api/v1/jobs/{job}/history"), &with(token));
        let history: Value = serde_json::from_str(&history).unwrap();
        let points = history["tasks"][0]["points"].as_array().map_or(0, Vec::len);
        if points > 3 {
            break;
        }
        assert!(begin.elapsed().as_secs() < 240, "no points: {history}");
        std::thread::sleep(std::time::Duration::from_millis(200));
    }
    assert!(run.wait().unwrap().success());
    assert!(TcpStream::connect(address).is_err(), "the page ends with the run");
}
