// As disk_maps.wgsl, for disks whose ranges, normals and masks nobody reads. Needs disk and met.

alias Maps = f32;

fn add_maps(maps: ptr<private, Maps>, disk: Splat, met: Met, normal: vec3<f32>, w: vec4<f32>) {}

fn store_maps(column: u32, row: u32, m: Maps) {}
