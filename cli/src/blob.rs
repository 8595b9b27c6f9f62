//! Digests of files, for what is sent and what is fetched.

use std::io::Read as _;
use std::path::Path;

use fathom_core::scene::BlobRef;

use crate::error::{CliError, Result};

/// BLAKE3 and length of a file.
pub fn digest_file(path: &Path) -> Result<BlobRef> {
    let mut file = std::fs::File::open(path).map_err(CliError::io("read", path))?;
    let (mut hasher, mut bytes, mut buffer) = (blake3::Hasher::new(), 0, vec![0; 1 << 16]);
    loop {
        let count = file.read(&mut buffer).map_err(CliError::io("read", path))?;
        if count == 0 {
            return Ok(BlobRef { digest: hasher.finalize().to_hex().to_string(), bytes });
        }
        hasher.update(&buffer[..count]);
        bytes += count as u64;
    }
}
