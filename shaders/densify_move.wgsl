//@ import frame
// Classic density control, step 2 of 2: copies rows of an array of any type. It runs twice: from a block to a
// staging buffer, and from there into the gaps of removed Gaussians, in this block or another.
//
//   moves [count]  x: source row, y: destination row
//   rows_in, rows_out [N*words]
// One thread per word.

struct Moves {
    count: u32,
    // Number of u32 per row.
    words: u32,
    pad0: u32,
    pad1: u32,
}

@group(0) @binding(0) var<uniform> size: Moves;
@group(0) @binding(1) var<storage, read> moves: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> rows_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> rows_out: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let n = folded(group, groups) * 64u + lane;
    if n >= size.count * size.words {
        return;
    }
    let row = moves[n / size.words];
    let word = n % size.words;
    rows_out[row.y * size.words + word] = rows_in[row.x * size.words + word];
}
