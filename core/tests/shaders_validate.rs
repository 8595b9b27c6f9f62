//! Checks that every shader is valid WGSL for every tile layout. Needs no GPU.
#![cfg(feature = "gpu")]

use std::collections::BTreeSet;

use fathom_core::gpu::{TileLayout, kernel_names, kernel_variants, shader_source};
use naga::valid::{Capabilities, ValidationFlags, Validator};

#[test]
fn shaders_validate() {
    let mut count = 0;
    for name in kernel_names().chain(kernel_variants()) {
        for layout in TileLayout::ALL {
            let source = shader_source(name, layout).expect("the stage and its imports are there");
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{name}, {layout:?}: {}", error.emit_to_string(&source)));
            // Optional capabilities are only allowed in layouts that need them; other shaders must run on
            // every adapter.
            let mut capabilities = Capabilities::empty();
            capabilities
                .set(Capabilities::SUBGROUP, layout.needs_subgroups() || name.ends_with("_subgroups"));
            capabilities
                .set(Capabilities::SUBGROUP_BARRIER, layout.subgroups || name.ends_with("_subgroups"));
            Validator::new(ValidationFlags::all(), capabilities)
                .validate(&module)
                .unwrap_or_else(|error| panic!("{name}, {layout:?}: {}", error.emit_to_string(&source)));
            count += 1;
        }
    }
    assert!(count > 20, "only {count} shaders were found");
    assert!(shader_source("no such stage", TileLayout::GPU).is_err());
}

#[test]
fn every_shader_file_is_a_stage() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../shaders");
    let files: BTreeSet<String> = std::fs::read_dir(folder)
        .expect("the folder of shaders")
        .filter_map(|entry| {
            entry.expect("an entry").file_name().into_string().ok()?.strip_suffix(".wgsl").map(str::to_owned)
        })
        .collect();
    let stages: BTreeSet<String> = kernel_names().map(str::to_owned).collect();
    assert_eq!(files, stages);
}

#[test]
fn the_readme_lists_exactly_the_stages() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../shaders/README.md");
    let readme = std::fs::read_to_string(file).expect("the README of the shaders");
    let listed: BTreeSet<&str> =
        readme.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next()).collect();
    assert_eq!(listed, kernel_names().collect(), "shaders/README.md (left) and the stages");
}
