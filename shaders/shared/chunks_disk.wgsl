// Whether a view may see disks of a chunk. The outline of a disk is not linear in its position, so only the
// test of each disk decides (reach_disk.wgsl). Needs the name frame.

fn may_hold_seen(centre: vec3<f32>, half_sides: vec3<f32>, reach: f32) -> bool {
    return frame.blocks > 0u;
}
