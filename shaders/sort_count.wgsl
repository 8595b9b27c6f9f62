//@ import frame, counters, digits
// Stable radix sort, step 1 of 2: counts each digit of a chunk. A scan of the histogram follows before step
// 2.
//
// Six bits per pass. One workgroup per chunk of 2048 keys, 64 consecutive keys per thread, one column of the
// histogram per thread. There are no atomics, so the order is the same in every run. `histogram` [64 *
// chunks], digit-major. which: x counter of the number of keys, y shift of the digit.
// Twin: slice::sort_by_key, which is stable (core/tests).

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    if chunk >= chunks {
        return;
    }
    count_digits(lane, keys_of_thread(chunk, lane, n));
    for (var bin = lane; bin < SORT_BINS; bin += 32u) {
        var sum = 0u;
        for (var i = 0u; i < 32u; i++) {
            sum += sh_digits[bin * 32u + i];
        }
        histogram[bin * chunks + chunk] = sum;
    }
}
