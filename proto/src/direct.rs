//! Transfers between a client and the bucket of its coordinator, by URLs that the coordinator signs.
//!
//! They are an offer: the address may be unreachable from here, or its certificate unknown. Whatever fails is
//! transferred through the coordinator, and for a minute the client does not ask for URLs.

use std::collections::HashMap;
use std::error::Error;
use std::io;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt as _, stream};
use http::StatusCode;
use http::header::{CONTENT_RANGE, RANGE};
use reqwest::Body;
use tokio::io::{AsyncReadExt as _, AsyncSeekExt as _};
use tokio::sync::watch;
use tokio::time::{Instant, timeout};
use tonic::Status;

use crate::dial::Connection;
use crate::v1;
use crate::v1::upload_service_client::UploadServiceClient;

/// Timeout of a connection attempt; it delays the first file where the bucket is unreachable.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);
/// Timeout of an answer, and of each of its pieces.
const SILENT_FOR: Duration = Duration::from_secs(20);
/// Time without a byte after which an upload is given up: a worker that has to leave has half a minute, and
/// the coordinator must still have some of it.
const STUCK_FOR: Duration = Duration::from_secs(10);
/// More of that time after the last byte was handed on: some MB may still be on their way, and the bucket
/// then answers.
const LAST_FOR: Duration = Duration::from_secs(15);
/// Bytes of an upload that are handed on at a time.
const PIECE: usize = 256 << 10;
/// Time after a failure without requests to the bucket.
const AGAIN_AFTER: Duration = Duration::from_secs(60);

/// The time that an upload has: a minute, and a second for each 256 KiB. The client gives it up then, and the
/// coordinator deletes what has arrived.
pub fn sent_within(bytes: u64) -> Duration {
    Duration::from_secs(60 + bytes / (256 << 10))
}

/// Why a transfer with a bucket failed. It never names the URL, which contains a signature.
#[derive(Debug, thiserror::Error)]
pub enum DirectError {
    /// There is no HTTP client.
    #[error("cannot make HTTP requests: {0}")]
    NoClient(String),
    /// The bucket did not answer, or broke off.
    #[error("the bucket does not answer: {0}")]
    Http(String),
    /// The bucket refused.
    #[error("the bucket answered with status {0}")]
    Refused(StatusCode),
    /// The coordinator refused to sign, or what arrived.
    #[error("the coordinator refuses: {}", .0.message())]
    Coordinator(Box<Status>),
    /// The answer is not the requested range.
    #[error("the bucket sent other bytes than the requested ones: {0}")]
    OtherRange(String),
}

/// A client of buckets. Clones share what they know.
#[derive(Clone, Debug, Default)]
pub struct Direct(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    client: OnceLock<Result<reqwest::Client, String>>,
    failed: Mutex<Option<Instant>>,
}

impl Direct {
    /// Whether to ask the coordinator for URLs: not within a minute after a failure.
    pub fn is_wanted(&self) -> bool {
        let failed = self.0.failed.lock().unwrap_or_else(PoisonError::into_inner);
        failed.is_none_or(|failed| failed.elapsed() >= AGAIN_AFTER)
    }

    /// A transfer has failed, so the coordinator makes it.
    pub fn failed(&self, error: &DirectError) {
        tracing::warn!(%error, "the bucket cannot be used directly; using the coordinator for a minute");
        *self.0.failed.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
    }

    /// The bytes of an object from `offset` to its end, of which there are `bytes`.
    ///
    /// # Errors
    /// When the bucket does not answer, refuses, or sends another range.
    pub async fn get(&self, url: &str, offset: u64, bytes: u64) -> Result<Pieces, DirectError> {
        let mut request = self.client()?.get(url);
        if offset > 0 {
            request = request.header(RANGE, format!("bytes={offset}-"));
        }
        let response =
            timeout(SILENT_FOR, request.send()).await.map_err(|_| silent())?.map_err(without_url)?;
        let status = response.status();
        match (status, offset) {
            (StatusCode::OK, 0) => {}
            (StatusCode::PARTIAL_CONTENT, _) => {
                let range = response.headers().get(CONTENT_RANGE).and_then(|range| range.to_str().ok());
                if !range.is_some_and(|range| range.starts_with(&format!("bytes {offset}-"))) {
                    let found = format!("from byte {offset} on were asked for, not {range:?}");
                    return Err(DirectError::OtherRange(found));
                }
            }
            (StatusCode::OK, _) => {
                return Err(DirectError::OtherRange("it ignores ranges".to_owned()));
            }
            _ => return Err(DirectError::Refused(status)),
        }
        Ok(Pieces { response, missing: bytes })
    }

