// As exchange_vector.wgsl, for disks.

const BATCH: u32 = 8u;

var<private> mine: Splat;

fn share_splats(lane: u32, first: u32, last: u32) {
    mine = NOTHING;
    if first + lane < last {
        let at = 3u * visible_from_slot[slots[first + lane]];
        mine = Splat(disks[at], disks[at + 1u], disks[at + 2u], projected[at + 1u], projected[at + 2u]);
    }
}

// Callers pass a constant, so that the compiler keeps a single case.
fn from_lane(v: vec4<f32>, i: u32) -> vec4<f32> {
    switch i {
        case 0u: { return subgroupBroadcast(v, 0u); }
        case 1u: { return subgroupBroadcast(v, 1u); }
        case 2u: { return subgroupBroadcast(v, 2u); }
        case 3u: { return subgroupBroadcast(v, 3u); }
        case 4u: { return subgroupBroadcast(v, 4u); }
        case 5u: { return subgroupBroadcast(v, 5u); }
        case 6u: { return subgroupBroadcast(v, 6u); }
        default: { return subgroupBroadcast(v, 7u); }
    }
}

fn shared_splat(i: u32) -> Splat {
    return Splat(from_lane(mine.a, i), from_lane(mine.b, i), from_lane(mine.c, i), from_lane(mine.d, i), from_lane(mine.e, i));
}

fn any_thread(lane: u32, yes: bool) -> bool {
    return subgroupAny(yes);
}

fn greatest(lane: u32, number: u32) -> u32 {
    return subgroupMax(number);
}
