//! COLMAP's `cameras.bin`, `images.bin` and `points3D.bin` (`scene/reconstruction_io_binary.cc`).
//!
//! All files are little-endian and start with a u64 count. Rigs and frames (COLMAP 3.12 and later) are
//! ignored: `images.bin` still holds each image's own pose. Of the 2D points those that belong to a point are
//! held in memory until its track is read.

use std::path::Path;

use super::bytes::ByteReader;
use super::colmap::{Lenses, RawImage, RawPoints, image_pose};
use super::{Camera, CameraModel, Points};
use crate::Result;

pub(super) fn read_cameras(path: &Path) -> Result<Vec<Camera>> {
    let mut file = ByteReader::open(path)?;
    let header = || "the number of cameras".to_owned();
    let count = file.count(24, "cameras", &header)?;
    let mut cameras = Vec::with_capacity(count);
    for index in 0..count {
        let what = || format!("camera {} of {count}", index + 1);
        let start = file.offset();
        let id = file.u32(&what)?;
        let number = file.u32(&what)?;
        let Some(model) = CameraModel::from_number(number) else {
            return Err(file.fault(
                start,
                &format!(
                    "camera {id} has the unknown camera model number {number}; Fathom knows 0 to 17 of \
                     COLMAP 4.1, so the file is damaged or of a newer COLMAP (undistort it with \
                     `colmap image_undistorter`)"
                ),
            ));
        };
        let (width, height) = (file.u64(&what)?, file.u64(&what)?);
        let mut params = Vec::with_capacity(model.param_count());
        for _ in 0..model.param_count() {
            params.push(file.f64s::<1>(&what)?[0]);
        }
        let camera = Camera {
            id,
            model,
            width: u32::try_from(width).unwrap_or(u32::MAX),
            height: u32::try_from(height).unwrap_or(u32::MAX),
            params,
        };
        camera.check().map_err(|message| file.fault(start, &message))?;
        cameras.push(camera);
    }
    file.finish(count, "cameras")?;
    Ok(cameras)
}

/// The number of images in the header of `images.bin`.
pub(super) fn image_count(path: &Path) -> Result<u64> {
    ByteReader::open(path)?.u64(&|| "the number of images".to_owned())
}

pub(super) fn read_images(path: &Path, lenses: &Lenses) -> Result<Vec<RawImage>> {
    let mut file = ByteReader::open(path)?;
    let count = file.count(73, "images", &|| "the number of images".to_owned())?;
    let mut images = Vec::with_capacity(count);
    for index in 0..count {
        let what = || format!("image {} of {count}", index + 1);
        let start = file.offset();
        let id = file.u32(&what)?;
        let quat_wxyz = file.f64s::<4>(&what)?;
        let translation = file.f64s::<3>(&what)?;
        let camera_id = file.u32(&what)?;
        let name = file.c_string(&|| format!("the name of image {} of {count}", index + 1))?;
        let pose =
            image_pose(&name, quat_wxyz, translation).map_err(|message| file.fault(start, &message))?;
        let points = || format!("the 2D points of image {} of {count} ({name})", index + 1);
        let count = file.count(24, "2D points", &points)?;
        let mut seen = Vec::new();
        for index in 0..count {
            let pixel = file.f64s::<2>(&points)?;
            let has_point = file.u64(&points)? != u64::MAX;
            if has_point && let Ok(index) = u32::try_from(index) {
                seen.push((index, lenses.place(camera_id, pixel)));
            }
        }
        images.push(RawImage { id, name, camera_id, pose, place: format!("byte {start}"), seen });
    }
    file.finish(count, "images")?;
    Ok(images)
}

pub(super) fn read_points(path: &Path, into: &mut RawPoints<'_>) -> Result<()> {
    let mut file = ByteReader::open(path)?;
    let count = file.count(51, "points", &|| "the number of points".to_owned())?;
    into.points = Points::with_capacity(count);
    for index in 0..count {
        let what = || format!("point {} of {count}", index + 1);
        let _point_id = file.u64(&what)?;
        let position = file.f64s::<3>(&what)?;
        let colour = file.bytes::<3>(&what)?;
        let _reprojection_error = file.f64s::<1>(&what)?;
        let track = || format!("the track of point {} of {count}", index + 1);
        let seen = file.count(8, "observations", &track)?;
        for _ in 0..seen {
            let (image_id, index) = (file.u32(&track)?, file.u32(&track)?);
            into.see(image_id, index);
        }
        into.push(position, colour);
    }
    file.finish(count, "points")
}
