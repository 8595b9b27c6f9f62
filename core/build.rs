//! Lists the shaders, so that adding one only takes a new file: `shaders/*.wgsl` are kernels,
//! `shaders/shared/*.wgsl` are imports.

use std::error::Error;
use std::fmt::Write;
use std::path::Path;
use std::{env, fs};

fn main() -> Result<(), Box<dyn Error>> {
    let folder = Path::new(&env::var("CARGO_MANIFEST_DIR")?).join("../shaders").canonicalize()?;
    let lists = [("STAGES", folder.clone()), ("SHARED", folder.join("shared"))];
    let mut source = String::new();
    for (list, folder) in lists {
        println!("cargo::rerun-if-changed={}", folder.display());
        let mut names = Vec::new();
        for entry in fs::read_dir(&folder)? {
            let name = entry?.file_name();
            names.extend(name.to_str().and_then(|name| name.strip_suffix(".wgsl")).map(str::to_owned));
        }
        names.sort_unstable();
        writeln!(source, "const {list}: &[(&str, &str)] = &[")?;
        for name in names {
            let path = folder.join(format!("{name}.wgsl"));
            writeln!(source, "    ({name:?}, include_str!({path:?})),")?;
        }
        writeln!(source, "];")?;
    }
    fs::write(Path::new(&env::var("OUT_DIR")?).join("shaders.rs"), source)?;
    Ok(())
}
