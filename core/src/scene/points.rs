//! Sparse points and their form on the wire.
//!
//! Layout of [`Points::to_bytes`], little-endian, no padding:
//! ```text
//! 0   8 bytes   "FTHMPTS1"
//! 8   u64       N, the number of points
//! 16  N times   f32 x, f32 y, f32 z, u8 r, u8 g, u8 b    (15 bytes)
//! ```
//! The same points give the same bytes, so the digest of the bytes names them.

use glam::DVec3;

use super::Points;
use crate::{CoreError, Result};

const MAGIC: &[u8; 8] = b"FTHMPTS1";
const HEADER_BYTES: usize = 16;
const POINT_BYTES: usize = 15;

impl Points {
    /// Room for `count` points.
    pub fn with_capacity(count: usize) -> Self {
        Self { positions: Vec::with_capacity(count), colours: Vec::with_capacity(count) }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Adds a point unless one of its coordinates is not finite as f32; says whether it did.
    pub fn push(&mut self, position: [f64; 3], colour: [u8; 3]) -> bool {
        let position = position.map(|value| value as f32);
        let finite = position.iter().all(|value| value.is_finite());
        if finite {
            self.positions.push(position);
            self.colours.push(colour);
        }
        finite
    }

    /// The binary form, described at the head of this file.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_BYTES + self.len() * POINT_BYTES);
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&(self.len() as u64).to_le_bytes());
        for (position, colour) in self.positions.iter().zip(&self.colours) {
            for value in position {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
            bytes.extend_from_slice(colour);
        }
        bytes
    }

    /// The points of [`Points::to_bytes`].
    ///
    /// # Errors
    /// When the bytes are not of this layout, are torn, or hold a coordinate that is not finite.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let refuse = |message: String| CoreError::Scene(format!("sparse points: {message}"));
        if bytes.get(..8) != Some(MAGIC) {
            return Err(refuse("the bytes do not start with \"FTHMPTS1\"".to_owned()));
        }
        let Some(count) = bytes.get(8..16).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes) else {
            return Err(refuse(format!("{} bytes are too few for a header of 16", bytes.len())));
        };
        let body = &bytes[HEADER_BYTES..];
        if count.checked_mul(POINT_BYTES as u64) != Some(body.len() as u64) {
            return Err(refuse(format!(
                "the header says {count} points of {POINT_BYTES} bytes, but {} bytes follow",
                body.len()
            )));
        }
        let mut points = Self::with_capacity(count as usize);
        for (index, entry) in body.chunks_exact(POINT_BYTES).enumerate() {
            let axis =
                |at: usize| f32::from_le_bytes([entry[at], entry[at + 1], entry[at + 2], entry[at + 3]]);
            let position = [axis(0), axis(4), axis(8)];
            if !points.push(position.map(f64::from), [entry[12], entry[13], entry[14]]) {
                return Err(refuse(format!("point {index} is not finite")));
            }
        }
        Ok(points)
    }
}

/// 1.1 times the largest distance of a centre from their mean: the extent that 3DGS scales learning rates by.
///
/// 0 for one centre or none, so nothing may be divided by it.
pub fn extent(centres: &[DVec3]) -> f64 {
    let mean = centres.iter().sum::<DVec3>() / (centres.len().max(1)) as f64;
    1.1 * centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    #![expect(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;

    fn sample() -> Points {
        Points {
            positions: vec![[1.0, -2.5, 3.25], [f32::MAX, f32::MIN_POSITIVE, -0.0]],
            colours: vec![[0, 127, 255], [9, 8, 7]],
        }
    }

    #[test]
    fn points_survive_the_way_through_bytes() {
        let bytes = sample().to_bytes();
        assert_eq!(bytes.len(), 16 + 2 * 15);
        assert_eq!(Points::from_bytes(&bytes).unwrap(), sample());
        assert_eq!(Points::from_bytes(&Points::default().to_bytes()).unwrap(), Points::default());
    }

    #[test]
    fn torn_or_foreign_bytes_are_refused() {
        let bytes = sample().to_bytes();
        for len in 0..bytes.len() {
            assert!(Points::from_bytes(&bytes[..len]).is_err(), "{len} of {} bytes passed", bytes.len());
        }
        let mut absurd = bytes.clone();
        absurd[8..16].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(Points::from_bytes(&absurd).unwrap_err().to_string().contains("18446744073709551615 points"));
        let mut nan = bytes;
        nan[16..20].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(Points::from_bytes(&nan).unwrap_err().to_string().contains("point 0 is not finite"));
    }

    #[test]
    fn the_extent_is_a_tenth_above_the_farthest_camera() {
        let centres = [DVec3::new(0.0, 0.0, 0.0), DVec3::new(4.0, 0.0, 0.0), DVec3::new(2.0, 0.0, 0.0)];
        assert!((extent(&centres) - 2.2).abs() < 1e-12);
        assert_eq!(extent(&[]), 0.0);
    }
}
