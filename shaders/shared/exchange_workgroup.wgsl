// How the threads of a tile share splats: through workgroup memory, on any adapter. exchange_vector.wgsl has
// the same functions for vector adapters.

const BATCH: u32 = 8u;

var<workgroup> sh_splats: array<vec4<f32>, 24>;
var<workgroup> sh_votes: array<u32, LANES>;

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

// Whether `yes` holds in any thread of the tile.
fn any_thread(lane: u32, yes: bool) -> bool {
    workgroupBarrier();
    sh_votes[lane] = select(0u, 1u, yes);
    workgroupBarrier();
    var votes = 0u;
    for (var i = 0u; i < LANES; i++) {
        votes += sh_votes[i];
    }
    return votes > 0u;
}

// The largest of the threads' numbers.
fn greatest(lane: u32, number: u32) -> u32 {
    workgroupBarrier();
    sh_votes[lane] = number;
    workgroupBarrier();
    var most = 0u;
    for (var i = 0u; i < LANES; i++) {
        most = max(most, sh_votes[i]);
    }
    return most;
}
