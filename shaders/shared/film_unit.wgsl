// A hidden unit of the view embedding (film.wgsl). Needs film and the names film, weights, embeddings.

struct Unit {
    // a, s and 1 + gamma.
    plain: f32,
    modulated: f32,
    gain: f32,
}

fn unit_of(j: u32, mean: vec3<f32>) -> Unit {
    let plain = dot(weights[2u * j], vec4<f32>(mean, 1.0));
    let embedding = embeddings[HIDDEN * film.view + j];
    let gain = 1.0 + embedding.x;
    return Unit(plain, plain * gain + embedding.y, gain);
}

// What the embedding adds to the output of a unit, before W2.
fn added(unit: Unit) -> f32 {
    return max(unit.modulated, 0.0) - max(unit.plain, 0.0);
}