    /// Sends a blob from byte `arrived` on to the bucket, after QueryBlob has offered it. Returns where what
    /// has arrived now ends. The rest has to be sent with WriteBlob; there is none if the blob is complete.
    pub async fn upload(
        &self,
        client: &UploadServiceClient<Connection>,
        blob: &v1::BlobRef,
        job_id: &str,
        content: Content,
        arrived: u64,
    ) -> u64 {
        let mut end = arrived;
        while end < blob.size_bytes {
            match self.upload_part(client.clone(), blob, job_id, &content, end).await {
                Ok(Some(next)) => end = next,
                Ok(None) => return end,
                // The coordinator did its part, or says why not when the blob is sent to it.
                Err(DirectError::Coordinator(status)) => {
                    let reason = status.message();
                    tracing::warn!(
                        digest = blob.digest,
                        reason,
                        "sending a file through the coordinator instead"
                    );
                    return end;
                }
                Err(error) => {
                    self.failed(&error);
                    return end;
                }
            }
        }
        end
    }

    /// Sends what one request takes from `offset` on; returns its end, or `None` if the coordinator signs
    /// nothing.
    async fn upload_part(
        &self,
        mut client: UploadServiceClient<Connection>,
        blob: &v1::BlobRef,
        job_id: &str,
        content: &Content,
        offset: u64,
    ) -> Result<Option<u64>, DirectError> {
        let refused = |status| DirectError::Coordinator(Box::new(status));
        let request = v1::SignWriteRequest {
            blob: Some(blob.clone()),
            job_id: job_id.to_owned(),
            offset_bytes: offset,
            in_parts: true,
        };
        let signed = client.sign_write(request).await.map_err(refused)?.into_inner();
        if signed.complete {
            return Ok(Some(blob.size_bytes));
        }
        if signed.url.is_empty() {
            return Ok(None);
        }
        let rest = blob.size_bytes - offset;
        // Coordinators that knew no parts leave the length out.
        let bytes = if signed.size_bytes == 0 { rest } else { rest.min(signed.size_bytes) };
        let range = offset..offset + bytes;
        self.put(&signed.url, &signed.headers, content, range.clone()).await?;
        let request = v1::FinishWriteRequest {
            blob: Some(blob.clone()),
            upload: signed.upload,
            job_id: job_id.to_owned(),
            offset_bytes: offset,
        };
        client.finish_write(request).await.map_err(refused)?;
        Ok(Some(range.end))
    }

    /// Writes an object of the bytes `range` of `content`.
    ///
    /// # Errors
    /// When the bucket does not answer or refuses.
    pub async fn put(
        &self,
        url: &str,
        headers: &HashMap<String, String>,
        content: &Content,
        range: Range<u64>,
    ) -> Result<(), DirectError> {
        let taken = watch::Sender::new(Instant::now());
        let noted = taken.clone();
        let bytes = range.end - range.start;
        let body = match content {
            Content::Bytes(bytes) => pieces_of_bytes(bytes.clone(), range).boxed(),
            Content::File(path) => pieces_of_file(path.clone(), range).boxed(),
        };
        let mut missing = bytes;
        let body = Body::wrap_stream(body.inspect(move |piece| {
            missing = missing.saturating_sub(piece.as_ref().map_or(0, |piece| piece.len() as u64));
            noted.send_replace(Instant::now() + if missing == 0 { LAST_FOR } else { Duration::ZERO });
        }));
        let mut request = self.client()?.put(url).timeout(sent_within(bytes));
        for (name, value) in headers {
            request = request.header(name, value);
        }
        let response = tokio::select! {
            response = request.body(body).send() => response.map_err(without_url)?,
            () = stuck(&taken) => {
                let message = format!("it took no byte for {} s", STUCK_FOR.as_secs());
                return Err(DirectError::Http(message));
            }
        };
        if response.status().is_success() { Ok(()) } else { Err(DirectError::Refused(response.status())) }
    }

    fn client(&self) -> Result<&reqwest::Client, DirectError> {
        let client = self.0.client.get_or_init(|| {
            // It fails when the process has named one before.
            let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
            let client = reqwest::Client::builder()
                .connect_timeout(CONNECT_WITHIN)
                // A signature holds for one host.
                .redirect(reqwest::redirect::Policy::none());
            client.build().map_err(|error| cause(&error))
        });
        client.as_ref().map_err(|error| DirectError::NoClient(error.clone()))
    }
}

