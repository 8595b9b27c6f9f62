// The gradients of a disk in one slot. Needs disk and the array slot_gradients.

fn added(sum: Splat, s: u32) -> Splat {
    let at = 5u * s;
    return Splat(sum.a + slot_gradients[at], sum.b + slot_gradients[at + 1u], sum.c + slot_gradients[at + 2u],
        sum.d + slot_gradients[at + 3u], sum.e + slot_gradients[at + 4u]);
}
