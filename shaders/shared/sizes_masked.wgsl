// Sizes of disks, and how much of them is part of the scene above water. Needs gaussian.

fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, log_scale.y);
}

// The third number of a disk is the logit of its mask.
fn seen_opacity(mean: vec3<f32>, opacity: f32, log_scale: vec3<f32>) -> f32 {
    return opacity * sigmoid(log_scale.z);
}

// Of a disk among those that may be split: disks that refracted light replaces need no detail.
fn weight_of(log_scale: vec3<f32>) -> f32 {
    return sigmoid(log_scale.z);
}
