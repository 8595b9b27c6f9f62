// How the threads of a tile share splats: through workgroup memory, on any adapter. exchange_vector.wgsl has
// the same functions for vector adapters.

const BATCH: u32 = 8u;

var<workgroup> sh_splats: array<vec4<f32>, 24>;

// Loads the splats for the entries of the tile's list from `first` on. Entries from `last` on get opacity 0,
// so they are never blended.
fn share_splats(lane: u32, first: u32, last: u32) {
    workgroupBarrier();
    for (var i = lane; i < 3u * BATCH; i += LANES) {
        var value = vec4<f32>(0.0);
        if first + i / 3u < last {
            value = projected[3u * visible_from_slot[slots[first + i / 3u]] + i % 3u];
        }
        sh_splats[i] = value;
    }
    workgroupBarrier();
}

fn shared_splat(i: u32) -> Splat {
    return Splat(sh_splats[3u * i], sh_splats[3u * i + 1u], sh_splats[3u * i + 2u]);
}
