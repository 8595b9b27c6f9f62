//! `fathom store`: a data directory is exported, checked, damaged, and restored from its export.

use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::{Duration, Instant};

use crate::processes::{Service, fail, free_port, json, output_in, output_of, succeed, tiny_scene, under};

/// The largest object file of a data directory.
fn largest_object(data: &Path) -> PathBuf {
    let mut files = Vec::new();
    let mut folders = vec![data.join("objects")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.push(path);
            }
        }
    }
    files.into_iter().max_by_key(|path| path.metadata().map_or(0, |meta| meta.len())).expect("an object")
}

#[test]
fn a_data_directory_is_exported_verified_and_restored() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let (data, file) = (at("data"), at("store.gz"));
    let port = free_port();
    let url = format!("http://127.0.0.1:{port}");
    let scene = tiny_scene(folder.path());
    let submit = |url: &str| {
        succeed(&["submit", &scene, "--coordinator", url, "--iterations=50", "--request-id=once"])
            .trim()
            .to_owned()
    };
    let job = {
        let _coordinator = Service::coordinator(&data, port);
        let job = submit(&url);
        let (_, error) = fail(&["store", "verify", "--data-dir", &data]);
        assert!(error.contains("stop it first") && error.contains("fathom store backup"), "{error}");
        job
    };
    let said = succeed(&["store", "export", "--data-dir", &data, "-o", &file]);
    assert!(said.starts_with("1 jobs, ") && said.contains("store.gz"), "{said}");
    let verified = json(&["store", "verify", "--data-dir", &data, "--deep", "--json"]);
    assert_eq!((&verified["jobs"], verified["faults"].as_array().map(Vec::len)), (&1.into(), Some(0)));
    assert!(verified["blobs"].as_u64().is_some_and(|blobs| blobs > 64), "{verified}");

    // A new directory with the jobs of the export and the objects of the old one.
    let restored = at("restored");
    let said = succeed(&["store", "import", &file, "--data-dir", &restored]);
    assert!(said.starts_with("1 jobs, "), "{said}");
    let (_, error) = fail(&["store", "import", &file, "--data-dir", &restored]);
    assert!(error.contains("already exists"), "{error}");
    let (code, error) = fail(&["store", "verify", "--data-dir", &restored]);
    assert!(code == 1 && error.contains("faults"), "no photograph is there: {error}");
    assert!(!folder.path().join("restored/objects").exists(), "a check created a folder");
    std::fs::rename(folder.path().join("data/objects"), folder.path().join("restored/objects"))
        .expect("a folder");
    succeed(&["store", "verify", "--data-dir", &restored, "--deep"]);
    {
        let port = free_port();
        let url = format!("http://127.0.0.1:{port}");
        let _coordinator = Service::coordinator(&restored, port);
        assert_eq!(submit(&url), job, "a repeated request made another job");
    }

    // A damaged photograph is found only by hashing its content.
    let object = largest_object(&folder.path().join("restored"));
    let mut bytes = std::fs::read(&object).expect("an object");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&object, bytes).expect("written");
    succeed(&["store", "verify", "--data-dir", &restored]);
    let output = crate::processes::output_of(&["store", "verify", "--data-dir", &restored, "--deep"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(!output.status.success() && said.contains("has other content"), "{said}");

    // Wrong input creates nothing.
    let export = std::fs::read(&file).expect("an export");
    std::fs::write(&file, &export[..export.len() / 2]).expect("written");
    let (_, error) = fail(&["store", "import", &file, "--data-dir", &at("third")]);
    assert!(error.contains("store.gz") && error.contains("nothing was imported"), "{error}");
    assert!(!Path::new(&at("third/store")).exists());
    let (_, error) = fail(&["store", "export", "--data-dir", &at("nowhere"), "-o", &file]);
    assert!(error.contains("contains no store"), "{error}");
    assert!(!Path::new(&at("nowhere")).exists(), "a wrong path made a store");
}

#[test]
fn a_service_moves_to_a_database_and_back() {
    let Some(database) = crate::postgres::database() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let (data, file, back) = (at("data"), at("store.gz"), at("back.gz"));
    let scene = tiny_scene(folder.path());
    // The same request at each coordinator: it makes one job.
    let submit = |more: &[&str]| {
        let flags = [&["--data-dir", &data, "--listen", "127.0.0.1:0"], more].concat();
        let (_coordinator, url) = Service::coordinator_with(&flags);
        let words = ["submit", &scene, "--coordinator", &url, "--iterations=50", "--request-id=once"];
        succeed(&words).trim().to_owned()
    };
    let store = format!("--store={database}");
    let job = submit(&[]);
    succeed(&["store", "export", "--data-dir", &data, "-o", &file]);
    let said = succeed(&["store", "import", &file, &store]);
    assert!(said.starts_with("1 jobs, ") && said.contains("into the database"), "{said}");
    let (_, error) = fail(&["store", "import", &file, &store]);
    assert!(error.contains("already contains jobs"), "{error}");
    // With both, it would be unclear which store is the right one.
    let (_, error) = fail(&["coordinator", "--data-dir", &data, &store, "--listen=127.0.0.1:0"]);
    assert!(error.contains("has a store of its own"), "{error}");
    std::fs::rename(at("data/store"), at("data/store.moved")).expect("a folder");
    let verified = json(&["store", "verify", "--data-dir", &data, &store, "--deep", "--json"]);
    assert_eq!((&verified["jobs"], verified["faults"].as_array().map(Vec::len)), (&1.into(), Some(0)));
    assert_eq!(submit(&[&store]), job, "a repeated request made another job");

    let (_, error) = fail(&["coordinator", "--data-dir", &data, "--listen=127.0.0.1:0"]);
    assert!(error.contains("are in the database") && error.contains("--store"), "{error}");
    let wrong = "--store=postgres://fathom:secret@127.0.0.1:1/fathom";
    let (_, error) = fail(&["store", "export", wrong, "-o", &back]);
    assert!(error.contains("is not available") && !error.contains("secret"), "{error}");
    assert!(!Path::new(&back).exists());
    succeed(&["store", "export", &store, "-o", &back]);
    succeed(&["store", "import", &back, "--data-dir", &data]);
    std::fs::remove_file(at("data/database.lock")).expect("its file");
    assert_eq!(submit(&[]), job, "a repeated request made another job");
}

/// Lines of an attempt that is so long that lines in its middle were removed.
fn write_long_log(folder: &Path) {
    std::fs::create_dir_all(folder).expect("a folder");
    for (segment, lines) in [(0, 1..=300), (3, 1001..=1300)] {
        let line = |number: u64| {
            let message = format!("line {number}");
            let row = serde_json::json!({
                "number": 2 * number, "from_worker": number, "time_ms": 1_700_000_000_000_u64 + number,
                "severity": "info", "worker": "reef", "message": message,
            });
            format!("{row}\n")
        };
        let text: String = lines.map(line).collect();
        std::fs::write(folder.join(format!("global.1.{segment}")), text).expect("written");
    }
}

#[test]
fn a_service_moves_to_a_database_and_a_bucket_and_back() {
    let Some(database) = crate::postgres::database() else { return };
    let bucket = crate::s3::S3Server::start();
    let (keys, objects) = (bucket.environment(), bucket.url("scenes"));
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let (data, away, back) = (at("data"), at("away"), at("back"));
    let scene = tiny_scene(folder.path());
    let with_keys = |words: &[&str]| {
        let Output { status, stdout, stderr } = output_in(&keys, words);
        let said = String::from_utf8_lossy(&stderr).into_owned();
        (status.success(), String::from_utf8(stdout).expect("text") + &said)
    };
    let moved = |words: &[&str]| {
        let (succeeded, said) = with_keys(&[&["store", "move", "--json"], words].concat());
        assert!(succeeded, "{said}");
        let moved: serde_json::Value = serde_json::from_str(&said).expect("JSON");
        assert_eq!((&moved["jobs"], &moved["faults"]), (&1.into(), &serde_json::json!([])), "{moved}");
        ["copied_blobs", "copied_log_lines"].map(|count| moved[count].as_u64().expect("a number"))
    };
    // The same request at each coordinator: it makes one job. With the lines of its logs.
    let submit = |flags: &[&str]| {
        let flags = [&["coordinator", "--listen", "127.0.0.1:0"], flags].concat();
        let keys = keys.each_ref().map(|(name, value)| (*name, value.as_str()));
        let mut service = Service::with_environment(&flags, Stdio::piped(), Stdio::inherit(), &keys);
        let url = service.wait_until_it_listens();
        let words = ["submit", &scene, "--coordinator", &url, "--iterations=50", "--request-id=once"];
        let job = succeed(&words).trim().to_owned();
        let lines = succeed(&["logs", &job, "--json", "--coordinator", &url]);
        (job, lines)
    };
    let (job, _) = submit(&["--data-dir", &data]);
    write_long_log(&Path::new(&data).join("logs").join(&job));
    let (_, lines) = submit(&["--data-dir", &data]);
    assert!(lines.lines().count() > 600 && lines.contains("lines were removed here"), "{lines}");
    // The coordinator may have added lines of its own.
    let continues = |(again, its_lines): (String, String)| {
        assert_eq!(again, job, "a repeated request made another job");
        assert!(its_lines.starts_with(&lines), "lines differ: {its_lines}");
    };

    let to = ["--to-data-dir", &away, "--to-store", &database, "--to-objects", &objects];
    let [blobs, log_lines] = moved(&[&["--data-dir", &data], &to[..]].concat());
    assert!(blobs > 64 && log_lines >= 600, "{blobs} blobs, {log_lines} log lines");
    let again = moved(&[&["--data-dir", &data], &to[..]].concat());
    assert_eq!(again, [0, 0], "a second move copies everything again");
    assert!(!Path::new(&at("away/logs")).exists(), "log lines are in the database");
    assert!(!Path::new(&at("away/objects/cas")).exists(), "files are in the bucket");
    let there = ["--data-dir", &away, "--store", &database, "--objects", &objects];
    let (succeeded, said) = with_keys(&[&["store", "verify", "--deep"], &there[..]].concat());
    assert!(succeeded, "{said}");
    continues(submit(&there));

    // A coordinator of other jobs would delete these files.
    let other = at("other");
    let (succeeded, said) =
        with_keys(&["coordinator", "--data-dir", &other, "--objects", &objects, "--listen=127.0.0.1:0"]);
    assert!(!succeeded && said.contains("the files of another deployment"), "{said}");
    // Without the right keys, and with a wrong URL.
    let wrong = keys.each_ref().map(|(name, value)| {
        (*name, if name.contains("SECRET") { "wrong".to_owned() } else { value.clone() })
    });
    let refused = output_in(&wrong, &[&["store", "verify"], &there[..]].concat());
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && said.contains("object store is not available"), "{said}");
    let (_, said) = fail(&["coordinator", "--data-dir", &other, "--objects=reef", "--listen=127.0.0.1:0"]);
    assert!(said.contains("objects = \"reef\""), "{said}");

    let [_, log_lines] = moved(&[&there[..], &["--to-data-dir", &back]].concat());
    assert!(log_lines >= 600, "{log_lines} log lines");
    continues(submit(&["--data-dir", &back]));
    succeed(&["store", "verify", "--data-dir", &back, "--deep"]);
}

#[test]
fn a_token_that_is_written_into_the_database_counts_at_once() {
    let Some(database) = crate::postgres::database() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let store = format!("--store={database}");
    let flags = ["--data-dir", &at("data"), "--listen=127.0.0.1:0", "--tokens", &store];
    let (_coordinator, url) = Service::coordinator_with(&flags);
    let token = succeed(&["token", "issue", "ana", "--role=viewer", "--tenant=reef", &store]);
    std::fs::write(at("ana.token"), token).expect("written");
    let begin = Instant::now();
    while !output_of(&["ls", "--coordinator", &url, "--token-file", &at("ana.token")]).status.success() {
        assert!(begin.elapsed() < Duration::from_secs(10), "the coordinator does not know the token");
        std::thread::sleep(Duration::from_millis(100));
    }
}
