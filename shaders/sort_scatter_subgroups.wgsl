//@ import frame, counters, subgroups, digits_subgroups
// As sort_scatter, for adapters with subgroups. The work is distributed as in sort_count_subgroups, so keys
// keep their order: by subgroup, then by round, then by lane.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> histogram: array<u32>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> values_in: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32, @builtin(subgroup_id) index: u32,
        @builtin(num_subgroups) count: u32, @builtin(subgroup_size) size: u32,
        @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    let s = Subgroup(index, count, size, lane);
    count_digits(thread, chunk, n, s);
    // From counts to the position of the next key.
    if thread < SORT_BINS && chunk < chunks {
        var next = histogram[thread * chunks + chunk];
        for (var i = 0u; i < count; i++) {
            let own = sh_digits[i * SORT_BINS + thread];
            sh_digits[i * SORT_BINS + thread] = next;
            next += own;
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let k = key_of(chunk, round, n, s);
        let to = sh_digits[k.slot] + ones(k.peers & lanes_before(lane));
        // All lanes have read the position of their digit before the first lane advances it.
        workgroupBarrier();
        if k.valid {
            if k.first {
                sh_digits[k.slot] = to + ones(k.peers);
            }
            keys_out[to] = k.key;
            values_out[to] = values_in[k.at];
        }
        workgroupBarrier();
    }
}