/// The bytes of an answer.
#[derive(Debug)]
pub struct Pieces {
    response: reqwest::Response,
    missing: u64,
}

impl Pieces {
    /// The next bytes; `None` when all have arrived.
    ///
    /// # Errors
    /// When the connection breaks, or fewer or more bytes arrive than there are.
    pub async fn next(&mut self) -> Result<Option<Bytes>, DirectError> {
        let piece = timeout(SILENT_FOR, self.response.chunk()).await.map_err(|_| silent())?;
        let Some(piece) = piece.map_err(without_url)? else {
            return match self.missing {
                0 => Ok(None),
                missing => Err(DirectError::OtherRange(format!("{missing} bytes are missing"))),
            };
        };
        let Some(missing) = self.missing.checked_sub(piece.len() as u64) else {
            return Err(DirectError::OtherRange("there are more".to_owned()));
        };
        self.missing = missing;
        Ok(Some(piece))
    }
}

/// What an upload sends.
#[derive(Clone, Debug)]
pub enum Content {
    /// These bytes.
    Bytes(Bytes),
    /// A file, which is read while it is sent.
    File(PathBuf),
}

/// Ends when no byte was taken for a while.
async fn stuck(taken: &watch::Sender<Instant>) {
    loop {
        let ends = *taken.borrow() + STUCK_FOR;
        if ends <= Instant::now() {
            return;
        }
        tokio::time::sleep_until(ends).await;
    }
}

/// A range of some bytes, piece by piece; less if there are fewer.
fn pieces_of_bytes(
    bytes: Bytes,
    range: Range<u64>,
) -> impl stream::Stream<Item = io::Result<Bytes>> + Send + 'static {
    let in_memory = |at: u64| usize::try_from(at).map_or(bytes.len(), |at| at.min(bytes.len()));
    let (start, end) = (in_memory(range.start), in_memory(range.end));
    stream::iter((start..end).step_by(PIECE).map(move |at| Ok(bytes.slice(at..end.min(at + PIECE)))))
}

/// The same of a file.
fn pieces_of_file(
    path: PathBuf,
    range: Range<u64>,
) -> impl stream::Stream<Item = io::Result<Bytes>> + Send + 'static {
    stream::try_unfold((None, path), move |(opened, path)| {
        let range = range.clone();
        async move {
            let mut file = match opened {
                Some(file) => file,
                None => {
                    let mut file = tokio::fs::File::open(&path).await?;
                    file.seek(io::SeekFrom::Start(range.start)).await?;
                    file.take(range.end - range.start)
                }
            };
            let mut piece = Vec::new();
            let read = (&mut file).take(PIECE as u64).read_to_end(&mut piece).await?;
            Ok((read > 0).then(|| (Bytes::from(piece), (Some(file), path))))
        }
    })
}

fn silent() -> DirectError {
    DirectError::Http(format!("nothing arrived for {} s", SILENT_FOR.as_secs()))
}

fn without_url(error: reqwest::Error) -> DirectError {
    DirectError::Http(cause(&error.without_url()))
}

