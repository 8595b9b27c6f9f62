// The gradient of a visible Gaussian from its slots. Needs frame, counters, gaussian, splat or disk,
// their rows, and the names block, counters, flags.

@group(0) @binding(5) var<storage, read> gaussian_from_visible: array<u32>;
@group(0) @binding(6) var<storage, read> segments: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> slot_gradients: array<vec4<f32>>;

// Visible id of the `thread`-th visible Gaussian of the block; NONE after the last.
fn visible_of_thread(thread: u32) -> u32 {
    let start = flags[block.base];
    var end = counters[VISIBLE];
    if block.base + block.count < veiled(frame.gaussians, arrayLength(&flags)) {
        end = flags[block.base + block.count];
    }
    return select(NONE, start + thread, start + thread < end);
}

const NONE: u32 = 0xffffffffu;

// `start` plus the slots of a segment, added in their order.
fn add_slots(segment: vec2<u32>, start: Splat) -> Splat {
    var sum = start;
    for (var s = segment.x; s < segment.x + segment.y; s++) {
        sum = added(sum, s);
    }
    return sum;
}
