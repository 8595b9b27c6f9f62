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

fn shared_splat(i: u32) -> Splat {
    return Splat(from_lane(mine.a, i), from_lane(mine.b, i), from_lane(mine.c, i), from_lane(mine.d, i), from_lane(mine.e, i));
}
