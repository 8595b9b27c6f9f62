//! Writes the descriptor of all protos to stdout: a release commits it under `proto/released/`.

use std::io::Write;

fn main() -> std::io::Result<()> {
    std::io::stdout().lock().write_all(fathom_proto::FILE_DESCRIPTOR_SET)
}
