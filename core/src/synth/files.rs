//! Writes the files of a synthetic scene: a COLMAP binary model and a NumPy archive for depth.

use std::path::Path;

use crate::picture::encode_npy;
use crate::scene::{CameraModel, PinholeCamera, Pose};
use crate::{CoreError, Result};

use super::points::SparsePoint;

/// Builds little-endian bytes.
#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn u8s(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }
    fn u16(&mut self, v: u16) -> &mut Self {
        self.u8s(&v.to_le_bytes())
    }
    fn u32(&mut self, v: u32) -> &mut Self {
        self.u8s(&v.to_le_bytes())
    }
    fn u64(&mut self, v: u64) -> &mut Self {
        self.u8s(&v.to_le_bytes())
    }
    fn f64s(&mut self, values: &[f64]) -> &mut Self {
        for v in values {
            self.u8s(&v.to_le_bytes());
        }
        self
    }
}

/// Writes `cameras.bin`, `images.bin` and `points3D.bin` (COLMAP's `reconstruction_io_binary.cc`).
///
/// Ids count from 1. The observations of `points` become the 2D points of the images.
pub(super) fn write_colmap(
    folder: &Path,
    camera: &PinholeCamera,
    names: &[String],
    poses: &[Pose],
    points: &[SparsePoint],
) -> Result<()> {
    let mut cameras = Bytes::default();
    cameras.u64(1).u32(1).u32(CameraModel::Pinhole as u32);
    cameras.u64(u64::from(camera.width)).u64(u64::from(camera.height));
    cameras.f64s(&[camera.fx, camera.fy, camera.cx, camera.cy]);
    write(&folder.join("cameras.bin"), &cameras.0)?;

    let mut seen = vec![Vec::new(); poses.len()];
    let mut cloud = Bytes::default();
    cloud.u64(points.len() as u64);
    for (id, point) in (1_u64..).zip(points) {
        cloud.u64(id).f64s(&point.position.to_array()).u8s(&point.colour);
        cloud.f64s(&[point.error_px]).u64(point.track.len() as u64);
        for &(view, pixel) in &point.track {
            let observations = &mut seen[view as usize];
            cloud.u32(view + 1).u32(observations.len() as u32);
            observations.push((pixel, id));
        }
    }
    write(&folder.join("points3D.bin"), &cloud.0)?;

    let mut images = Bytes::default();
    images.u64(poses.len() as u64);
    for (index, (name, pose)) in names.iter().zip(poses).enumerate() {
        let q = pose.rotation;
        images.u32(index as u32 + 1).f64s(&[q.w, q.x, q.y, q.z]).f64s(&pose.translation.to_array());
        images.u32(1).u8s(name.as_bytes()).u8s(&[0]).u64(seen[index].len() as u64);
        for &(pixel, id) in &seen[index] {
            images.f64s(&pixel).u64(id);
        }
    }
    write(&folder.join("images.bin"), &images.0)
}

/// Writes an `.npz`: a ZIP archive of stored `.npy` members, each an f32 array [height, width].
///
/// `numpy.load(path)[name]` reads a member, which is written by [`encode_npy`].
pub(super) fn write_npz(path: &Path, width: u32, height: u32, members: &[(String, Vec<f32>)]) -> Result<()> {
    let (mut archive, mut directory) = (Bytes::default(), Bytes::default());
    for (name, values) in members {
        let npy = encode_npy(width, height, values);
        let file = format!("{name}.npy");
        let size = npy.len() as u32;
        // Version 2.0, no flags, stored, 1 January 1980, so that the bytes do not depend on the time of
        // writing.
        let mut common = Bytes::default();
        common.u16(20).u16(0).u16(0).u16(0).u16(0x21).u32(crc32(&npy)).u32(size).u32(size);
        common.u16(file.len() as u16).u16(0);
        directory.u32(0x0201_4b50).u16(20).u8s(&common.0).u16(0).u16(0).u16(0).u32(0);
        directory.u32(archive.0.len() as u32).u8s(file.as_bytes());
        archive.u32(0x0403_4b50).u8s(&common.0).u8s(file.as_bytes()).u8s(&npy);
    }
    let begin = archive.0.len() as u32;
    let count = members.len() as u16;
    archive.u8s(&directory.0);
    archive.u32(0x0605_4b50).u16(0).u16(0).u16(count).u16(count);
    archive.u32(directory.0.len() as u32).u32(begin).u16(0);
    write(path, &archive.0)
}

pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(path, bytes).map_err(CoreError::io("write", path))
}

/// CRC-32 as in ZIP (reflected polynomial 0xEDB88320).
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |mut crc, &byte| {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg());
        }
        crc
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_of_the_standard_text_is_the_standard_one() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }
}
