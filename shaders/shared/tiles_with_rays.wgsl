// Whether a tile has a list: those do where a ray begins at the water surface (surface_tiles.wgsl).

@group(0) @binding(9) var<storage, read> tile_rays: array<u32>;

fn has_list(tile: u32) -> bool {
    return tile_rays[tile] != 0u;
}
