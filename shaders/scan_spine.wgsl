//@ import frame, counters
// Exclusive prefix sum, step 2 of 3: scans the sums of the chunks in place and writes the total after the
// last. The addition saturates at the largest u32, so that a total that is too large never looks small enough
// for a list.
//
// One workgroup of 64 threads; each takes a run of consecutive sums.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

var<workgroup> sh_totals: array<u32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    let chunks = groups_for(counters[which.x], SCAN_CHUNK);
    let run = groups_for(chunks, 64u);
    let first = lane * run;
    let last = min(first + run, chunks);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum = saturating_sum(sum, sums[i]);
    }
    sh_totals[lane] = sum;
    workgroupBarrier();
    var before = 0u;
    for (var i = 0u; i < lane; i++) {
        before = saturating_sum(before, sh_totals[i]);
    }
    for (var i = first; i < last; i++) {
        let value = sums[i];
        sums[i] = before;
        before = saturating_sum(before, value);
    }
    if lane == 63u {
        sums[chunks] = before;
    }
}

fn saturating_sum(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}
