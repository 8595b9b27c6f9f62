// The sums of bands of a disk. Needs disk and the array band_gradients.

fn sum_of(i: u32) -> Splat {
    let at = 5u * i;
    return Splat(band_gradients[at], band_gradients[at + 1u], band_gradients[at + 2u], band_gradients[at + 3u],
        band_gradients[at + 4u]);
}
