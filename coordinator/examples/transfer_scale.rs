//! Measures how fast files go through a coordinator to its disk and to a bucket, and directly to the bucket.
//!
//! ```text
//! cargo run --example transfer_scale -- [BLOBS] [MIB]
//! ```
//! 8 clients send 32 blobs of 32 MiB by default and fetch them again over gRPC on loopback. Then they do the
//! same with as many bytes in blobs of 512 KiB. The blobs are first in a data directory, then in a bucket of
//! an S3 server (`s3s-fs`, on the same disk), and then the clients use that bucket themselves. Clients,
//! coordinator and S3 server share the cores, so the figures are lower bounds. It also counts the requests to
//! the bucket.

#[path = "../../tests/support/s3.rs"]
mod s3;

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use bytes::Bytes;
use fathom_coordinator::{CoordinatorConfig, serve};
use fathom_core::scene::BlobRef;
use fathom_proto::dial::{Connection, Dial};
use fathom_proto::direct::{Content, Direct};
use fathom_proto::v1;
use fathom_proto::v1::upload_service_client::UploadServiceClient;

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// Clients at once.
const CLIENTS: usize = 8;
/// Names the URL of the bucket to the process that measures.
const OBJECTS: &str = "TRANSFER_SCALE_OBJECTS";
/// Bytes of a message.
const MESSAGE_BYTES: usize = 1 << 20;

/// This process has the S3 server. It starts another one with the coordinator and its clients, and adds the
/// number of requests to each of its lines.
fn main() -> Result<(), Failure> {
    if let Ok(objects) = std::env::var(OBJECTS) {
        return measure_all(&objects);
    }
    let server = s3::S3Server::start();
    let mut child = Command::new(std::env::current_exe()?)
        .args(std::env::args().skip(1))
        .envs(server.environment())
        .env(OBJECTS, server.url("scale"))
        .stdout(Stdio::piped())
        .spawn()?;
    let mut before = server.requests().0;
    for line in BufReader::new(child.stdout.take().ok_or("no pipe")?).lines() {
        let now = server.requests().0;
        println!("{}; {} requests to the bucket", line?, now - before);
        before = now;
    }
    if child.wait()?.success() { Ok(()) } else { Err("the measurement failed".into()) }
}

fn measure_all(objects: &str) -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1);
    let mut argument = |default: usize| arguments.next().map_or(Ok(default), |text| text.parse::<usize>());
    let (blobs, mib) = (argument(32)?, argument(32)?);
    let runtime = tokio::runtime::Runtime::new()?;
    let places =
        [("data directory", None), ("bucket", Some("through")), ("bucket, directly", Some("direct"))];
    for (what, prefix) in places {
        for (count, bytes) in [(blobs, mib << 20), (blobs * mib, 512 << 10)] {
            let dir = tempfile::tempdir()?;
            // A prefix belongs to one deployment.
            let objects = prefix.map(|prefix| format!("{objects}/{prefix}-{count}"));
            let direct = (prefix == Some("direct")).then(Direct::default);
            let (sent, fetched) = runtime.block_on(measure(dir.path(), objects, direct, count, bytes))?;
            println!(
                "{what}, {count} blobs of {bytes} bytes: sent {sent:.0} MB/s, fetched {fetched:.0} MB/s"
            );
        }
    }
    Ok(())
}

