// As sums_workgroup.wgsl, for disks. Half a batch at a time: the parts of a whole batch exceed the 16 KiB of
// workgroup memory that every device has.

const HALF_BATCH: u32 = 4u;

var<workgroup> sh_partial: array<vec4<f32>, 5u * HALF_BATCH * LANES>;

// Stores a thread's part of the gradient of disk i of a half batch.
fn give_sums(lane: u32, i: u32, sums: Splat) {
    let at = 5u * LANES * (i % HALF_BATCH) + lane;
    sh_partial[at] = sums.a;
    sh_partial[at + LANES] = sums.b;
    sh_partial[at + 2u * LANES] = sums.c;
    sh_partial[at + 3u * LANES] = sums.d;
    sh_partial[at + 4u * LANES] = sums.e;
}

// Adds the parts of a half of the batch in thread order and writes the sums to the slots.
fn write_sums(lane: u32, first: u32, half: u32, last: u32) {
    let start = first + half * HALF_BATCH;
    workgroupBarrier();
    for (var i = lane; i < 5u * HALF_BATCH && start + i / 5u < last; i += LANES) {
        var sum = vec4<f32>(0.0);
        for (var k = 0u; k < LANES; k++) {
            sum += sh_partial[LANES * i + k];
        }
        slot_gradients[5u * slots[start + i / 5u] + i % 5u] = sum;
    }
    workgroupBarrier();
}
