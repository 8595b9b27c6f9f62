//! `fathom view` as a process: the page, the scene and the model, and who is kept out.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::Stdio;

use serde_json::{Value, json};

use crate::processes::{Service, fail, under};

/// Status, headers and content.
fn get(address: &str, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(answer[..end].to_vec()).unwrap().to_lowercase();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), head, answer[end + 4..].to_vec())
}

#[test]
fn a_model_is_shown_to_those_who_have_the_link() {
    let folder = tempfile::tempdir().unwrap();
    let out = under(folder.path(), "out");
    let (code, said) = fail(&["view", &out]);
    assert!(code == 1 && said.contains("out is no file") && said.contains("result folder"), "{said}");
    std::fs::create_dir(&out).unwrap();
    // Longer than what is read at a time.
    let model: Vec<u8> = (0..700_000_u32).map(|i| (i % 251) as u8).collect();
    std::fs::write(under(folder.path(), "out/model.ply"), &model).unwrap();
    std::fs::write(under(folder.path(), "out/water.json"), r#"{"medium": "per_pixel"}"#).unwrap();
    std::fs::write(under(folder.path(), "out/cameras.json"), r#"[{"img_name": "a.png"}]"#).unwrap();
    std::fs::create_dir(under(folder.path(), "photographs")).unwrap();
    std::fs::write(under(folder.path(), "photographs/a.png"), b"a picture").unwrap();

    let photographs = under(folder.path(), "photographs");
    let arguments = ["view", &out, "--photographs", &photographs];
    let mut service = Service::logging_to(&arguments, Stdio::piped(), Stdio::null());
    let mut line = String::new();
    BufReader::new(service.stdout()).read_line(&mut line).unwrap();
    let link = line.trim().rsplit(' ').next().unwrap().strip_prefix("http://").unwrap();
    let (address, page) = link.split_once('/').unwrap();
    let (page, host) = (format!("/{page}"), format!("Host: {address}\r\n"));
    let below = page.strip_suffix("view.html").unwrap();
    assert!(below.len() > 30, "the link can be guessed: {link}");

    let (status, head, html) = get(address, &page, &host);
    assert_eq!(status, 200, "{head}");
    assert!(head.contains("content-security-policy: default-src 'none'"), "{head}");
    let html = String::from_utf8(html).unwrap();
    let script = html.split("src=\"./").nth(1).unwrap().split('"').next().unwrap();
    let (status, head, _) =
        get(address, &format!("{below}{script}"), &format!("{host}Accept-Encoding: gzip\r\n"));
    assert!(status == 200 && head.contains("content-encoding: gzip"), "{head}");
    let scene: Value = serde_json::from_slice(&get(address, &format!("{below}scene.json"), &host).2).unwrap();
    assert_eq!((&scene["name"], &scene["water"]["medium"]), (&json!("out"), &json!("per_pixel")));
    let photograph = scene["photographs"]["a.png"].as_str().unwrap();
    assert_eq!(get(address, &format!("{below}{photograph}"), &host).2, b"a picture");
    let (status, head, served) = get(address, &format!("{below}model.ply"), &host);
    assert!(status == 200 && head.contains("content-length: 700000"), "{head}");
    assert_eq!(served, model);

    assert_eq!(get(address, "/view.html", &host).0, 404);
    assert_eq!(get(address, &format!("{below}../out/model.ply"), &host).0, 404);
    assert_eq!(get(address, &page, "Host: wreck.example\r\n").0, 403);
    assert_eq!(get(address, &page, &format!("{host}Sec-Fetch-Site: cross-site\r\n")).0, 403);
}
