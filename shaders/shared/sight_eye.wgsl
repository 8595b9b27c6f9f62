// Lines of sight that begin at the eye. Needs frame.

// Where the line of sight to a Gaussian begins, world axes.
fn sight_of(mean: vec3<f32>) -> vec3<f32> {
    return frame.eye;
}

// The gradient of the Gaussian from that of its offset from there.
fn sight_pulled(mean: vec3<f32>, v_offset: vec3<f32>) -> vec3<f32> {
    return v_offset;
}
