//! Writes the descriptor of all protos to stdout: what a release commits under `proto/released/`.

use std::io::Write;

fn main() -> std::io::Result<()> {
    std::io::stdout().lock().write_all(fathom_proto::FILE_DESCRIPTOR_SET)
}
