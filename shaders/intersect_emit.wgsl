//@ import frame, counters, tiles, lists
//@ variant intersect_emit lists=all_tiles
//@ variant intersect_emit_at_surface lists=tiles_with_rays
// Writes one entry for each tile that a visible Gaussian touches, front to back.
//
//   tile_keys             [intersections]  the tile: the key of the stable tile sort
//   slots                 [intersections]  the entry's own index, the value that the sort moves: its
//                                          gradients are written there
//   visible_from_slot     [intersections]
//   segments              [visible]        (first slot, number of slots) of a visible Gaussian: contiguous
// One thread per rank. If rounding makes this stage find fewer tiles than intersect_count did, the remaining
// entries get a tile after the last, which no kernel reads.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots: array<u32>;
@group(0) @binding(7) var<storage, read_write> visible_from_slot: array<u32>;
@group(0) @binding(8) var<storage, read_write> segments: array<vec2<u32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let rank = folded(group, groups) * 64u + lane;
    if rank >= counters[VISIBLE] {
        return;
    }
    let visible_id = order[rank];
    let first = offsets[rank];
    var end = counters[INTERSECTIONS];
    if rank + 1u < counters[VISIBLE] {
        end = offsets[rank + 1u];
    }
    let p0 = projected[3u * visible_id];
    let p1 = projected[3u * visible_id + 1u];
    let s = Splat2d(p0.xy, vec3<f32>(p0.zw, p1.x), p1.w);
    let bounds = tile_box(frame, s);
    var slot = first;
    for (var y = bounds.y; y < bounds.w; y++) {
        for (var x = bounds.x; x < bounds.z; x++) {
            let tile = vec2<u32>(x, y);
            let t = y * frame.tiles.x + x;
            if slot < end && in_band(frame, tile) && has_list(t) && touches(s, tile) {
                tile_keys[slot] = t;
                slots[slot] = slot;
                visible_from_slot[slot] = visible_id;
                slot++;
            }
        }
    }
    segments[visible_id] = vec2<u32>(first, slot - first);
    for (; slot < end; slot++) {
        tile_keys[slot] = frame.tiles.x * frame.tiles.y;
        slots[slot] = slot;
        visible_from_slot[slot] = visible_id;
    }
}
