// The gradients of a splat in one slot. Needs splat and the array slot_gradients.

fn added(sum: Splat, s: u32) -> Splat {
    return Splat(sum.a + slot_gradients[3u * s], sum.b + slot_gradients[3u * s + 1u], sum.c + slot_gradients[3u * s + 2u]);
}
