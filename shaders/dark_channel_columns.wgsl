//@ import frame, water, priors, slide
// Physics-aware dark channel, step 3 of 6: the smallest signal D of each patch, and the gradient of the loss
// w.r.t. it (SMP-UWGS eq. 13).
//
//     loss = mean over pixels of lambda (max(D, 0) + negative S(max(-D, 0)))
//     S(x) = x^2 / 2s below s, x - s/2 above
//   rows    [H*W] vec2: bits of the row minima, and their columns
//   truth   [H*W] packed photograph; the highest byte is the mask
//   columns [H*W] vec2: bits of the gradient w.r.t. D, and the row of the minimum (the first of equal ones)
// A patch whose centre is masked does not count. One thread computes eight pixels of a column.
// Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<storage, read> truth: array<u32>;
@group(0) @binding(2) var<storage, read> rows: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> columns: array<vec2<u32>>;

// s, linear light (code of SeaSplat and SMP-UWGS): below it the negative part is a parabola.
const BEND: f32 = 0.2;

fn put(at: u32, inside: bool, d: f32, row: u32) {
    if inside {
        var v = 0.0;
        if d < NO_SIGNAL && counts(truth[at], priors.masked) {
            let below = -priors.negative * min(-d / BEND, 1.0);
            v = priors.dark_weight * select(select(0.0, 1.0, d > 0.0), below, d < 0.0);
        }
        columns[at] = vec2<u32>(bitcast<u32>(v), row);
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
    let radius = veiled(priors.radius, arrayLength(&rows) + 256u);
    var least = no_least();
    for (var k = 0u; k < entries(radius); k++) {
        let row = i32(y0 + k) - i32(radius);
        let inside = row >= 0 && row < i32(priors.size.y);
        let at = u32(clamp(row, 0, i32(priors.size.y) - 1));
        let value = select(NO_SIGNAL, bitcast<f32>(rows[at * priors.size.x + column].x), inside);
        least = with_entry(least, radius, k, value, at);
    }
    let at = y0 * priors.size.x + column;
    let next = priors.size.x;
    let left = select(0u, priors.size.y - y0, i < runs * priors.size.x);
    put(at, left > 0u, least.first.x, least.first_at.x);
    put(at + next, left > 1u, least.first.y, least.first_at.y);
    put(at + 2u * next, left > 2u, least.first.z, least.first_at.z);
    put(at + 3u * next, left > 3u, least.first.w, least.first_at.w);
    put(at + 4u * next, left > 4u, least.second.x, least.second_at.x);
    put(at + 5u * next, left > 5u, least.second.y, least.second_at.y);
    put(at + 6u * next, left > 6u, least.second.z, least.second_at.z);
    put(at + 7u * next, left > 7u, least.second.w, least.second_at.w);
}
