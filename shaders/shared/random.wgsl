// Counter-based random bits: PCG3D (Jarzynski and Olano, JCGT 2020), two rounds. Twin: core/src/rng.rs.

const STREAM_MEAN_NOISE: u32 = 3u;
const STREAM_SPLIT: u32 = 7u;

fn pcg3d(v_in: vec3<u32>) -> vec3<u32> {
    var v = v_in * 1664525u + vec3<u32>(1013904223u);
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v ^= v >> vec3<u32>(16u);
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    return v;
}

fn random_bits(seed: u32, stream: u32, a: u32, b: u32) -> vec3<u32> {
    let v = vec3<u32>(a ^ ((seed << 16u) | (seed >> 16u)), b + seed, (stream * 0x9E3779B9u) ^ seed);
    return pcg3d(pcg3d(v));
}

// Uniform in (0, 1]: never 0, so that its logarithm is finite.
fn uniform_open(bits: u32) -> f32 {
    return (f32(bits >> 8u) + 1.0) * (1.0 / 16777216.0);
}

// Two standard normal numbers from 64 bits (Box and Muller 1958).
fn normal_pair(a: u32, b: u32) -> vec2<f32> {
    let turn = 6.2831853 * uniform_open(b);
    return sqrt(-2.0 * log(uniform_open(a))) * vec2<f32>(cos(turn), sin(turn));
}
