//! The `cameras.json` that 3DGS writes beside a model: poses and intrinsics, no points.
//!
//! `rotation` is camera to world, row by row, with COLMAP's axes; `position` is the camera's centre. 3DGS
//! does not store the principal point, so the middle is used. Files of Fathom store it (`cx`, `cy`).

use std::path::Path;

use glam::{DMat3, DVec3};
use serde::Deserialize;

use super::assemble::{Draft, DraftView};
use super::distinct::DistinctCameras;
use super::files::name_of;
use super::nerfstudio::rigid_pose;
use super::{Camera, CameraModel, Points, Purpose};
use crate::{CoreError, Result};

#[derive(Deserialize)]
struct Entry {
    img_name: String,
    width: u32,
    height: u32,
    position: [f64; 3],
    rotation: [[f64; 3]; 3],
    fx: f64,
    fy: f64,
    cx: Option<f64>,
    cy: Option<f64>,
}

pub(super) fn read(root: &Path, file: &Path, purpose: Purpose) -> Result<Draft> {
    if purpose == Purpose::Train {
        return Err(CoreError::input(
            file,
            "a cameras.json has no sparse points, so nothing can be trained from it; \
             give the COLMAP or nerfstudio folder that it was made from",
        ));
    }
    let bytes = std::fs::read(file).map_err(CoreError::io("read", file))?;
    let entries: Vec<Entry> = serde_json::from_slice(&bytes)
        .map_err(|error| CoreError::input(file, format!("not a cameras.json of 3DGS: {error}")))?;
    let mut cameras = DistinctCameras::default();
    let mut views = Vec::with_capacity(entries.len());
    for (index, entry) in entries.into_iter().enumerate() {
        let place = format!("entry {index}");
        let refuse = |message: String| {
            CoreError::input(file, format!("{place}: image \"{}\": {message}", entry.img_name))
        };
        let middle = [f64::from(entry.width) / 2.0, f64::from(entry.height) / 2.0];
        let (cx, cy) = (entry.cx.unwrap_or(middle[0]), entry.cy.unwrap_or(middle[1]));
        let params = vec![entry.fx, entry.fy, cx, cy];
        let (width, height) = (entry.width, entry.height);
        let camera = Camera { id: 0, model: CameraModel::Pinhole, width, height, params };
        let camera_id = cameras.id_of(camera).map_err(refuse)?;
        let [r0, r1, r2] = entry.rotation.map(DVec3::from);
        let axes = DMat3::from_cols(r0, r1, r2).transpose();
        let pose = rigid_pose(axes, entry.position.into(), DVec3::ONE)
            .map_err(|message| refuse(format!("rotation or position {message}")))?;
        let name = name_of(&entry.img_name);
        views.push(DraftView {
            file: name.clone().into(),
            name,
            listed_at: index as u32,
            camera_id,
            pose,
            mask: None,
            place,
        });
    }
    let folder = file.parent().unwrap_or(root);
    Ok(Draft {
        source: "cameras.json",
        root: root.to_owned(),
        cameras_file: file.to_owned(),
        views_file: file.to_owned(),
        points_file: file.to_owned(),
        image_folders: vec![folder.join("images"), folder.to_owned()],
        cameras: cameras.into_cameras(),
        views,
        points: Points::default(),
        warnings: Vec::new(),
    })
}
