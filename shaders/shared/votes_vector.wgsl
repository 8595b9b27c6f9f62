// What the threads of a tile find together, and how one reads what another holds, when they are the eight
// lanes of one vector.

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

fn any_thread(lane: u32, yes: bool) -> bool {
    return subgroupAny(yes);
}

fn greatest(lane: u32, number: u32) -> u32 {
    return subgroupMax(number);
}

fn union_of(lane: u32, bits: u32) -> u32 {
    return subgroupOr(bits);
}

// The lanes of a vector read and write together.
fn before_reads() {}
