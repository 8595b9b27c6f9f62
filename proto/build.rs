//! Compiles the protos with protox: pure Rust, no `protoc` to install.

use std::env;
use std::fs;
use std::path::PathBuf;

use prost::Message as _;

const PROTOS: [&str; 6] = [
    "fathom/admin/v1/admin.proto",
    "fathom/v1/blob.proto",
    "fathom/v1/job.proto",
    "fathom/v1/log.proto",
    "fathom/v1/upload.proto",
    "fathom/worker/v1/worker.proto",
];

/// Not one of Fathom's contracts: served at its own address, and left out of reflection.
const KEDA: &str = "keda/externalscaler.proto";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    for proto in PROTOS.iter().chain([&KEDA]) {
        println!("cargo::rerun-if-changed={proto}");
    }
    let descriptors = protox::compile(PROTOS, ["."])?;
    let out_dir = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out_dir.join("descriptors.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        .bytes(".fathom.v1.WriteBlobRequest.data")
        .bytes(".fathom.v1.ReadBlobResponse.data")
        .compile_fds(descriptors)?;
    tonic_prost_build::configure().compile_fds(protox::compile([KEDA], ["."])?)?;
    Ok(())
}
