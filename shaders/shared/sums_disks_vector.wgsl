// As sums_vector.wgsl, for disks. Needs the name HAS_MAPS.

var<private> mine_sums: Splat;

// The sum over the lanes, in lane order.
fn over_lanes(v: vec4<f32>) -> vec4<f32> {
    return (((((((subgroupBroadcast(v, 0u) + subgroupBroadcast(v, 1u)) + subgroupBroadcast(v, 2u)) + subgroupBroadcast(v, 3u))
        + subgroupBroadcast(v, 4u)) + subgroupBroadcast(v, 5u)) + subgroupBroadcast(v, 6u)) + subgroupBroadcast(v, 7u));
}

// Lane i keeps the sums of disk i.
fn give_sums(lane: u32, i: u32, sums: Splat) {
    let keep = vec4<bool>(lane == i);
    mine_sums.a = select(mine_sums.a, over_lanes(sums.a), keep);
    mine_sums.b = select(mine_sums.b, over_lanes(sums.b), keep);
    mine_sums.c = select(mine_sums.c, over_lanes(sums.c), keep);
    if HAS_MAPS {
        mine_sums.d = select(mine_sums.d, over_lanes(sums.d), keep);
        mine_sums.e = select(mine_sums.e, over_lanes(sums.e), keep);
    } else {
        let others = over_lanes(vec4<f32>(sums.e.xyz, sums.d.w));
        mine_sums.d.w = select(mine_sums.d.w, others.w, lane == i);
        mine_sums.e = select(mine_sums.e, vec4<f32>(others.xyz, 0.0), keep);
    }
}

// Called for both halves of a batch; the second writes.
fn write_sums(lane: u32, first: u32, half: u32, last: u32) {
    if half == 1u && first + lane < last {
        let at = 5u * slots[first + lane];
        slot_gradients[at] = mine_sums.a;
        slot_gradients[at + 1u] = mine_sums.b;
        slot_gradients[at + 2u] = mine_sums.c;
        slot_gradients[at + 3u] = mine_sums.d;
        slot_gradients[at + 4u] = mine_sums.e;
    }
}
