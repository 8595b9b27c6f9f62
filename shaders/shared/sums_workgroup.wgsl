// How the threads of a tile add up gradients: through workgroup memory. Used with exchange_workgroup.wgsl.

var<workgroup> sh_partial: array<vec4<f32>, 24 * LANES>;

// Stores a thread's part of the gradient of splat i of the batch.
fn give_sums(lane: u32, i: u32, sums: Splat) {
    let at = 3u * LANES * i + lane;
    sh_partial[at] = sums.a;
    sh_partial[at + LANES] = sums.b;
    sh_partial[at + 2u * LANES] = sums.c;
}

// Adds the parts of the batch in thread order and writes the sums to the slots.
fn write_sums(lane: u32, first: u32, last: u32) {
    workgroupBarrier();
    for (var i = lane; i < 3u * BATCH && first + i / 3u < last; i += LANES) {
        var sum = vec4<f32>(0.0);
        for (var k = 0u; k < LANES; k++) {
            sum += sh_partial[LANES * i + k];
        }
        slot_gradients[3u * slots[first + i / 3u] + i % 3u] = sum;
    }
}
