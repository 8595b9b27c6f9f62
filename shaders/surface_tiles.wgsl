//@ import frame
// Which tiles have a ray that begins at the water surface. The others need no list.
//
//   rays       [H*W*2] vec4 of surface_rays
//   tile_rays  [tiles]  1 or 0
// One thread per tile. Twin: a loop in the test

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> rays: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> tile_rays: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let tile = folded(group, groups) * 64u + lane;
    if tile >= frame.tiles.x * frame.tiles.y {
        return;
    }
    let first = vec2<u32>(tile % frame.tiles.x, tile / frame.tiles.x) * TILE;
    let end = min(first + TILE, frame.size);
    var on = 0.0;
    for (var y = first.y; y < end.y; y++) {
        for (var x = first.x; x < end.x; x++) {
            on = max(on, rays[2u * (y * frame.size.x + x)].w);
        }
    }
    tile_rays[tile] = select(0u, 1u, on > 0.0);
}
