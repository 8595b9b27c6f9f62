// Input of project_backward when the image is rendered in bands: one thread per Gaussian of the block, and
// the sums that add_band_gradients wrote. Flags and counters are those of the whole image. Needs frame,
// counters, gaussian, splat_sums or disk_sums.

@group(0) @binding(5) var<storage, read> band_gradients: array<vec4<f32>>;

const NONE: u32 = 0xffffffffu;

struct Gathered {
    i: u32,
    sum: Splat,
}

fn gather(thread: u32) -> Gathered {
    // If a band overflowed, the sums are incomplete.
    if thread >= block.count || counters[OVERFLOW] != 0u {
        return Gathered(NONE, NOTHING);
    }
    return Gathered(thread, sum_of(thread));
}
