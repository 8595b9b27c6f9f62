//! `fathom dataset`: a scene is uploaded once, and jobs use it without its folder.

use crate::processes::{Service, fail, free_port, json, succeed, tiny_scene, under};

#[test]
fn a_scene_uploaded_once_serves_jobs_without_its_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = under(folder.path(), "data");
    let port = free_port();
    let url = format!("http://127.0.0.1:{port}");
    let scene = tiny_scene(folder.path());
    let with = |words: &[&str]| -> Vec<String> {
        let at = ["--coordinator", &url];
        words.iter().copied().chain(at).map(str::to_owned).collect()
    };
    let id = {
        let _coordinator = Service::coordinator(&data, port);
        let dataset = json(&with(&["dataset", "upload", &scene, "--id", "reef-7", "--json"]));
        assert_eq!((&dataset["dataset"], &dataset["state"]), (&"reef-7".into(), &"committed".into()));
        // A retry after a lost answer gives the same dataset.
        assert_eq!(succeed(&with(&["dataset", "upload", &scene, "--id", "reef-7"])).trim(), "reef-7");
        let shown = succeed(&with(&["dataset", "show", "reef-7", "--files"]));
        let files: Vec<&str> = shown.lines().skip(2).collect();
        assert_eq!(files.len() as u64, dataset["files"].as_u64().expect("a number"), "{shown}");
        for path in ["manifest.json", "points.bin"] {
            assert!(files.iter().any(|line| line.ends_with(&format!(" {path}"))), "no {path} in {shown}");
        }
        let shown = json(&with(&["dataset", "show", "reef-7", "--files", "--json"]));
        let list = shown["list"].as_array().expect("a list");
        assert_eq!(list.len(), files.len());
        for (file, line) in list.iter().zip(&files) {
            let text = |key: &str| file[key].as_str().expect("text");
            assert_eq!(format!("{} {} {}", text("digest"), file["bytes"], text("path")), **line);
        }
        assert!(shown["created_unix_seconds"].is_f64(), "{shown}");
        let root = dataset["root_digest"].as_str().expect("a digest");
        let list = files.iter().map(|line| format!("{line}\n")).collect::<String>();
        assert_eq!(blake3::hash(list.as_bytes()).to_hex().as_str(), root, "the documented digest");
        std::fs::rename(&scene, folder.path().join("elsewhere")).expect("moved");
        let job = succeed(&with(&["submit", "--dataset", "reef-7", "--iterations=50"]));
        let job = json(&with(&["show", job.trim(), "--json"]));
        assert_eq!((&job["dataset"], &job["name"]), (&"reef-7".into(), &"reef-7".into()));
        let (_, error) = fail(&with(&["dataset", "delete", "reef-7"]));
        assert!(error.contains("used by job"), "{error}");
        let (_, error) = fail(&with(&["submit", "--dataset", "wreck", "--iterations=50"]));
        assert!(error.contains("there is no dataset wreck"), "{error}");
        assert_eq!(json(&with(&["dataset", "list", "--json"])).as_array().map(Vec::len), Some(1));
        job["job"].as_str().expect("a name").to_owned()
    };
    let verified = json(&["store", "verify", "--data-dir", &data, "--deep", "--json"]);
    assert_eq!((&verified["datasets"], verified["faults"].as_array().map(Vec::len)), (&1.into(), Some(0)));
    let _coordinator = Service::coordinator(&data, port);
    succeed(&with(&["cancel", &id]));
    succeed(&with(&["delete", &id]));
    succeed(&with(&["dataset", "delete", "reef-7"]));
    assert!(succeed(&with(&["dataset", "list"])).contains("no datasets"));
}
