//! `fathom view`: opens a model in a browser on this machine, without a service.
//!
//! The page and the model are served on loopback, below an address that nobody can guess: other users of the
//! machine cannot see them. Other websites cannot either, by the headers that browsers set.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use clap::Args;
use fathom_web::Refused;
use tokio::io::AsyncReadExt as _;

use crate::children;
use crate::error::{CliError, Result};
use crate::output;
use crate::viewed::Viewed;

/// Bytes of a file that are read at a time.
const PIECE_BYTES: usize = 256 << 10;

/// Arguments of `fathom view`.
#[derive(Args, Debug)]
pub struct ViewArgs {
    /// A result folder, or a model of any 3D Gaussian trainer: .ply, .compressed.ply or .sog
    #[arg(value_name = "OUT|MODEL")]
    model: PathBuf,
    /// Folder with the photographs of a result, to compare them with the model
    #[arg(long, value_name = "DIR")]
    photographs: Option<PathBuf>,
    /// Text that the page shows: who made the scene, and its licence
    #[arg(long, value_name = "TEXT", default_value = "")]
    credits: String,
    /// Port on loopback; 0 takes a free one
    #[arg(long, value_name = "N", default_value_t = 0)]
    port: u16,
    /// Stop when standard input closes, so that a parent process never leaves it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// What is served beside the page: by the path in the address, a file or a text of JSON.
#[derive(Debug)]
struct Scene {
    json: String,
    files: BTreeMap<String, PathBuf>,
}

impl Scene {
    fn read(args: &ViewArgs) -> Result<Self> {
        let viewed = Viewed::read(&args.model, args.photographs.as_deref(), &args.credits)?;
        let mut files = viewed.photographs;
        files.insert(viewed.model_name, viewed.model);
        Ok(Self { json: viewed.json.to_string(), files })
    }
}

struct Served {
    scene: Scene,
    /// Begins every path.
    secret: String,
}

pub async fn run(args: ViewArgs) -> Result<()> {
    let scene = Scene::read(&args)?;
    let listen = SocketAddr::from((Ipv4Addr::LOCALHOST, args.port));
    let failed = |error: std::io::Error| CliError::Message(format!("cannot listen on {listen}: {error}"));
    let listener = tokio::net::TcpListener::bind(listen).await.map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    let secret = uuid::Uuid::new_v4().simple().to_string();
    output::line(format!("{} is at http://{address}/{secret}/view.html", args.model.display()));
    output::remark("Ctrl-C ends it.");
    let router = Router::new().fallback(answer).with_state(Arc::new(Served { scene, secret }));
    let parent_gone = args.stop_with_stdin.then(children::stdin_closes);
    let stop = async move {
        match parent_gone {
            Some(gone) => tokio::select! {
                _ = gone => {}
                () = children::stop_signal() => {}
            },
            None => children::stop_signal().await,
        }
    };
    // Without waiting for open requests: a browser keeps its connections for minutes.
    tokio::select! {
        served = async { axum::serve(listener, router).await } => served.map_err(failed),
        () = stop => Ok(()),
    }
}

async fn answer(State(served): State<Arc<Served>>, request: Request) -> Response {
    let text = |status: StatusCode, text: String| (status, text).into_response();
    match fathom_web::check(request.headers(), request.uri().authority(), false) {
        Ok(()) => {}
        Err(Refused::Malformed(message)) => return text(StatusCode::BAD_REQUEST, message),
        Err(Refused::OtherSite(message)) => return text(StatusCode::FORBIDDEN, message),
    }
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        return text(StatusCode::METHOD_NOT_ALLOWED, "use GET".to_owned());
    }
    let path = request.uri().path();
    let below = path.strip_prefix('/').and_then(|path| path.strip_prefix(&served.secret)?.strip_prefix('/'));
    let Some(path) = below else {
        return text(StatusCode::NOT_FOUND, "open the whole link that `fathom view` printed".to_owned());
    };
    if path == "scene.json" {
        let kind = (header::CONTENT_TYPE, HeaderValue::from_static("application/json"));
        return ([kind, KEPT], served.scene.json.clone()).into_response();
    }
    if let Some(file) = served.scene.files.get(path) {
        return match contents(file).await {
            Ok((bytes, body)) => {
                let kind = HeaderValue::from_static(fathom_web::kind_of(path));
                let fields = [
                    (header::CONTENT_TYPE, kind),
                    (header::CONTENT_LENGTH, bytes.into()),
                    (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
                    KEPT,
                ];
                (fields, body).into_response()
            }
            Err(error) => text(StatusCode::NOT_FOUND, format!("cannot read {}: {error}", file.display())),
        };
    }
    match fathom_web::page(path, request.headers()) {
        Some(page) => page.map(Body::from),
        None => text(StatusCode::NOT_FOUND, "there is nothing at this address".to_owned()),
    }
}

/// The file may be another one the next time.
const KEPT: (header::HeaderName, HeaderValue) = (header::CACHE_CONTROL, HeaderValue::from_static("no-store"));

/// A file, with its length, read as the client takes it.
async fn contents(path: &Path) -> std::io::Result<(u64, Body)> {
    let file = tokio::fs::File::open(path).await?;
    let bytes = file.metadata().await?.len();
    let pieces = futures::stream::try_unfold(file, |mut file| async move {
        let mut piece = Vec::with_capacity(PIECE_BYTES);
        (&mut file).take(PIECE_BYTES as u64).read_to_end(&mut piece).await?;
        Ok::<_, std::io::Error>((!piece.is_empty()).then_some((piece, file)))
    });
    Ok((bytes, Body::from_stream(pieces)))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn read(words: &[&str]) -> Result<Scene> {
        let super::super::Verb::View(args) = super::super::parsed(&[&["view"], words].concat()) else {
            panic!("another verb")
        };
        Scene::read(&args)
    }

    #[test]
    fn a_result_is_shown_with_what_lies_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let out = folder.path().to_str().unwrap();
        let error = read(&[out]).unwrap_err().to_string();
        assert!(error.contains("model.ply is no file"), "{error}");
        std::fs::write(at("model.ply"), "ply\n").unwrap();
        std::fs::write(
            at("cameras.json"),
            r#"[{"img_name": "a b.png"}, {"img_name": "../secret.png"}, {"img_name": "page.html"}]"#,
        )
        .unwrap();
        std::fs::create_dir(at("photographs")).unwrap();
        std::fs::create_dir(at("photographs/images")).unwrap();
        std::fs::write(at("secret.png"), "").unwrap();
        std::fs::write(at("photographs/page.html"), "").unwrap();
        let photographs = at("photographs");
        let words = [out, "--photographs", photographs.to_str().unwrap(), "--credits", "me"];
        let error = read(&words).unwrap_err().to_string();
        assert!(error.contains("has no photograph"), "{error}");
        std::fs::write(at("photographs/images/a b.png"), "").unwrap();
        let scene = read(&words).unwrap();
        let json: Value = serde_json::from_str(&scene.json).unwrap();
        // A name that leaves the folder is left out, and so is a page.
        assert_eq!(json["photographs"], json!({"a b.png": "photographs/0.png"}));
        assert_eq!(
            (&json["model"], &json["water"], &json["credits"]),
            (&json!("model.ply"), &Value::Null, &json!("me"))
        );
        assert_eq!(scene.files.keys().collect::<Vec<_>>(), ["model.ply", "photographs/0.png"]);
        std::fs::write(at("water.json"), "{").unwrap();
        assert!(read(&[out]).unwrap_err().to_string().contains("water.json"));
    }

    #[test]
    fn a_model_of_another_program_is_shown_alone() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("cameras.json"), "of something else").unwrap();
        for (name, served) in [
            ("a wreck.PLY", "model.ply"),
            ("b.compressed.ply", "model.compressed.ply"),
            ("c.sog", "model.sog"),
        ] {
            let path = folder.path().join(name);
            std::fs::write(&path, "").unwrap();
            let json: Value = serde_json::from_str(&read(&[path.to_str().unwrap()]).unwrap().json).unwrap();
            assert_eq!(
                (&json["model"], &json["name"], &json["cameras"]),
                (&json!(served), &json!(name), &Value::Null)
            );
        }
        let text = folder.path().join("notes.txt");
        std::fs::write(&text, "").unwrap();
        let error = read(&[text.to_str().unwrap()]).unwrap_err().to_string();
        assert!(error.contains("no model that the viewer reads"), "{error}");
    }
}
