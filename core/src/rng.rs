//! Random numbers as a pure function of (seed, stream, counter). They do not depend on threads, on order or
//! on interruptions of a run.

/// The purpose of a stream of random numbers; two purposes never share numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Stream {
    /// Order of the views in an epoch.
    ViewOrder = 1,
    /// Which Gaussians are split.
    Densify = 2,
    /// Noise on the means; the same numbers are made in WGSL.
    MeanNoise = 3,
    /// The synthetic scene.
    Synth = 4,
    /// Tests.
    Test = 5,
    /// Background colour of an iteration.
    Background = 6,
    /// Positions of the two halves when classic density control splits a Gaussian; the same numbers are made
    /// in WGSL.
    Split = 7,
    /// First weights of the networks.
    Networks = 8,
    /// First weights of the view embeddings.
    Film = 9,
    /// Which views an epoch has if views are weighted.
    ViewSample = 10,
    /// Directions of disks at the start.
    Turn = 11,
    /// Disks of the reflected set at the start.
    Sets = 12,
}

/// 32 random bits for (seed, stream, a, b): PCG3D of Jarzynski and Olano (JCGT 2020), two rounds.
///
/// Twin of `random_bits` in `shaders/shared/random.wgsl`; integers only, so both give the same bits.
pub fn random_bits(seed: u32, stream: Stream, a: u32, b: u32) -> [u32; 3] {
    let mut v =
        [a ^ seed.rotate_left(16), b.wrapping_add(seed), (stream as u32).wrapping_mul(0x9E37_79B9) ^ seed];
    for _ in 0..2 {
        v = pcg3d(v);
    }
    v
}

fn pcg3d(v: [u32; 3]) -> [u32; 3] {
    let [mut x, mut y, mut z] = v.map(|w| w.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    x ^= x >> 16;
    y ^= y >> 16;
    z ^= z >> 16;
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    [x, y, z]
}

/// Uniform in [0, 1) from the upper 24 bits.
pub fn uniform(bits: u32) -> f32 {
    (bits >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Uniform in [0, 1) for (seed, stream, a, b).
pub fn uniform_at(seed: u32, stream: Stream, a: u32, b: u32) -> f32 {
    uniform(random_bits(seed, stream, a, b)[0])
}

/// The numbers 0..n in an order that depends on (seed, stream, a) only (Fisher-Yates).
pub fn permutation(seed: u32, stream: Stream, a: u32, n: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n as u32).collect();
    for i in (1..n).rev() {
        let [bits, ..] = random_bits(seed, stream, a, i as u32);
        // Multiply-shift: unbiased to 2^-32 * n, and without a division.
        let j = ((u64::from(bits) * (i as u64 + 1)) >> 32) as usize;
        order.swap(i, j);
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_permutation_holds_every_number_once_and_depends_on_its_key() {
        let mut first = permutation(7, Stream::ViewOrder, 0, 1000);
        let other = permutation(7, Stream::ViewOrder, 1, 1000);
        assert_ne!(first, other);
        assert_eq!(first, permutation(7, Stream::ViewOrder, 0, 1000));
        first.sort_unstable();
        assert!(first.iter().enumerate().all(|(i, &v)| v == i as u32));
    }

    #[test]
    fn uniform_numbers_have_the_expected_mean_and_variance() {
        let n = 100_000;
        let values: Vec<f64> = (0..n).map(|i| f64::from(uniform_at(1, Stream::Test, i, i / 7))).collect();
        let mean = values.iter().sum::<f64>() / f64::from(n);
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / f64::from(n);
        // Three standard errors of the mean of n uniform numbers: 3 * sqrt(1/12/n) = 0.0027.
        assert!((mean - 0.5).abs() < 0.0027, "mean {mean}");
        assert!((variance - 1.0 / 12.0).abs() < 0.001, "variance {variance}");
    }
}
