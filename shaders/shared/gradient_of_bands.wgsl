// What project_backward starts from where the picture is rendered in bands: one thread a Gaussian of the
// block, and the sums that add_band_gradients left. Flags and counters are those of the whole picture. Needs
// frame, counters, gaussian, splat.

@group(0) @binding(5) var<storage, read> band_gradients: array<vec4<f32>>;

const NONE: u32 = 0xffffffffu;

struct Gathered {
    i: u32,
    sum: Splat,
}

fn gather(thread: u32) -> Gathered {
    // A band that overflowed leaves the sums unfinished.
    if thread >= block.count || counters[OVERFLOW] != 0u {
        return Gathered(NONE, Splat(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0)));
    }
    let at = 3u * thread;
    return Gathered(thread, Splat(band_gradients[at], band_gradients[at + 1u], band_gradients[at + 2u]));
}
