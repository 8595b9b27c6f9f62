//! Reads nerfstudio's `transforms.json` (also the format of instant-ngp and of synthetic NeRF data).
//!
//! `transform_matrix` is camera to world with x right, y up, z backward (OpenGL); a [`Pose`] is its inverse
//! with y and z negated. Intrinsics are in the frame or at the top; the frame wins. Distortion coefficients
//! count even without `camera_model`, because files without that key are common.

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;

use super::assemble::{Draft, DraftView};
use super::camera::MAX_COORDINATE;
use super::distinct::DistinctCameras;
use super::files::name_of;
use super::{Camera, CameraModel, Points, Pose, Purpose, Reach, point_cloud};
use crate::paths::check_inside;
use crate::{CoreError, Result, picture};

#[derive(Deserialize)]
struct Transforms {
    frames: Vec<Frame>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
    ply_file_path: Option<String>,
    applied_transform: Option<serde_json::Value>,
    applied_scale: Option<f64>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<Option<f64>>>,
    mask_path: Option<String>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

/// Keys that may be at the top or in a frame. Sizes are floats because some writers write `1080.0`.
#[derive(Clone, Default, Deserialize)]
struct Intrinsics {
    camera_model: Option<String>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

pub(super) fn read(root: &Path, file: &Path, purpose: Purpose, reach: Reach) -> Result<Draft> {
    let bytes = std::fs::read(file).map_err(CoreError::io("read", file))?;
    // Python writes NaN and Infinity, which are not JSON; serde_json then names line and column.
    let transforms: Transforms = serde_json::from_slice(&bytes)
        .map_err(|error| CoreError::input(file, format!("not a usable transforms.json: {error}")))?;
    let folder = file.parent().unwrap_or(root).to_owned();
    if reach == Reach::Inside {
        check_paths(&transforms).map_err(|message| CoreError::input(file, message))?;
    }

    let mut warnings = Vec::new();
    if transforms.applied_transform.is_some() || transforms.applied_scale.is_some_and(|scale| scale != 1.0) {
        warnings.push(format!(
            "{}: applied_transform or applied_scale is set: the model will be in the transformed frame, \
             not in that of the original reconstruction",
            file.display()
        ));
    }
    // For frames without w and h whose photograph is missing: without written sizes, all photographs have one
    // size.
    let some_photograph = transforms
        .frames
        .iter()
        .map(|frame| photograph_path(&folder, &frame.file_path))
        .find(|path| path.is_file());
    let mut cameras = DistinctCameras::default();
    let mut views = Vec::with_capacity(transforms.frames.len());
    for (index, frame) in transforms.frames.iter().enumerate() {
        let place = format!("frames[{index}]");
        let refuse = |message: String| {
            CoreError::input(file, format!("{place}: image \"{}\": {message}", frame.file_path))
        };
        let photograph = photograph_path(&folder, &frame.file_path);
        let intrinsics = frame.intrinsics.or(&transforms.intrinsics);
        let sized =
            if photograph.is_file() { &photograph } else { some_photograph.as_ref().unwrap_or(&photograph) };
        let camera = intrinsics.camera(sized).map_err(refuse)?;
        let camera_id = cameras.id_of(camera).map_err(refuse)?;
        let mask = match frame.mask_path.as_ref().map(|path| folder.join(path)) {
            Some(path) if !path.is_file() && purpose != Purpose::Inspect => {
                return Err(refuse(format!(
                    "its mask {} does not exist; add it or remove mask_path",
                    path.display()
                )));
            }
            mask => mask.filter(|path| path.is_file()),
        };
        let file = photograph.strip_prefix(&folder).unwrap_or(&photograph).to_owned();
        views.push(DraftView {
            name: name_of(file.to_str().unwrap_or_default()),
            listed_at: index as u32,
            file,
            camera_id,
            pose: pose(&frame.transform_matrix).map_err(refuse)?,
            mask,
            place: place.clone(),
        });
    }
    let (points_file, points) =
        read_points(&folder, file, transforms.ply_file_path.as_deref(), &mut warnings)?;
    Ok(Draft {
        source: "nerfstudio",
        root: root.to_owned(),
        cameras_file: file.to_owned(),
        views_file: file.to_owned(),
        points_file,
        image_folders: vec![folder],
        cameras: cameras.into_cameras(),
        views,
        points,
        warnings,
    })
}

/// Refuses paths that leave the folder of the file, and points under another ending: their length is checked
/// by it.
fn check_paths(transforms: &Transforms) -> std::result::Result<(), String> {
    let check = |place: String, path: &str| {
        // Only the beginning of a long path is shown.
        let shown = || path.chars().take(80).collect::<String>();
        check_inside(path.strip_prefix("./").unwrap_or(path)).map_err(|fault| {
            format!("{place} \"{}\" {fault}; every path must be inside the dataset", shown().escape_debug())
        })
    };
    for (index, frame) in transforms.frames.iter().enumerate() {
        check(format!("frames[{index}]: file_path"), &frame.file_path)?;
        if let Some(path) = &frame.mask_path {
            check(format!("frames[{index}]: mask_path"), path)?;
        }
    }
    let Some(path) = &transforms.ply_file_path else { return Ok(()) };
    check("ply_file_path".to_owned(), path)?;
    let is_ply = Path::new(path).extension().is_some_and(|ending| ending.eq_ignore_ascii_case("ply"));
    if is_ply { Ok(()) } else { Err("ply_file_path must end in .ply".to_owned()) }
}

/// The photograph of a frame; without an extension it is a PNG, as in synthetic NeRF data.
fn photograph_path(folder: &Path, file_path: &str) -> PathBuf {
    let path = folder.join(file_path.strip_prefix("./").unwrap_or(file_path));
    if path.extension().is_none() { path.with_extension("png") } else { path }
}

/// The file of the points, and the points.
fn read_points(
    folder: &Path,
    file: &Path,
    ply_file_path: Option<&str>,
    warnings: &mut Vec<String>,
) -> Result<(PathBuf, Points)> {
    let ply = match ply_file_path {
        Some(path) => folder.join(path),
        // nerfstudio's file name; some older versions write the file without the key.
        None => folder.join("sparse_pc.ply"),
    };
    if !ply.is_file() {
        if ply_file_path.is_some() {
            warnings.push(format!(
                "{}: ply_file_path names {}, which does not exist",
                file.display(),
                ply.display()
            ));
        }
        return Ok((file.to_owned(), Points::default()));
    }
    let (points, not_finite) = point_cloud::read(&ply)?;
    if not_finite > 0 {
        warnings.push(format!(
            "{}: {not_finite} points that are not finite or beyond {MAX_COORDINATE:e} are left out",
            ply.display()
        ));
    }
    Ok((ply, points))
}

impl Intrinsics {
    /// Each key from here, otherwise from `fallback`.
    fn or(&self, fallback: &Self) -> Self {
        let (a, b) = (self, fallback);
        Self {
            camera_model: a.camera_model.clone().or_else(|| b.camera_model.clone()),
            w: a.w.or(b.w),
            h: a.h.or(b.h),
            fl_x: a.fl_x.or(b.fl_x),
            fl_y: a.fl_y.or(b.fl_y),
            cx: a.cx.or(b.cx),
            cy: a.cy.or(b.cy),
            camera_angle_x: a.camera_angle_x.or(b.camera_angle_x),
            camera_angle_y: a.camera_angle_y.or(b.camera_angle_y),
            k1: a.k1.or(b.k1),
            k2: a.k2.or(b.k2),
            k3: a.k3.or(b.k3),
            k4: a.k4.or(b.k4),
            p1: a.p1.or(b.p1),
            p2: a.p2.or(b.p2),
        }
    }

