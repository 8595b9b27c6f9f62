//! The page of `fathom train --web`: who sees it, and that it shows the run.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::Stdio;

use serde_json::Value;

use crate::processes::{can_train, fathom, tiny_scene, under};

/// Status and content of an answer.
fn get(address: &str, path: &str, headers: &str) -> (u16, String) {
    call("GET", address, path, headers)
}

fn call(method: &str, address: &str, path: &str, headers: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "{method} {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
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
    let mut link_behind = |words: &str| {
        let found = lines.by_ref().find_map(|line| Some(line.ok()?.split_once(words)?.1.to_owned()));
        found.unwrap_or_else(|| panic!("no link behind {words:?}"))
    };
    let link = link_behind("see the run at http://");
    let (address, invitation) = link.split_once("/#invitation=").expect("an invitation behind the address");
    let host = format!("Host: {address}\r\n");
    let with = |token: &str| format!("{host}Authorization: Bearer {token}\r\n");
    let enter = |invitation: &str| call("POST", address, "/api/v1/enter", &with(invitation));

    // An invitation reads nothing, and opens the page once.
    assert_eq!(get(address, "/api/v1/jobs", &with(invitation)).0, 401, "with the invitation itself");
    assert_eq!(enter(&format!("fathom_{}_{}", "a".repeat(12), "b".repeat(64))).0, 401);
    let (status, entered) = enter(invitation);
    assert_eq!(status, 200, "{entered}");
    assert_eq!(enter(invitation).0, 401, "a second time");
    let entered: Value = serde_json::from_str(&entered).unwrap();
    let token = entered["token"].as_str().unwrap();
    let next = link_behind("the link to the page has been used; the next one is http://");
    let (_, next) = next.split_once("/#invitation=").expect("an invitation behind the address");
    assert_eq!(enter(next).0, 200, "the next link");
    // The process must not wait for a reader.
    std::thread::spawn(move || lines.for_each(drop));

    let (status, html) = get(address, "/", &host);
    assert!(status == 200 && html.contains("<title>"), "{status}: {html}");
    assert!(!html.contains(token) && !html.contains(invitation), "a secret is in the page");
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
    for log in std::fs::read_dir(folder.path().join("out/logs")).unwrap() {
        let text = std::fs::read_to_string(log.unwrap().path()).unwrap();
        for secret in [token, invitation, next].map(|token| token.rsplit('_').next().unwrap()) {
            assert!(!text.contains(secret), "a secret is in a log of the run");
        }
    }
    assert!(TcpStream::connect(address).is_err(), "the page ends with the run");
}
