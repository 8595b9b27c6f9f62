//! A shared service with TLS, tokens and tenants, as users and operators use it.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::processes::{Service, can_train, fail, json, succeed, tiny_scene, under};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};

/// `ca.pem`, and `server` and `worker` as .pem and .key, in a folder.
fn certificates(folder: &Path) {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
    std::fs::write(folder.join("ca.pem"), authority.pem()).unwrap();
    for name in ["server", "worker"] {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).unwrap();
        let cert = params.signed_by(&key, &authority).unwrap();
        std::fs::write(folder.join(format!("{name}.pem")), cert.pem()).unwrap();
        std::fs::write(folder.join(format!("{name}.key")), key.serialize_pem()).unwrap();
    }
}

#[test]
fn two_tenants_share_a_service_and_see_nothing_of_each_other() {
    if !can_train("two_tenants_share_a_service_and_see_nothing_of_each_other") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| under(folder.path(), name);
    certificates(folder.path());
    let (data, ca) = (path("data"), path("ca.pem"));
    let (_coordinator, url) = Service::coordinator_with(&[
        "--data-dir",
        &data,
        "--listen",
        "127.0.0.1:0",
        "--tokens",
        "--tls-cert",
        &path("server.pem"),
        "--tls-key",
        &path("server.key"),
        "--client-ca",
        &ca,
    ]);
    assert!(url.starts_with("https://"), "{url}");
    let here = ["--coordinator", &url, "--tls-ca", &ca];
    let with = |words: &[&str], token: &str| -> Vec<String> {
        let token = path(token);
        let words = [words, &here[..], &["--token-file", &token]].concat();
        words.into_iter().map(str::to_owned).collect()
    };
    std::fs::copy(path("data/operator.token"), path("operator")).unwrap();

    let (_, said) = fail(&["ls", "--coordinator", &url]);
    assert!(said.contains("--tls-ca FILE"), "{said}");
    let (_, said) = fail(&[&["ls"][..], &here].concat());
    assert!(said.contains("requires a token") && said.contains("--token-file"), "{said}");
    for (name, role, tenant) in [
        ("ana", "submitter", "reef"),
        ("bo", "submitter", "wreck"),
        ("eve", "viewer", "reef"),
        ("gpu", "worker", ""),
    ] {
        let issued =
            succeed(&with(&["token", "issue", name, "--role", role, "--tenant", tenant], "operator"));
        std::fs::write(path(name), issued).unwrap();
    }
    let listed = json(&with(&["token", "list", "--json"], "operator"));
    assert_eq!(listed.as_array().unwrap().len(), 5, "{listed}");
    assert!(!listed.to_string().contains(std::fs::read_to_string(path("ana")).unwrap().trim()));
    let _worker = Service::worker_with(&[
        "--coordinator",
        &url,
        "--tls-ca",
        &ca,
        "--token-file",
        &path("gpu"),
        "--tls-cert",
        &path("worker.pem"),
        "--tls-key",
        &path("worker.key"),
        "--cache-dir",
        &path("cache"),
    ]);

    let scene = tiny_scene(folder.path());
    let submit = ["submit", &scene, "--iterations", "60", "--max-gaussians", "2000", "--json"];
    let job = json(&with(&submit, "ana"))["job"].as_str().unwrap().to_owned();
    let other = json(&with(&submit, "bo"))["job"].as_str().unwrap().to_owned();
    assert_ne!(job, other);
    succeed(&with(&["watch", &job], "ana"));
    let (_, said) = fail(&with(&["show", &job], "bo"));
    assert!(said.contains("there is no job"), "{said}");
    assert_eq!(json(&with(&["ls", "--json"], "eve")).as_array().unwrap().len(), 1);
    assert_eq!(json(&with(&["ls", "--json"], "operator")).as_array().unwrap().len(), 2);
    let (_, said) = fail(&with(&["cancel", &job], "eve"));
    assert!(said.contains("has the role viewer; CancelJob needs the role submitter"), "{said}");
    for (token, out) in [("eve", "by a viewer"), ("operator", "by the operator")] {
        succeed(&with(&["download", &job, "-o", &path(out)], token));
    }
    succeed(&with(&["watch", &other], "bo"));
    succeed(&with(&["download", &other, "-o", &path("of another")], "bo"));
    let model = |out: &str| std::fs::read(folder.path().join(out).join("model.ply")).unwrap();
    assert!(model("by a viewer") == model("of another"), "one scene and seed, two models");

    succeed(&with(&["tenant", "limit", "reef", "--bytes", "1"], "operator"));
    let (_, said) = fail(&with(&submit, "ana"));
    assert!(said.contains("of 1 bytes"), "{said}");
    let id = listed[1]["id"].as_str().unwrap();
    succeed(&with(&["token", "revoke", id], "operator"));
    let (_, said) = fail(&with(&["ls"], "ana"));
    assert!(said.contains("was revoked"), "{said}");
}

