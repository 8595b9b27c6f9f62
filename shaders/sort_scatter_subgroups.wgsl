//@ import frame, counters, subgroups
// As sort_scatter, for adapters with subgroups. Work is laid out as in sort_count_subgroups, so keys keep their order:
// subgroups in theirs, rounds of a subgroup in theirs, lanes in theirs.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> histogram: array<u32>;
@group(0) @binding(3) var<storage, read> keys_in: array<u32>;
@group(0) @binding(4) var<storage, read> values_in: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

// [32 subgroups at most][64 digits]: first how many keys there are, then where the next one goes.
var<workgroup> sh_next: array<u32, 2048>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32, @builtin(subgroup_id) subgroup: u32,
        @builtin(num_subgroups) subgroups: u32, @builtin(subgroup_size) size: u32,
        @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    for (var i = thread; i < 2048u; i += 256u) {
        sh_next[i] = 0u;
    }
    workgroupBarrier();
    let first = chunk * SORT_CHUNK + subgroup * (SORT_CHUNK / subgroups) + lane;
    for (var round = 0u; round < SORT_CHUNK / 256u; round++) {
        let i = first + round * size;
        let valid = i < n && chunk < chunks;
        var key = 0u;
        if valid {
            key = keys_in[i];
        }
        let digit = (key >> which.y) & (SORT_BINS - 1u);
        let peers = same_digit(digit, valid);
        if valid && first_lane(peers) == lane {
            sh_next[subgroup * SORT_BINS + digit] += ones(peers);
        }
        subgroupBarrier();
    }
    workgroupBarrier();
    if thread < SORT_BINS && chunk < chunks {
        var next = histogram[thread * chunks + chunk];
        for (var i = 0u; i < subgroups; i++) {
            let count = sh_next[i * SORT_BINS + thread];
            sh_next[i * SORT_BINS + thread] = next;
            next += count;
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < SORT_CHUNK / 256u; round++) {
        let i = first + round * size;
        let valid = i < n && chunk < chunks;
        var key = 0u;
        if valid {
            key = keys_in[i];
        }
        let digit = (key >> which.y) & (SORT_BINS - 1u);
        let peers = same_digit(digit, valid);
        let to = sh_next[subgroup * SORT_BINS + digit] + ones(peers & lanes_before(lane));
        // All have read where their digit goes before the first lane moves it on.
        subgroupBarrier();
        if valid {
            if first_lane(peers) == lane {
                sh_next[subgroup * SORT_BINS + digit] = to + ones(peers);
            }
            keys_out[to] = key;
            values_out[to] = values_in[i];
        }
        subgroupBarrier();
    }
}