    /// The camera, with id 0. Without `w` and `h` the size is that of the photograph.
    fn camera(&self, photograph: &Path) -> Result<Camera, String> {
        let (width, height) = match (self.w, self.h) {
            (Some(w), Some(h)) => (side("w", w)?, side("h", h)?),
            _ => picture::dimensions(photograph).map_err(|error| {
                format!("w and h are not given, and the size of the photograph is unknown: {error}")
            })?,
        };
        let (w, h) = (f64::from(width), f64::from(height));
        let from_angle = |angle: f64, side: f64| 0.5 * side / (0.5 * angle).tan();
        let fx = self
            .fl_x
            .or_else(|| self.camera_angle_x.map(|angle| from_angle(angle, w)))
            .ok_or("neither fl_x nor camera_angle_x is given")?;
        let fy = self.fl_y.or_else(|| self.camera_angle_y.map(|angle| from_angle(angle, h))).unwrap_or(fx);
        let (cx, cy) = (self.cx.unwrap_or(w / 2.0), self.cy.unwrap_or(h / 2.0));
        let [k1, k2, k3, k4] = [self.k1, self.k2, self.k3, self.k4].map(Option::unwrap_or_default);
        let [p1, p2] = [self.p1, self.p2].map(Option::unwrap_or_default);

        let (model, params) = match self.camera_model.as_deref() {
            Some("OPENCV_FISHEYE") => (CameraModel::OpencvFisheye, vec![fx, fy, cx, cy, k1, k2, k3, k4]),
            None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "PERSPECTIVE") => {
                if [k1, k2, k3, k4, p1, p2] == [0.0; 6] {
                    (CameraModel::Pinhole, vec![fx, fy, cx, cy])
                } else if [k3, k4] == [0.0; 2] {
                    (CameraModel::Opencv, vec![fx, fy, cx, cy, k1, k2, p1, p2])
                } else {
                    (CameraModel::Opencv, vec![fx, fy, cx, cy, k1, k2, p1, p2, k3, k4])
                }
            }
            Some(other) => {
                return Err(format!(
                    "the camera_model \"{other}\" is not supported; undistort the pictures to PINHOLE first"
                ));
            }
        };
        Ok(Camera { id: 0, model, width, height, params })
    }
}

fn side(key: &str, value: f64) -> Result<u32, String> {
    if value.fract() == 0.0 && (1.0..=65_535.0).contains(&value) {
        Ok(value as u32)
    } else {
        Err(format!("{key} is {value}; it must be a whole number of pixels between 1 and 65535"))
    }
}

/// World to camera from the matrix of a frame.
fn pose(matrix: &[Vec<Option<f64>>]) -> Result<Pose, String> {
    let shape = matches!(matrix.len(), 3 | 4) && matrix.iter().all(|row| row.len() == 4);
    if !shape {
        return Err("transform_matrix must have 3 or 4 rows of 4 numbers".to_owned());
    }
    // Some writers put null for NaN.
    let entry = |row: usize, column: usize| matrix[row][column].unwrap_or(f64::NAN);
    let column = |index: usize| DVec3::new(entry(0, index), entry(1, index), entry(2, index));
    let rotation = DMat3::from_cols(column(0), column(1), column(2));
    let centre = column(3);
    rigid_pose(rotation, centre, DVec3::new(1.0, -1.0, -1.0))
        .map_err(|message| format!("transform_matrix {message}"))
}

/// World to camera from camera axes in world coordinates (columns) and the camera's centre. `signs` flips
/// axes.
///
/// A common scale of the axes is removed; any other deviation from a rotation is refused.
pub(super) fn rigid_pose(axes: DMat3, centre: DVec3, signs: DVec3) -> Result<Pose, String> {
    if !axes.is_finite() || !centre.is_finite() {
        return Err(
            "holds a number that is not finite; remove the image or compute its pose again".to_owned()
        );
    }
    let scale = axes.determinant().cbrt();
    let rigid = scale > 1e-9 && {
        let gram = (axes.transpose() * axes) * (1.0 / (scale * scale));
        // Files round to six digits or hold f32; real shears and reflections are far above this.
        gram.abs_diff_eq(DMat3::IDENTITY, 1e-3)
    };
    if !rigid {
        return Err(
            "is not a rotation (its axes must be at right angles, of one length, right-handed)".to_owned()
        );
    }
    let axes = axes * (1.0 / scale) * DMat3::from_diagonal(signs);
    let rotation = DQuat::from_mat3(&axes.transpose()).normalize();
    let pose = Pose { rotation, translation: -(rotation * centre) };
    if !pose.is_sound() {
        return Err(format!(
            "puts its camera more than {MAX_COORDINATE:e} scene units from the origin; remove the image or compute its \
             pose again"
        ));
    }
    Ok(pose)
}
