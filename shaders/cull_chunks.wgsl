//@ import frame, gaussian, chunks
//@ variant cull_chunks chunks=chunks_splat
//@ variant cull_disk_chunks chunks=chunks_disk
// Which chunks of a frozen block may be visible, from the bounding box of each (core/src/gpu/bounds.rs).
//
// A Gaussian at camera position m with reach R passes the test of `cull` at an edge of the image only if
//     f m.x + (p - edge + s) m.z + f k R > 0,   s = 3.33 sqrt(blur) + 0.5,   k = 1.01 sqrt(1 + most ratio^2)
// and similarly for the other edges. This is linear in m, so the box is outside if its most favourable corner
// fails. The slack is slightly larger than in `cull`, because this test may pass too many chunks, never too
// few.
//
//   bounds      [chunks*2] vec4: (centre, largest reach; below 0 if there is none), (half sides, 0)
//   chunk_seen  [chunks]   0 or 1
// One thread per chunk.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<storage, read> bounds: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> chunk_seen: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let chunk = folded(group, groups) * 64u + lane;
    if chunk * CHUNK >= block.count {
        return;
    }
    let centre = bounds[2u * chunk].xyz;
    let reach = bounds[2u * chunk].w;
    let half_sides = bounds[2u * chunk + 1u].xyz;
    chunk_seen[chunk] = select(0u, 1u, reach >= 0.0 && may_hold_seen(centre, half_sides, reach));
}
