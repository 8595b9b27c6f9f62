// As exchange_workgroup.wgsl, for disks.

const BATCH: u32 = 8u;

var<workgroup> sh_splats: array<vec4<f32>, 40>;

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
