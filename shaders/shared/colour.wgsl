// The colour of a Gaussian from its spherical harmonics (3DGS). Needs frame, harmonics and the names block,
// sh_coeffs.

// 0.5 + sum of coefficient * basis(direction), before the clamp at 0.
fn colour(i: u32, direction: vec3<f32>) -> vec3<f32> {
    let degree = veiled(frame.sh_degree, arrayLength(&sh_coeffs));
    let b = basis(degree, direction);
    var rgb = vec3<f32>(0.5);
    let at = i * block.sh_stride;
    for (var g = 0u; g < coefficient_groups(degree); g++) {
        let v0 = sh_coeffs[at + 3u * g];
        let v1 = sh_coeffs[at + 3u * g + 1u];
        let v2 = sh_coeffs[at + 3u * g + 2u];
        let w = basis_vec(b, g);
        rgb += w.x * v0.xyz + w.y * vec3<f32>(v0.w, v1.xy) + w.z * vec3<f32>(v1.zw, v2.x) + w.w * v2.yzw;
    }
    return rgb;
}
