//@ import frame, counters
// As scan_chunks, for adapters with subgroups: neighbouring lanes take neighbouring counts.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

var<workgroup> sh_sums: array<u32, 32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32, @builtin(subgroup_id) subgroup: u32,
        @builtin(num_subgroups) subgroups: u32, @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    var sum = 0u;
    for (var k = 0u; k < SCAN_CHUNK / 256u; k++) {
        let i = chunk * SCAN_CHUNK + k * 256u + thread;
        if i < n {
            sum += values[i];
        }
    }
    let of_subgroup = subgroupAdd(sum);
    if lane == 0u {
        sh_sums[subgroup] = of_subgroup;
    }
    workgroupBarrier();
    if thread == 0u && chunk < groups_for(n, SCAN_CHUNK) {
        var total = 0u;
        for (var i = 0u; i < subgroups; i++) {
            total += sh_sums[i];
        }
        sums[chunk] = total;
    }
}