/// A coordinator with TLS, tokens and metrics in a folder; returns its URL and the address of its metrics.
fn locked(folder: &Path, more: &[&str]) -> (Service, String, String) {
    certificates(folder);
    let path = |name: &str| under(folder, name);
    let metrics = format!("127.0.0.1:{}", crate::processes::free_port());
    let (data, cert, key) = (path("data"), path("server.pem"), path("server.key"));
    let flags = [
        "--data-dir",
        &data,
        "--listen",
        "127.0.0.1:0",
        "--tokens",
        "--tls-cert",
        &cert,
        "--tls-key",
        &key,
        "--metrics-listen",
        &metrics,
    ];
    let (coordinator, url) = Service::coordinator_with(&[&flags[..], more].concat());
    (coordinator, url, metrics)
}

#[test]
fn dialling_a_server_that_is_no_coordinator_fails_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let (_coordinator, url, metrics) = locked(folder.path(), &[]);
    let plain = url.replace("https://", "http://");
    let cache = under(folder.path(), "cache");
    for (address, says) in [
        (plain.as_str(), format!("speaks TLS: use {url}")),
        (url.trim_start_matches("https://"), format!("speaks TLS: use {url}")),
        (
            metrics.as_str(),
            "answers HTTP/1, so it is not the coordinator; is it the metrics address?".to_owned(),
        ),
    ] {
        for verb in [&["ls"][..], &["watch", "job"], &["worker", "--allow-cpu", "--cache-dir", &cache]] {
            if verb[0] == "worker"
                && !can_train("dialling_a_server_that_is_no_coordinator_fails_at_once (worker)")
            {
                continue;
            }
            let begin = Instant::now();
            let (_, said) = fail(&[verb, &["--coordinator", address]].concat());
            assert!(said.contains(&says), "{verb:?} {address}: {said}");
            // Shorter than the pauses of retries; a worker opens its GPU first.
            let most = if verb[0] == "worker" { 30 } else { 5 };
            assert!(begin.elapsed() < Duration::from_secs(most), "{verb:?} {address}: {:?}", begin.elapsed());
        }
    }
}

#[test]
fn unauthorised_submissions_fail_before_the_scene_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (_coordinator, url, _) = locked(folder.path(), &[]);
    let path = |name: &str| under(folder.path(), name);
    let here = ["--coordinator", &url, "--tls-ca", &path("ca.pem")];
    let with = |words: &[&str], token: &str| {
        let token = path(token);
        let words = [words, &here[..], &["--token-file", &token]].concat();
        words.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    for role in ["worker", "viewer", "submitter"] {
        let issued = succeed(&with(
            &["token", "issue", role, "--role", role, "--tenant", "reef"],
            "data/operator.token",
        ));
        std::fs::write(path(role), issued).unwrap();
    }
    // Nothing is read: there is no scene.
    for role in ["worker", "viewer"] {
        for verb in [&["submit", "nowhere"][..], &["dataset", "upload", "nowhere"]] {
            let (_, said) = fail(&with(verb, role));
            let says = format!("this token has the role {role}; BeginUpload needs the role submitter");
            assert!(said.contains(&says), "{said}");
        }
    }
    let (_, said) = fail(&with(&["submit", "nowhere"], "submitter"));
    assert!(said.contains("nowhere") && !said.contains("role"), "{said}");
    let (_, said) = fail(&with(&["worker", "list"], "submitter"));
    assert!(said.contains("needs the role operator, of all tenants"), "{said}");
}

#[test]
fn remote_listening_requires_tls_and_tokens() {
    let folder = tempfile::tempdir().unwrap();
    let data = under(folder.path(), "data");
    let (_, said) = fail(&["coordinator", "--data-dir", &data, "--listen", "0.0.0.0:0"]);
    assert!(said.contains("tokens = true") && said.contains("insecure = true"), "{said}");
    assert!(!Path::new(&data).exists(), "a data directory was created");
    let (_, said) =
        fail(&["ls", "--coordinator", "http://192.0.2.1:7420", "--token-file", &under(folder.path(), "no")]);
    assert!(said.contains("cannot read the token file") && said.contains("/no (--token-file"), "{said}");
    assert!(said.contains("no such file") && !said.contains("os error"), "{said}");
    std::fs::write(folder.path().join("token"), "fathom_a_b").unwrap();
    let (_, said) = fail(&[
        "ls",
        "--coordinator",
        "http://192.0.2.1:7420",
        "--token-file",
        &under(folder.path(), "token"),
    ]);
    assert!(said.contains("plain text") && said.contains("https://"), "{said}");
}

#[test]
fn a_lost_token_is_replaced_in_the_data_directory() {
    let folder = tempfile::tempdir().unwrap();
    let data = under(folder.path(), "data");
    let start = || Service::coordinator_with(&["--data-dir", &data, "--listen", "127.0.0.1:0", "--tokens"]);
    let issue = ["token", "issue", "ana", "--role", "operator", "--data-dir", &data];
    let (_, said) = fail(&issue);
    assert!(said.contains("contains no store"), "{said}");
    let (mut coordinator, _) = start();
    let (_, said) = fail(&issue);
    assert!(said.contains("stop it first"), "{said}");
    coordinator.kill();
    std::fs::write(folder.path().join("token"), succeed(&issue)).unwrap();
    let (_coordinator, url) = start();
    let token = under(folder.path(), "token");
    let listed = json(&["token", "list", "--coordinator", &url, "--token-file", &token, "--json"]);
    assert_eq!(listed.as_array().unwrap().len(), 2, "{listed}");
}
