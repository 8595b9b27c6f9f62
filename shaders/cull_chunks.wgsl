//@ import frame, gaussian
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

// The maximum of a . m + c over the box, with slack for rounding.
fn greatest(a: vec3<f32>, c: f32, centre: vec3<f32>, half_sides: vec3<f32>) -> f32 {
    let size = dot(abs(a), abs(centre) + half_sides) + abs(c);
    return dot(a, centre) + c + dot(abs(a), half_sides) + 1e-5 * size;
}

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
    let most = max(abs(frame.ratio_min), abs(frame.ratio_max));
    let spread = 1.02 * sqrt(1.0 + dot(most, most)) * reach;
    // sqrt(2 ln 255) standard deviations of the low-pass.
    let pad = 3.4 * sqrt(BLUR) + 0.6;
    let x = frame.view_x;
    let y = frame.view_y;
    let z = frame.view_z;
    // Distance of the principal point from the edges, pixels.
    let before = frame.principal - frame.rect_min + pad;
    let behind = frame.rect_max - frame.principal + pad;
    let f = frame.focal;
    let seen = reach >= 0.0
        && greatest(z.xyz, z.w - NEAR, centre, half_sides) > 0.0
        && greatest(f.x * x.xyz + before.x * z.xyz, f.x * (x.w + spread) + before.x * z.w, centre, half_sides) > 0.0
        && greatest(f.y * y.xyz + before.y * z.xyz, f.y * (y.w + spread) + before.y * z.w, centre, half_sides) > 0.0
        && greatest(behind.x * z.xyz - f.x * x.xyz, f.x * (spread - x.w) + behind.x * z.w, centre, half_sides) > 0.0
        && greatest(behind.y * z.xyz - f.y * y.xyz, f.y * (spread - y.w) + behind.y * z.w, centre, half_sides) > 0.0;
    chunk_seen[chunk] = select(0u, 1u, seen);
}
