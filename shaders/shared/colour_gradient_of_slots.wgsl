// The gradient w.r.t. the blended colour of a Gaussian, from its slots. Needs frame, counters, gaussian and
// the names block, counters, flags.

@group(0) @binding(6) var<storage, read> segments: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> slot_gradients: array<vec4<f32>>;

// Zero for a Gaussian that the view does not see.
fn v_colour(i: u32) -> vec3<f32> {
    var v = vec3<f32>(0.0);
    let visible_id = flags[block.base + i];
    var next = counters[VISIBLE];
    if block.base + i + 1u < veiled(frame.gaussians, arrayLength(&flags)) {
        next = flags[block.base + i + 1u];
    }
    if next != visible_id {
        let segment = segments[visible_id];
        for (var s = segment.x; s < segment.x + segment.y; s++) {
            v += slot_gradients[3u * s + 2u].xyz;
        }
    }
    return v;
}
