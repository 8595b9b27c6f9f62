//@ import frame, counters
// The range of intersections of each tile in the sorted list.
//
// `ranges` [tiles + 1] is cleared before. One thread per intersection; neighbours with different tiles mark a
// border.

@group(0) @binding(0) var<storage, read> counters: array<u32>;
@group(0) @binding(1) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    let n = counters[INTERSECTIONS];
    if i >= n {
        return;
    }
    let tile = tile_keys[i];
    if i == 0u || tile_keys[i - 1u] != tile {
        ranges[tile].x = i;
    }
    if i + 1u == n || tile_keys[i + 1u] != tile {
        ranges[tile].y = i + 1u;
    }
}
