//@ import frame, counters, tiles, lists
//@ variant intersect_count lists=all_tiles
//@ variant intersect_count_at_surface lists=tiles_with_rays
// Counts the tiles that each visible Gaussian touches, in depth order.
//
// `counts` [visible] is indexed by depth rank and scanned next. One thread per rank.
// Twin: core/twins/src/intersect.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let rank = folded(group, groups) * 64u + lane;
    if rank >= counters[VISIBLE] {
        return;
    }
    let visible_id = order[rank];
    let p0 = projected[3u * visible_id];
    let p1 = projected[3u * visible_id + 1u];
    let s = Splat2d(p0.xy, vec3<f32>(p0.zw, p1.x), p1.w);
    let bounds = tile_box(frame, s);
    var count = 0u;
    for (var y = bounds.y; y < bounds.w; y++) {
        for (var x = bounds.x; x < bounds.z; x++) {
            let tile = vec2<u32>(x, y);
            count += select(0u, 1u, in_band(frame, tile) && has_list(y * frame.tiles.x + x) && touches(s, tile));
        }
    }
    counts[rank] = count;
}
