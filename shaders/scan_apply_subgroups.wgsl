//@ import frame, counters
// As scan_apply, for adapters with subgroups. A lane takes four consecutive counts; neighbouring lanes take
// neighbouring groups of four.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read> sums: array<u32>;

var<workgroup> sh_sums: array<u32, 32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(subgroup_id) subgroup: u32, @builtin(subgroup_size) size: u32,
        @builtin(subgroup_invocation_id) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let first = chunk * SCAN_CHUNK + (subgroup * size + lane) * 4u;
    let last = min(first + 4u, n);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum += values[i];
    }
    let before_lane = subgroupExclusiveAdd(sum);
    if lane == size - 1u {
        sh_sums[subgroup] = before_lane + sum;
    }
    workgroupBarrier();
    if first < last {
        var before = sums[chunk] + before_lane;
        for (var i = 0u; i < subgroup; i++) {
            before += sh_sums[i];
        }
        for (var i = first; i < last; i++) {
            let value = values[i];
            values[i] = before;
            before += value;
        }
    }
}
