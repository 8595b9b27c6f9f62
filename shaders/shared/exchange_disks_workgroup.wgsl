// As exchange_workgroup.wgsl, for disks.

const BATCH: u32 = 8u;

var<workgroup> sh_splats: array<vec4<f32>, 40>;
var<workgroup> sh_votes: array<u32, LANES>;

fn share_splats(lane: u32, first: u32, last: u32) {
    workgroupBarrier();
    for (var i = lane; i < 5u * BATCH; i += LANES) {
        var value = vec4<f32>(0.0);
        if first + i / 5u < last {
            let at = 3u * visible_from_slot[slots[first + i / 5u]];
            let part = i % 5u;
            if part < 3u {
                value = disks[at + part];
            } else {
                value = projected[at + part - 2u];
            }
        }
        sh_splats[i] = value;
    }
    workgroupBarrier();
}

fn shared_splat(i: u32) -> Splat {
    let at = 5u * i;
    return Splat(sh_splats[at], sh_splats[at + 1u], sh_splats[at + 2u], sh_splats[at + 3u], sh_splats[at + 4u]);
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
