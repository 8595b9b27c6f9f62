//! Finds COLMAP models in a folder, chooses the largest one and reads it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::assemble::{Draft, DraftView};
use super::camera::MAX_COORDINATE;
use super::{
    Camera, PinholeCamera, Place, Points, Pose, Purpose, Reach, Undistortion, colmap_binary, colmap_text,
};
use crate::{CoreError, Result};

/// One image as a model lists it.
pub(super) struct RawImage {
    pub id: u32,
    pub name: String,
    pub camera_id: u32,
    pub pose: Pose,
    /// Its byte or line in the file.
    pub place: String,
    /// Its 2D points that belong to a point: index in the file, ascending, and place.
    pub seen: Vec<(u32, Place)>,
}

/// Cameras by id, with the way from a pixel of their photographs to a place in the undistorted picture.
pub(super) struct Lenses(HashMap<u32, Undistortion>);

impl Lenses {
    /// Cameras that cannot be undistorted are left out.
    fn of(cameras: &[Camera]) -> Self {
        Self(cameras.iter().filter_map(|camera| Some((camera.id, camera.undistortion().ok()?))).collect())
    }

    /// Where the undistorted picture of this camera shows a `pixel` of the photograph.
    pub fn place(&self, camera_id: u32, [u, v]: [f64; 2]) -> Place {
        let Some(lens) = self.0.get(&camera_id) else { return Place::UNKNOWN };
        let PinholeCamera { width, height, .. } = lens.pinhole();
        lens.result_of(u, v).map_or(Place::UNKNOWN, |pixel| Place::new(pixel, width, height))
    }
}

/// Points while they are read.
pub(super) struct RawPoints<'a> {
    /// Maps the id of an image to the index of its view by name.
    view_of_image: &'a HashMap<u32, u32>,
    /// By view: [`RawImage::seen`].
    places: Vec<Vec<(u32, Place)>>,
    pub points: Points,
    /// Points left out because a coordinate is not finite or beyond [`MAX_COORDINATE`].
    not_finite: usize,
    /// Observations left out because the model has no image of that id.
    unknown: usize,
    track: Vec<(u32, Place)>,
}

impl<'a> RawPoints<'a> {
    fn new(view_of_image: &'a HashMap<u32, u32>, places: Vec<Vec<(u32, Place)>>) -> Self {
        let points = Points::default();
        Self { view_of_image, places, points, not_finite: 0, unknown: 0, track: Vec::new() }
    }

    /// Records that the image of this id sees the next point, as its 2D point `index`.
    pub fn see(&mut self, image_id: u32, index: u32) {
        let Some(&view) = self.view_of_image.get(&image_id) else {
            self.unknown += 1;
            return;
        };
        let of_view = self.places.get(view as usize).map_or(&[][..], Vec::as_slice);
        let place =
            of_view.binary_search_by_key(&index, |seen| seen.0).map_or(Place::UNKNOWN, |at| of_view[at].1);
        self.track.push((view, place));
    }

    pub fn push(&mut self, position: [f64; 3], colour: [u8; 3]) {
        if !self.points.push_seen_at(position, colour, &mut self.track) {
            self.not_finite += 1;
        }
        self.track.clear();
    }
}

/// The pose of an image, or a message about its fault.
pub(super) fn image_pose(name: &str, quat_wxyz: [f64; 4], translation: [f64; 3]) -> Result<Pose, String> {
    let help = "remove the image from the model or run the reconstruction again";
    if !quat_wxyz.iter().chain(&translation).all(|value| value.is_finite()) {
        return Err(format!("the pose of image \"{name}\" holds a number that is not finite; {help}"));
    }
    // COLMAP writes unit quaternions; text files round them to six digits.
    let norm2: f64 = quat_wxyz.iter().map(|value| value * value).sum();
    let usable = norm2 > 1e-12 && norm2.is_finite();
    if !usable {
        return Err(format!("the rotation of image \"{name}\" is the zero quaternion; {help}"));
    }
    let pose = Pose::from_wxyz(quat_wxyz, translation);
    if !pose.is_sound() {
        return Err(format!(
            "image \"{name}\" is more than {MAX_COORDINATE:e} scene units from the origin; {help}"
        ));
    }
    Ok(pose)
}

/// The format of a model's files. COLMAP itself prefers binary if both exist.
#[derive(Clone, Copy, PartialEq)]
enum Form {
    Binary,
    Text,
}

/// A folder that holds a model.
pub(super) struct Model {
    folder: PathBuf,
    form: Form,
}

impl Model {
    fn at(folder: &Path) -> Option<Self> {
        let holds = |name: &str| folder.join(name).is_file();
        let form = if holds("cameras.bin") && holds("images.bin") {
            Form::Binary
        } else if holds("cameras.txt") && holds("images.txt") {
            Form::Text
        } else {
            return None;
        };
        Some(Self { folder: folder.to_owned(), form })
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.join(match self.form {
            Form::Binary => format!("{name}.bin"),
            Form::Text => format!("{name}.txt"),
        })
    }

    fn image_count(&self) -> Result<u64> {
        match self.form {
            Form::Binary => colmap_binary::image_count(&self.file("images")),
            Form::Text => colmap_text::image_count(&self.file("images")),
        }
    }
}