/// An error and its causes.
fn cause(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(error) = next {
        text = format!("{text}: {error}");
        next = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// The URL of a server that gives each request this answer.
    async fn answering(answer: &'static str) -> String {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/secret", listener.local_addr().unwrap());
        tokio::spawn(async move {
            loop {
                let (mut socket, _) = listener.accept().await.unwrap();
                let _ = socket.read(&mut [0; 4096]).await;
                let _ = socket.write_all(answer.as_bytes()).await;
            }
        });
        url
    }

    async fn got(url: &str, offset: u64, bytes: u64) -> Result<String, DirectError> {
        let (mut pieces, mut whole) = (Direct::default().get(url, offset, bytes).await?, Vec::new());
        while let Some(piece) = pieces.next().await? {
            whole.extend_from_slice(&piece);
        }
        Ok(String::from_utf8_lossy(&whole).into_owned())
    }

    #[tokio::test]
    async fn whole_answers_and_ranges_arrive() {
        let whole = answering("HTTP/1.1 200 OK\r\ncontent-length: 4\r\n\r\nreef").await;
        assert_eq!(got(&whole, 0, 4).await.unwrap(), "reef");
        let rest = answering(
            "HTTP/1.1 206 Partial Content\r\ncontent-range: bytes 2-3/4\r\ncontent-length: 2\r\n\r\nef",
        );
        assert_eq!(got(&rest.await, 2, 2).await.unwrap(), "ef");
    }

    #[tokio::test]
    async fn answers_with_other_bytes_are_refused_without_naming_the_url() {
        for (answer, offset, said) in [
            ("HTTP/1.1 403 Forbidden\r\ncontent-length: 0\r\n\r\n", 0, "status 403"),
            ("HTTP/1.1 307 Moved\r\nlocation: /other\r\ncontent-length: 0\r\n\r\n", 0, "status 307"),
            ("HTTP/1.1 200 OK\r\ncontent-length: 4\r\n\r\nreef", 2, "ignores ranges"),
            (
                "HTTP/1.1 206 Partial Content\r\ncontent-range: bytes 0-1/4\r\ncontent-length: 2\r\n\r\nre",
                2,
                "from byte 2",
            ),
            ("HTTP/1.1 200 OK\r\ncontent-length: 3\r\n\r\nree", 0, "1 bytes are missing"),
            ("HTTP/1.1 200 OK\r\ncontent-length: 5\r\n\r\nreefs", 0, "there are more"),
            ("HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\nre", 0, "does not answer"),
            ("no HTTP\r\n\r\n", 0, "does not answer"),
        ] {
            let error = got(&answering(answer).await, offset, 4 - offset).await.unwrap_err().to_string();
            assert!(error.contains(said) && !error.contains("secret"), "{answer}: {error}");
        }
        let nobody = got("http://127.0.0.1:1/secret", 0, 4).await.unwrap_err().to_string();
        assert!(nobody.contains("does not answer") && !nobody.contains("secret"), "{nobody}");
    }

    #[tokio::test]
    async fn an_upload_sends_its_length_and_every_byte() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/secret", listener.local_addr().unwrap());
        let folder = tempfile::tempdir().unwrap();
        let whole: Vec<u8> = (0..3 * PIECE as u32 + 5).map(|byte| (byte / 251) as u8).collect();
        let path = folder.path().join("content");
        std::fs::write(&path, &whole).unwrap();
        let (of_bytes, of_file) = (Content::Bytes(whole.clone().into()), Content::File(path));
        for (sent, start, end) in [
            (&of_bytes, 0, whole.len()),
            (&of_file, 0, whole.len()),
            (&of_bytes, 1000, PIECE + 1000),
            (&of_file, 1000, PIECE + 2000),
        ] {
            let content = &whole[start..end];
            let headers = HashMap::from([("content-length".to_owned(), content.len().to_string())]);
            let direct = Direct::default();
            let put = direct.put(&url, &headers, sent, start as u64..end as u64);
            let taken = async {
                let (mut socket, _) = listener.accept().await.unwrap();
                let mut all = Vec::new();
                while !all.ends_with(content) {
                    assert!(socket.read_buf(&mut all).await.unwrap() > 0, "{} bytes", all.len());
                }
                socket.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").await.unwrap();
                String::from_utf8_lossy(&all[..all.len() - content.len()]).into_owned()
            };
            let (put, head) = tokio::join!(put, taken);
            put.unwrap();
            assert!(head.starts_with("PUT /secret HTTP/1.1\r\n"), "{head}");
            assert!(head.contains(&format!("content-length: {}\r\n", content.len())), "{head}");
            assert!(!head.contains("transfer-encoding"), "{head}");
        }
    }

    #[tokio::test]
    async fn an_upload_that_is_stuck_is_given_up() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/secret", listener.local_addr().unwrap());
        let content = Content::Bytes(vec![7; 64 << 20].into());
        let begun = Instant::now();
        let stuck = Direct::default().put(&url, &HashMap::new(), &content, 0..64 << 20).await.unwrap_err();
        assert!(stuck.to_string().contains("no byte for 10 s"), "{stuck}");
        assert!(begun.elapsed() < Duration::from_secs(40), "{:?}", begun.elapsed());
    }

    #[tokio::test(start_paused = true)]
    async fn a_failure_counts_for_a_minute() {
        let direct = Direct::default();
        assert!(direct.is_wanted());
        direct.clone().failed(&DirectError::Refused(StatusCode::FORBIDDEN));
        assert!(!direct.is_wanted(), "clones share it");
        tokio::time::advance(AGAIN_AFTER).await;
        assert!(direct.is_wanted());
    }
}
