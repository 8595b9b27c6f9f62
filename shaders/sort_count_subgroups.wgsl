//@ import frame, counters, subgroups, digits_subgroups
// As sort_count, for adapters with subgroups: neighbouring lanes take neighbouring keys.
//
// One workgroup per chunk of 2048 keys. Ballots find the lanes that share a digit. Columns of the histogram
// belong to subgroups.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32, @builtin(subgroup_id) index: u32,
        @builtin(num_subgroups) count: u32, @builtin(subgroup_size) size: u32,
        @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    count_digits(thread, chunk, n, Subgroup(index, count, size, lane));
    if thread < SORT_BINS && chunk < chunks {
        var sum = 0u;
        for (var i = 0u; i < count; i++) {
            sum += sh_digits[i * SORT_BINS + thread];
        }
        histogram[thread * chunks + chunk] = sum;
    }
}