/// Megabytes per second of uploads and of downloads.
async fn measure(
    data_dir: &Path,
    objects: Option<String>,
    direct: Option<Direct>,
    count: usize,
    bytes: usize,
) -> Result<(f64, f64), Failure> {
    let config = CoordinatorConfig {
        data_dir: data_dir.to_owned(),
        objects,
        listen: ([127, 0, 0, 1], 0).into(),
        min_free_bytes: 0,
        // To measure what it costs.
        direct_uploads_from_bytes: 0,
        ..CoordinatorConfig::default()
    };
    let coordinator = serve(config).await?;
    let mut clients = Vec::new();
    for _ in 0..CLIENTS {
        clients.push(UploadServiceClient::new(Dial::to(&coordinator.url()).lazily()?));
    }
    let contents: Vec<Bytes> = (0..count).map(|number| content(number, bytes)).collect();
    let blobs: Vec<BlobRef> = contents.iter().map(|content| BlobRef::of(content)).collect();
    let megabytes = (count * bytes) as f64 / 1e6;
    let begin = Instant::now();
    let lanes = clients.iter().enumerate().map(|(number, client)| {
        let (client, contents, blobs) = (client.clone(), contents.clone(), blobs.clone());
        let direct = direct.clone();
        tokio::spawn(async move {
            for index in (number..blobs.len()).step_by(CLIENTS) {
                let content = contents[index].clone();
                match &direct {
                    Some(direct) => send_directly(&client, direct, &blobs[index], content).await?,
                    None => send(client.clone(), &blobs[index], content).await?,
                }
            }
            Ok::<_, Failure>(())
        })
    });
    for lane in lanes.collect::<Vec<_>>() {
        lane.await??;
    }
    let sent = megabytes / begin.elapsed().as_secs_f64();
    let begin = Instant::now();
    let lanes = clients.into_iter().enumerate().map(|(number, client)| {
        let (blobs, direct) = (blobs.clone(), direct.clone());
        tokio::spawn(async move {
            for blob in blobs.iter().skip(number).step_by(CLIENTS) {
                fetch(client.clone(), direct.as_ref(), blob).await?;
            }
            Ok::<_, Failure>(())
        })
    });
    for lane in lanes.collect::<Vec<_>>() {
        lane.await??;
    }
    let fetched = megabytes / begin.elapsed().as_secs_f64();
    coordinator.stop().await?;
    Ok((sent, fetched))
}

/// Bytes that differ between blobs.
fn content(number: usize, bytes: usize) -> Bytes {
    let mut content = vec![7; bytes];
    let name = format!("{number} of {bytes}");
    content[..name.len()].copy_from_slice(name.as_bytes());
    content.into()
}

async fn send(
    mut client: UploadServiceClient<Connection>,
    blob: &BlobRef,
    content: Bytes,
) -> Result<(), Failure> {
    let named = v1::BlobRef { digest: blob.digest.clone(), size_bytes: blob.bytes };
    let messages = (0..content.len()).step_by(MESSAGE_BYTES).map(move |at| {
        let end = content.len().min(at + MESSAGE_BYTES);
        v1::WriteBlobRequest {
            blob: (at == 0).then(|| named.clone()),
            offset_bytes: at as u64,
            data: content.slice(at..end),
            finish: end == content.len(),
            ..Default::default()
        }
    });
    let answer = client.write_blob(futures::stream::iter(messages.collect::<Vec<_>>())).await?.into_inner();
    if answer.complete { Ok(()) } else { Err("an upload is not complete".into()) }
}

async fn send_directly(
    client: &UploadServiceClient<Connection>,
    direct: &Direct,
    blob: &BlobRef,
    content: Bytes,
) -> Result<(), Failure> {
    let named = v1::BlobRef { digest: blob.digest.clone(), size_bytes: blob.bytes };
    let arrived = direct.upload(client, &named, "", Content::Bytes(content), 0).await;
    if arrived == blob.bytes { Ok(()) } else { Err("a file did not go directly to the bucket".into()) }
}

async fn fetch(
    mut client: UploadServiceClient<Connection>,
    direct: Option<&Direct>,
    blob: &BlobRef,
) -> Result<(), Failure> {
    let digest = blob.digest.clone();
    let request = v1::ReadBlobRequest { digest, direct: direct.is_some(), ..Default::default() };
    let mut pieces = client.read_blob(request).await?.into_inner();
    let mut hasher = blake3::Hasher::new();
    while let Some(piece) = pieces.message().await? {
        hasher.update(&piece.data);
        if let Some(direct) = direct {
            let mut pieces = direct.get(&piece.url, 0, blob.bytes).await?;
            while let Some(data) = pieces.next().await? {
                hasher.update(&data);
            }
        }
    }
    if hasher.finalize().to_hex().as_str() == blob.digest {
        Ok(())
    } else {
        Err("other bytes came back".into())
    }
}
