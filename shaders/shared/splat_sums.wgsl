// The sums of bands of a splat. Needs splat and the array band_gradients.

fn sum_of(i: u32) -> Splat {
    return Splat(band_gradients[3u * i], band_gradients[3u * i + 1u], band_gradients[3u * i + 2u]);
}
