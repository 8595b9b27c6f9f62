//@ import frame, water, priors, slide
// Physics-aware dark channel, step 4 of 6: the gradient w.r.t. the minimum of each row window, from all
// patches of its column that selected it.
//
//   columns [H*W] vec2: bits of the gradient w.r.t. a patch's minimum, and the row of that minimum
//   rows    [H*W] vec2: in: bits of the minimum; out: bits of the gradient w.r.t. it; its column stays
// Gathered in row order, so runs are identical. One thread computes eight pixels of a column.
// Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<storage, read> columns: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> rows: array<vec2<u32>>;

fn put(at: u32, inside: bool, v: f32) {
    if inside {
        rows[at].x = bitcast<u32>(v);
    }
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (priors.size.y + WINDOWS - 1u) / WINDOWS;
    let i = folded(group, groups) * 32u + lane;
    let column = i % priors.size.x;
    // Excess threads work on the last run and write nothing.
    let y0 = min(i / priors.size.x, runs - 1u) * WINDOWS;
    let radius = veiled(priors.radius, arrayLength(&columns) + 256u);
    var first = vec4<f32>(0.0);
    var second = vec4<f32>(0.0);
    for (var k = 0u; k < entries(radius); k++) {
        let row = i32(y0 + k) - i32(radius);
        let inside = row >= 0 && row < i32(priors.size.y);
        let taken = columns[u32(clamp(row, 0, i32(priors.size.y) - 1)) * priors.size.x + column];
        let v = vec4<f32>(select(0.0, bitcast<f32>(taken.x), inside));
        first += select(vec4<f32>(0.0), v, vec4<u32>(taken.y) == y0 + FIRST);
        second += select(vec4<f32>(0.0), v, vec4<u32>(taken.y) == y0 + SECOND);
    }
    let at = y0 * priors.size.x + column;
    let next = priors.size.x;
    let left = select(0u, priors.size.y - y0, i < runs * priors.size.x);
    put(at, left > 0u, first.x);
    put(at + next, left > 1u, first.y);
    put(at + 2u * next, left > 2u, first.z);
    put(at + 3u * next, left > 3u, first.w);
    put(at + 4u * next, left > 4u, second.x);
    put(at + 5u * next, left > 5u, second.y);
    put(at + 6u * next, left > 6u, second.z);
    put(at + 7u * next, left > 7u, second.w);
}
