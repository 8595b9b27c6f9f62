// Without a water surface, disks are seen wherever they are.

fn is_on_side(mean: vec3<f32>) -> bool {
    return true;
}
