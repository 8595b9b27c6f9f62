//@ import frame, counters, digits
// Stable radix sort, step 2 of 2: moves keys and values to the positions given by the scanned histogram.
//
// The work is distributed as in sort_count, so a thread visits its keys in the order in which it counted
// them.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> histogram: array<u32>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> values_in: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let chunks = groups_for(n, SORT_CHUNK);
    if chunk >= chunks {
        return;
    }
    let own = keys_of_thread(chunk, lane, n);
    count_digits(lane, own);
    // From counts to the position of the next key.
    for (var bin = lane; bin < SORT_BINS; bin += 32u) {
        var next = histogram[bin * chunks + chunk];
        for (var i = 0u; i < 32u; i++) {
            let count = sh_digits[bin * 32u + i];
            sh_digits[bin * 32u + i] = next;
            next += count;
        }
    }
    workgroupBarrier();
    for (var i = own.x; i < own.y; i++) {
        let key = keys[i];
        let slot = digit_of(key) * 32u + lane;
        let to = sh_digits[slot];
        sh_digits[slot] = to + 1u;
        keys_out[to] = key;
        values_out[to] = values_in[i];
    }
}
