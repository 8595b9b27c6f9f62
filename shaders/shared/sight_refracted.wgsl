// Lines of sight under water: they begin where light from the disk leaves it. Needs frame, projection,
// surface.

@group(0) @binding(12) var<uniform> surface: Surface;

fn crossing_at(m: vec3<f32>) -> Crossing {
    return crossing_of(level_of(frame, surface), surface.eta, m);
}

// From the camera's axes to the world's.
fn from_camera(v: vec3<f32>) -> vec3<f32> {
    return v.x * frame.view_x.xyz + v.y * frame.view_y.xyz + v.z * frame.view_z.xyz;
}

// Where the line of sight to a disk begins, world axes.
fn sight_of(mean: vec3<f32>) -> vec3<f32> {
    return frame.eye + from_camera(crossing_at(to_camera(frame, mean)).at);
}

// The gradient of the disk from that of its offset from there, both in world axes.
fn sight_pulled(mean: vec3<f32>, v_offset: vec3<f32>) -> vec3<f32> {
    let v = vec3<f32>(dot(frame.view_x.xyz, v_offset), dot(frame.view_y.xyz, v_offset), dot(frame.view_z.xyz, v_offset));
    return v_offset - from_camera(pulled_crossing(crossing_at(to_camera(frame, mean)), v));
}
