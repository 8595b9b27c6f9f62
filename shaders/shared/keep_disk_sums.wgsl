// Stores the sums of bands of a disk. Needs disk and the array band_gradients.

fn keep_sum(i: u32, sum: Splat) {
    let at = 5u * i;
    band_gradients[at] = sum.a;
    band_gradients[at + 1u] = sum.b;
    band_gradients[at + 2u] = sum.c;
    band_gradients[at + 3u] = sum.d;
    band_gradients[at + 4u] = sum.e;
}
