//@ import frame, counters, subgroups
// As sort_count, for adapters with subgroups: neighbouring lanes take neighbouring keys.
//
// One workgroup of 256 a chunk of 2048 keys. A subgroup takes consecutive keys, as many at a time as it has lanes; the lanes
// with one digit find each other by ballots, and the first of them counts for all: no atomics. The columns of the
// histogram belong to subgroups.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

// [32 subgroups at most][64 digits].
var<workgroup> sh_histogram: array<u32, 2048>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32, @builtin(subgroup_id) subgroup: u32,
        @builtin(num_subgroups) subgroups: u32, @builtin(subgroup_size) size: u32,
        @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    for (var i = thread; i < 2048u; i += 256u) {
        sh_histogram[i] = 0u;
    }
    workgroupBarrier();
    let first = chunk * SORT_CHUNK + subgroup * (SORT_CHUNK / subgroups) + lane;
    for (var round = 0u; round < SORT_CHUNK / 256u; round++) {
        let i = first + round * size;
        let valid = i < n && chunk < chunks;
        var key = 0u;
        if valid {
            key = keys[i];
        }
        let digit = (key >> which.y) & (SORT_BINS - 1u);
        let peers = same_digit(digit, valid);
        if valid && first_lane(peers) == lane {
            sh_histogram[subgroup * SORT_BINS + digit] += ones(peers);
        }
        subgroupBarrier();
    }
    workgroupBarrier();
    if thread < SORT_BINS && chunk < chunks {
        var sum = 0u;
        for (var i = 0u; i < subgroups; i++) {
            sum += sh_histogram[i * SORT_BINS + thread];
        }
        histogram[thread * chunks + chunk] = sum;
    }
}
