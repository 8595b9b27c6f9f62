//@ import frame, water, priors, slide
// Physics-aware dark channel, step 5 of 6: the gradient w.r.t. the signal of each pixel, from all row windows
// that selected it. If the signal is that of the render, also the gradient w.r.t. the underwater image.
//
//     v_I^c = w_c v_m for the channel c of m;  the gradient treats w_c as constants
//   rows    [H*W] vec2: bits of the gradient w.r.t. a window's minimum, and the column of that minimum
//   seen    [H*W] vec4: the underwater image, and alpha
//   signal  [H*W] vec2: in: bits of m; out: bits of the gradient w.r.t. m; its channel stays
//   v_image [H*W*4] gradient w.r.t. the underwater image; added to
// Gathered in column order, so runs are identical. One thread computes eight neighbouring pixels of a row.
// Runs between the loss and `water_backward`. Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<uniform> water: Water;
@group(0) @binding(2) var<storage, read> rows: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> signal: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> v_image: array<f32>;

fn put(at: u32, inside: bool, v: f32) {
    if inside {
        signal[at].x = bitcast<u32>(v);
        if v != 0.0 && veiled(priors.on_photograph, arrayLength(&signal)) == 0u {
            let channel = signal[at].y;
            let slope = select(decoded_slope(seen[at].rgb), vec3<f32>(1.0), priors.linear != 0u);
            v_image[4u * at + channel] += v * (channel_weights(water, priors.unit) * slope)[channel];
        }
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
    let radius = veiled(priors.radius, arrayLength(&rows) + 256u);
    var first = vec4<f32>(0.0);
    var second = vec4<f32>(0.0);
    for (var k = 0u; k < entries(radius); k++) {
        let column = i32(x0 + k) - i32(radius);
        let inside = column >= 0 && column < i32(priors.size.x);
        let taken = rows[row_at + u32(clamp(column, 0, i32(priors.size.x) - 1))];
        let v = vec4<f32>(select(0.0, bitcast<f32>(taken.x), inside));
        first += select(vec4<f32>(0.0), v, vec4<u32>(taken.y) == x0 + FIRST);
        second += select(vec4<f32>(0.0), v, vec4<u32>(taken.y) == x0 + SECOND);
    }
    let at = row_at + x0;
    let left = select(0u, priors.size.x - x0, i < runs * priors.size.y);
    put(at, left > 0u, first.x);
    put(at + 1u, left > 1u, first.y);
    put(at + 2u, left > 2u, first.z);
    put(at + 3u, left > 3u, first.w);
    put(at + 4u, left > 4u, second.x);
    put(at + 5u, left > 5u, second.y);
    put(at + 6u, left > 6u, second.z);
    put(at + 7u, left > 7u, second.w);
}
