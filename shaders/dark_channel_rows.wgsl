//@ import frame, water, priors, slide
// Physics-aware dark channel, step 2 of 6: the smallest signal of each row window.
//
//   signal [H*W] vec2: bits of m, channel
//   rows   [H*W] vec2: bits of the minimum, and its column (the first of equal ones); NO_SIGNAL and NOWHERE
//          if there is none
// One thread computes eight neighbouring pixels of a row. Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<storage, read> signal: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> rows: array<vec2<u32>>;

fn put(at: u32, inside: bool, value: f32, column: u32) {
    if inside {
        rows[at] = vec2<u32>(bitcast<u32>(value), column);
    }
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (priors.size.x + WINDOWS - 1u) / WINDOWS;
    let i = folded(group, groups) * 32u + lane;
    // Excess threads work on the last row and write nothing.
    let row = min(i / runs, priors.size.y - 1u);
    let x0 = (i % runs) * WINDOWS;
    let row_at = row * priors.size.x;
    let radius = veiled(priors.radius, arrayLength(&signal) + 256u);
    var least = no_least();
    for (var k = 0u; k < entries(radius); k++) {
        let column = i32(x0 + k) - i32(radius);
        let inside = column >= 0 && column < i32(priors.size.x);
        let at = u32(clamp(column, 0, i32(priors.size.x) - 1));
        let value = select(NO_SIGNAL, bitcast<f32>(signal[row_at + at].x), inside);
        least = with_entry(least, radius, k, value, at);
    }
    let at = row_at + x0;
    let left = select(0u, priors.size.x - x0, i < runs * priors.size.y);
    put(at, left > 0u, least.first.x, least.first_at.x);
    put(at + 1u, left > 1u, least.first.y, least.first_at.y);
    put(at + 2u, left > 2u, least.first.z, least.first_at.z);
    put(at + 3u, left > 3u, least.first.w, least.first_at.w);
    put(at + 4u, left > 4u, least.second.x, least.second_at.x);
    put(at + 5u, left > 5u, least.second.y, least.second_at.y);
    put(at + 6u, left > 6u, least.second.z, least.second_at.z);
    put(at + 7u, left > 7u, least.second.w, least.second_at.w);
}
