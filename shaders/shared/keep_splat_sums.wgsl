// Stores the sums of bands of a splat. Needs splat and the array band_gradients.

fn keep_sum(i: u32, sum: Splat) {
    band_gradients[3u * i] = sum.a;
    band_gradients[3u * i + 1u] = sum.b;
    band_gradients[3u * i + 2u] = sum.c;
}
