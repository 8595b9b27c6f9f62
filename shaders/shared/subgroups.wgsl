// Ranks inside a subgroup of 8 to 128 lanes, for the stages written with subgroups.

// Mask of the lanes before `lane`.
fn lanes_before(lane: u32) -> vec4<u32> {
    let words = vec4<u32>(0u, 32u, 64u, 96u);
    let inside = clamp(vec4<u32>(lane), words, words + vec4<u32>(31u)) - words;
    let part = (vec4<u32>(1u) << inside) - vec4<u32>(1u);
    return select(part, vec4<u32>(0xffffffffu), vec4<u32>(lane) > words + vec4<u32>(31u));
}

fn ones(mask: vec4<u32>) -> u32 {
    let n = countOneBits(mask);
    return n.x + n.y + n.z + n.w;
}

// The first lane of a non-empty mask.
fn first_lane(mask: vec4<u32>) -> u32 {
    if mask.x != 0u { return firstTrailingBit(mask.x); }
    if mask.y != 0u { return 32u + firstTrailingBit(mask.y); }
    if mask.z != 0u { return 64u + firstTrailingBit(mask.z); }
    return 96u + firstTrailingBit(mask.w);
}

// The lanes whose key has the digit of this lane; empty if `valid` is false. All lanes must reach this call.
fn same_digit(digit: u32, valid: bool) -> vec4<u32> {
    var mask = subgroupBallot(valid);
    for (var bit = 0u; bit < 6u; bit++) {
        let is_set = ((digit >> bit) & 1u) == 1u;
        let with_bit = subgroupBallot(is_set);
        mask &= select(~with_bit, with_bit, is_set);
    }
    return select(vec4<u32>(0u), mask, valid);
}