/// The models of a folder: all in the first location that has any.
pub(super) fn find_models(root: &Path) -> Result<Vec<Model>> {
    for place in [root.join("sparse"), root.join("colmap").join("sparse"), root.to_owned()] {
        let mut folders = super::files::sorted_entries(&place)?;
        folders.retain(|path| {
            // In the given folder, which may hold anything, only numbered folders count, as when `sparse`
            // itself is given.
            let numbered = path.file_name().is_some_and(|name| name.to_str().is_some_and(is_number));
            (place != root || numbered) && path.is_dir()
        });
        folders.insert(0, place);
        let models: Vec<Model> = folders.iter().filter_map(|folder| Model::at(folder)).collect();
        if !models.is_empty() {
            return Ok(models);
        }
        for folder in folders {
            refuse_half_a_model(&folder)?;
        }
    }
    Ok(Vec::new())
}

fn is_number(name: &str) -> bool {
    !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_digit())
}

/// Names the missing file if only one of a model's two files exists.
fn refuse_half_a_model(folder: &Path) -> Result<()> {
    for (there, missing) in [("cameras", "images"), ("images", "cameras")] {
        for form in ["bin", "txt"] {
            let file = folder.join(format!("{there}.{form}"));
            if file.is_file() {
                return Err(CoreError::input(
                    file,
                    format!("{missing}.{form} is not beside it; a COLMAP model needs both: export it again"),
                ));
            }
        }
    }
    Ok(())
}

/// Reads the model with the most images; the first of equals.
pub(super) fn read(root: &Path, models: &[Model], purpose: Purpose, reach: Reach) -> Result<Draft> {
    let counts = models.iter().map(Model::image_count).collect::<Result<Vec<u64>>>()?;
    let Some(chosen) = (0..models.len()).min_by_key(|index| (std::cmp::Reverse(counts[*index]), *index))
    else {
        return Err(CoreError::input(root, "holds no COLMAP model"));
    };
    let model = &models[chosen];
    let mut warnings = Vec::new();
    if models.len() > 1 {
        let lost: u64 = counts.iter().sum::<u64>() - counts[chosen];
        let others: Vec<String> = (0..models.len())
            .filter(|index| *index != chosen)
            .map(|index| format!("{} ({} images)", models[index].folder.display(), counts[index]))
            .collect();
        warnings.push(format!(
            "{} COLMAP models without a common frame: taking the biggest, {} ({} images); {lost} images of {} are \
             lost (`colmap model_merger` joins models that share images)",
            models.len(),
            model.folder.display(),
            counts[chosen],
            others.join(", ")
        ));
    }

    let (cameras_file, images_file) = (model.file("cameras"), model.file("images"));
    let cameras: Vec<Camera> = match model.form {
        Form::Binary => colmap_binary::read_cameras(&cameras_file)?,
        Form::Text => colmap_text::read_cameras(&cameras_file)?,
    };
    let lenses = Lenses::of(&cameras);
    let mut images: Vec<RawImage> = match model.form {
        Form::Binary => colmap_binary::read_images(&images_file, &lenses)?,
        Form::Text => colmap_text::read_images(&images_file, &lenses)?,
    };
    // Ids follow the order in which photographs were added to a database.
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let points_file = model.file("points3D");
    let view_of_image: HashMap<u32, u32> = images.iter().map(|image| image.id).zip(0..).collect();
    let places = images.iter_mut().map(|image| std::mem::take(&mut image.seen)).collect();
    let mut read = RawPoints::new(&view_of_image, places);
    match (points_file.is_file(), model.form) {
        (true, Form::Binary) => colmap_binary::read_points(&points_file, &mut read)?,
        (true, Form::Text) => colmap_text::read_points(&points_file, &mut read)?,
        (false, _) => {}
    }
    let RawPoints { points, not_finite, unknown, .. } = read;
    if not_finite > 0 {
        warnings.push(format!(
            "{}: {not_finite} points with coordinates that are not finite or beyond {MAX_COORDINATE:e} are left out",
            points_file.display()
        ));
    }
    if unknown > 0 {
        warnings.push(format!(
            "{}: {unknown} observations by images that {} does not list are left out",
            points_file.display(),
            images_file.display()
        ));
    }
    if points.is_empty() && purpose == Purpose::Inspect {
        warnings
            .push(format!("{}: there are no sparse points; training will need them", points_file.display()));
    }
    let views = (0..)
        .zip(images)
        .map(|(listed_at, image)| DraftView {
            listed_at,
            file: PathBuf::from(&image.name),
            name: image.name,
            camera_id: image.camera_id,
            pose: image.pose,
            mask: None,
            place: image.place,
        })
        .collect();
    Ok(Draft {
        source: match model.form {
            Form::Binary => "COLMAP binary",
            Form::Text => "COLMAP text",
        },
        root: root.to_owned(),
        cameras_file,
        views_file: images_file,
        points_file,
        image_folders: image_folders(root, &model.folder, reach),
        cameras,
        views,
        points,
        warnings,
    })
}

/// Candidate folders of the photographs: `images/` in the given folder, beside the model and above it; then
/// the given folder itself. Folders above the given one only count if it is a part of a dataset.
fn image_folders(root: &Path, model: &Path, reach: Reach) -> Vec<PathBuf> {
    let is_part = model == root || root.ends_with("sparse") || root.ends_with("colmap");
    let up_to_root = model.strip_prefix(root).map_or(0, |inner| inner.components().count());
    // dataset/colmap/sparse/0 is the deepest usual location: three steps up.
    let levels = if is_part && reach == Reach::Anywhere { 3 } else { up_to_root };
    let mut folders = vec![root.join("images")];
    let above = model.ancestors().take(levels + 1).map(|up| up.join("images"));
    folders.extend(above.filter(|folder| *folder != root.join("images")));
    folders.push(root.to_owned());
    folders
}
