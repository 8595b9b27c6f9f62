//! The files of a job that succeeded.

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use fathom_proto::v1;
use futures::{Stream, stream};
use serde_json::json;
use tonic::{Status, Streaming};

use super::Web;
use super::answer::{Answer, Fault};
use super::api::{Page, some_text};
use super::read::{Asked, At, Caller};

/// The names, lengths and BLAKE3 digests.
pub async fn list(
    State(web): State<Web>,
    At(job_id): At<String>,
    caller: Caller,
    Asked(Page { page_size, page_token }): Asked<Page>,
) -> Answer {
    let request = v1::ListArtifactsRequest { job_id, page_size, page_token };
    let page = web.jobs().list_artifacts(caller.asks(request)).await?.into_inner();
    let file = |file: &v1::Artifact| {
        let blob = file.blob.clone().unwrap_or_default();
        json!({"path": file.path, "bytes": blob.size_bytes, "digest": blob.digest})
    };
    Ok(Json(json!({
        "files": page.artifacts.iter().map(file).collect::<Vec<_>>(),
        "next_page_token": some_text(page.next_page_token),
    })))
}

/// The content of one file, from the byte that `Range: bytes=N-` names.
pub async fn read(
    State(web): State<Web>,
    At((job_id, path)): At<(String, String)>,
    method: Method,
    headers: HeaderMap,
    caller: Caller,
) -> Result<Response, Fault> {
    let blob = find(&web, &caller, &job_id, &path).await?;
    let tag = format!("\"{}\"", blob.digest);
    let kept = (header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    // Content of a digest never changes.
    if headers.get_all(header::IF_NONE_MATCH).iter().any(|known| names(known, &tag)) {
        return Ok((StatusCode::NOT_MODIFIED, [kept], [(header::ETAG, tag)]).into_response());
    }
    let whole = blob.size_bytes;
    // A range of another state of the file is answered with the whole file (RFC 9110, 13.1.5).
    let is_same = headers.get(header::IF_RANGE).is_none_or(|known| known.as_bytes() == tag.as_bytes());
    let first = headers.get(header::RANGE).filter(|_| is_same).and_then(first_of);
    if first.is_some_and(|first| first >= whole) {
        let range = [(header::CONTENT_RANGE, format!("bytes */{whole}"))];
        let message = format!("the file has {whole} bytes");
        let fault = Fault::with(StatusCode::RANGE_NOT_SATISFIABLE, "WRONG_OFFSET", message);
        return Ok((range, fault).into_response());
    }
    let offset_bytes = first.unwrap_or_default();
    let body = if method == Method::HEAD {
        Body::empty()
    } else {
        let request = v1::ReadBlobRequest { digest: blob.digest, offset_bytes, job_id, direct: false };
        let mut pieces = web.uploads().read_blob(caller.asks(request)).await?.into_inner();
        // The first piece before any header, so that a missing file is an error and no empty answer.
        let first = pieces.message().await?;
        Body::from_stream(contents(first, pieces))
    };
    let mut answer = Response::new(body);
    if first.is_some() {
        *answer.status_mut() = StatusCode::PARTIAL_CONTENT;
        let range = format!("bytes {offset_bytes}-{}/{whole}", whole.saturating_sub(1));
        answer
            .headers_mut()
            .extend(HeaderValue::try_from(range).ok().map(|range| (header::CONTENT_RANGE, range)));
    }
    let fields = answer.headers_mut();
    fields.insert(header::CONTENT_LENGTH, (whole - offset_bytes).into());
    fields.insert(header::CONTENT_TYPE, HeaderValue::from_static(fathom_web::kind_of(&path)));
    fields.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    fields.extend([kept]);
    fields.extend(HeaderValue::try_from(tag).ok().map(|tag| (header::ETAG, tag)));
    Ok(answer)
}

/// A blob that something of a job names by its digest: a preview, the plan, a photograph.
pub async fn blob(
    State(web): State<Web>,
    At((job_id, digest)): At<(String, String)>,
    caller: Caller,
) -> Result<Response, Fault> {
    let request = v1::ReadBlobRequest { digest, offset_bytes: 0, job_id, direct: false };
    let mut pieces = web.uploads().read_blob(caller.asks(request)).await?.into_inner();
    let first = pieces.message().await?;
    let kind = kind_of(first.as_ref().map(|piece| piece.data.as_ref()).unwrap_or_default());
    let mut answer = Response::new(Body::from_stream(contents(first, pieces)));
    answer.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    Ok(answer)
}

/// The type of a content by its first bytes: a blob has no name.
fn kind_of(content: &[u8]) -> &'static str {
    if content.starts_with(&[0xff, 0xd8, 0xff]) {
        "image/jpeg"
    } else if content.starts_with(b"\x89PNG") {
        "image/png"
    } else {
        "application/octet-stream"
    }
}

/// The bytes of a blob's pieces. The last piece is sent when the call has ended. Otherwise the server, which
/// reads no further once it has sent all bytes, would drop the call, and it would count as cancelled.
fn contents(
    first: Option<v1::ReadBlobResponse>,
    pieces: Streaming<v1::ReadBlobResponse>,
) -> impl Stream<Item = Result<Bytes, Status>> {
    stream::try_unfold((first, pieces), |(piece, mut pieces)| async move {
        let Some(piece) = piece else { return Ok(None) };
        let next = pieces.message().await?;
        Ok(Some((piece.data, (next, pieces))))
    })
}

/// Whether `If-None-Match` names this tag, also as a weak one: proxies that compress make tags weak.
fn names(known: &HeaderValue, tag: &str) -> bool {
    let known = known.to_str().unwrap_or_default().split(',').map(str::trim);
    known.into_iter().any(|known| known == "*" || known.trim_start_matches("W/") == tag)
}

async fn find(web: &Web, caller: &Caller, job_id: &str, path: &str) -> Result<v1::BlobRef, Fault> {
    let mut request = v1::ListArtifactsRequest { job_id: job_id.to_owned(), ..Default::default() };
    loop {
        let page = web.jobs().list_artifacts(caller.asks(request.clone())).await?.into_inner();
        if let Some(found) = page.artifacts.into_iter().find(|file| file.path == path) {
            return found.blob.ok_or_else(|| Fault::not_found("the file has no content"));
        }
        if page.next_page_token.is_empty() {
            let message = format!("the job has no file {path:?}; its files are there once it has succeeded");
            return Err(Fault::not_found(message));
        }
        request.page_token = page.next_page_token;
    }
}

/// The first byte of a range without an end; other ranges are answered with the whole file, which is allowed.
fn first_of(range: &HeaderValue) -> Option<u64> {
    range.to_str().ok()?.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok()
}
