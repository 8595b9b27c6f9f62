// The surface of the expected range, in the camera's frame. Needs frame and the names frame, image and
// range_image.

struct Normals {
    // Weight of the loss, per pixel.
    weight: f32,
    // A pixel takes part if its alpha and those of its four neighbours are at least this.
    least_alpha: f32,
    pad_a: f32,
    pad_b: f32,
}

// Unit direction of the ray of pixel i, camera axes.
fn ray_of(i: u32) -> vec3<f32> {
    let columns = max(frame.size.x, 1u);
    let at = vec2<f32>(f32(i % columns), f32(i / columns)) + 0.5;
    return normalize(vec3<f32>((at - frame.principal) / frame.focal, 1.0));
}

// Where the ray of pixel i ends, scene units.
fn end_of(i: u32) -> vec3<f32> {
    return (range_image[i] / max(image[i].w, 1e-6)) * ray_of(i);
}
