//@ import frame
// Classic density control, step 3 of 3: writes the rows that densify_take staged into an array of a block.
//
//   moves [count]       x: row that is written, y: row of `staged`
//   staged [n*words], rows [N*words]
// One thread a word.

struct Moves {
    count: u32,
    // u32 a row.
    words: u32,
    pad0: u32,
    pad1: u32,
}

@group(0) @binding(0) var<uniform> size: Moves;
@group(0) @binding(1) var<storage, read> moves: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> staged: array<u32>;
@group(0) @binding(3) var<storage, read_write> rows: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let n = folded(group, groups) * 64u + lane;
    if n >= size.count * size.words {
        return;
    }
    let row = moves[n / size.words];
    let word = n % size.words;
    rows[row.x * size.words + word] = staged[row.y * size.words + word];
}
