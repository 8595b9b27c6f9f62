// The gradient w.r.t. the blended colour of a Gaussian, from the sums that add_band_gradients wrote.

@group(0) @binding(5) var<storage, read> band_gradients: array<vec4<f32>>;

fn v_colour(i: u32) -> vec3<f32> {
    return band_gradients[3u * i + 2u].xyz;
}
