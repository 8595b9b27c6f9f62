//! Turns the draft of a reader into a [`Scene`], with the checks that all inputs share.
//!
//! A view whose photograph is missing is left out and named in a warning; for `inspect` it is kept without
//! the file. Contradictions are errors. Views are sorted by name.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::files::{FileIndex, check_name};
use super::{Camera, Points, Pose, Purpose, Scene, View};
use crate::config::DataConfig;
use crate::{CoreError, Result, picture};

/// The unchecked result of a reader.
pub(super) struct Draft {
    pub source: &'static str,
    pub root: PathBuf,
    /// The files that messages name.
    pub cameras_file: PathBuf,
    pub views_file: PathBuf,
    pub points_file: PathBuf,
    /// Candidate folders of the photographs; see [`image_folder`].
    pub image_folders: Vec<PathBuf>,
    pub cameras: Vec<Camera>,
    pub views: Vec<DraftView>,
    pub points: Points,
    pub warnings: Vec<String>,
}

pub(super) struct DraftView {
    pub name: String,
    /// [`View::listed_at`].
    pub listed_at: u32,
    /// Relative to the folder of the photographs.
    pub file: PathBuf,
    pub camera_id: u32,
    pub pose: Pose,
    pub mask: Option<PathBuf>,
    pub place: String,
}

pub(super) fn assemble(mut draft: Draft, purpose: Purpose, options: &DataConfig) -> Result<Scene> {
    check_cameras(&mut draft)?;
    check_views(&mut draft)?;
    let mut views = find_photographs(&mut draft, purpose)?;
    check_sizes(&mut draft, &views, purpose)?;
    find_masks(&mut draft, &mut views)?;
    let mut scene = Scene {
        source: draft.source,
        root: draft.root,
        cameras: draft.cameras,
        views,
        points: draft.points,
        warnings: draft.warnings,
    };
    warn_of_far_origin(&mut scene);
    if purpose == Purpose::Train {
        check_trainable(&scene, &draft.points_file, options)?;
    }
    Ok(scene)
}

fn check_cameras(draft: &mut Draft) -> Result<()> {
    draft.cameras.sort_by_key(|camera| camera.id);
    if let Some(pair) = draft.cameras.windows(2).find(|pair| pair[0].id == pair[1].id) {
        return Err(CoreError::input(
            &draft.cameras_file,
            format!("camera {} is listed twice; remove one of the two", pair[0].id),
        ));
    }
    Ok(())
}

fn check_views(draft: &mut Draft) -> Result<()> {
    let refuse = |view: &DraftView, message: String| {
        CoreError::input(&draft.views_file, format!("{}: {message}", view.place))
    };
    if draft.views.is_empty() {
        return Err(CoreError::input(&draft.views_file, "lists no images; there is nothing to work with"));
    }
    for view in &draft.views {
        check_name(&view.name).map_err(|message| refuse(view, message))?;
        if draft.cameras.binary_search_by_key(&view.camera_id, |camera| camera.id).is_err() {
            return Err(refuse(
                view,
                format!(
                    "image \"{}\" was taken by camera {}, which {} does not list; export the model again",
                    view.name,
                    view.camera_id,
                    draft.cameras_file.display()
                ),
            ));
        }
    }
    draft.views.sort_by(|a, b| a.name.cmp(&b.name));
    match draft.views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        Some(pair) => Err(refuse(
            &pair[1],
            format!("image \"{}\" is listed twice (also at {}); remove one", pair[0].name, pair[0].place),
        )),
        None => Ok(()),
    }
}

fn find_photographs(draft: &mut Draft, purpose: Purpose) -> Result<Vec<View>> {
    let listed = std::mem::take(&mut draft.views);
    let total = listed.len();
    let folder = image_folder(&draft.image_folders, &listed);
    let mut files: Vec<Option<PathBuf>> = listed
        .par_iter()
        .map(|view| folder.map(|folder| folder.join(&view.file)).filter(|path| path.is_file()))
        .collect();
    // Names may differ in case if a model comes from another system.
    if let Some(folder) = folder.filter(|_| files.contains(&None)) {
        let index = FileIndex::of(folder)?;
        for (file, view) in files.iter_mut().zip(&listed).filter(|(file, _)| file.is_none()) {
            *file = view.file.to_str().and_then(|name| index.get(name)).map(Path::to_owned);
        }
    }
    let (mut views, mut missing) = (Vec::with_capacity(total), Vec::new());
    let mut new_index = Vec::with_capacity(total);
    for (DraftView { name, listed_at, camera_id, pose, mask, .. }, image) in listed.into_iter().zip(files) {
        if image.is_none() {
            missing.push(name.clone());
        }
        let kept = image.is_some() || purpose == Purpose::Inspect;
        new_index.push(kept.then_some(views.len() as u32));
        if kept {
            views.push(View { name, listed_at, camera_id, pose, image, mask });
        }
    }
    if missing.is_empty() {
        return Ok(views);
    }
    draft.points.tracks.renumber(&new_index);
    let looked = match folder {
        Some(folder) => folder.display().to_string(),
        None => {
            let folders: Vec<String> = draft.image_folders.iter().map(|f| f.display().to_string()).collect();
            folders.join(" or ")
        }
    };
    if views.is_empty() {
        return Err(CoreError::input(
            &draft.views_file,
            format!(
                "none of its {total} images exists (first: \"{}\"; looked in {looked}); \
                 put the photographs there under the names that the model uses",
                missing[0]
            ),
        ));
    }
    let what = if purpose == Purpose::Inspect { "kept as poses only" } else { "left out" };
    draft.warnings.push(format!(
        "{}: {} of {total} images do not exist in {looked} and are {what}: {}",
        draft.views_file.display(),
        missing.len(),
        some_of(&missing)
    ));
    Ok(views)
}

/// The first folder that holds one of the photographs, otherwise the first `images/`.
fn image_folder<'a>(folders: &'a [PathBuf], views: &[DraftView]) -> Option<&'a PathBuf> {
    // A few views decide: checking thousands in every folder would be slow on network disks.
    let probe = || views.iter().step_by((views.len() / 8).max(1));
    folders
        .iter()
        .find(|folder| probe().any(|view| folder.join(&view.file).is_file()))
        .or_else(|| folders.iter().find(|folder| folder.ends_with("images") && folder.is_dir()))
}

fn check_sizes(draft: &mut Draft, views: &[View], purpose: Purpose) -> Result<()> {
    let by_id: HashMap<u32, &Camera> = draft.cameras.iter().map(|camera| (camera.id, camera)).collect();
    let faults: Vec<CoreError> = views
        .par_iter()
        .filter_map(|view| {
            let (path, camera) = (view.image.as_ref()?, by_id.get(&view.camera_id)?);
            let size = match purpose {
                Purpose::Measure | Purpose::Train => picture::dimensions_of_complete(path),
                Purpose::Inspect => picture::dimensions(path),
            };
            match size {
                Ok(size) => picture::size_mismatch(size, (camera.width, camera.height))
                    .map(|message| CoreError::input(path, message)),
                Err(error) => Some(error),
            }
        })
        .collect();
    let count = faults.len();
    let Some(first) = faults.into_iter().next() else { return Ok(()) };
    if purpose != Purpose::Inspect {
        return Err(match first {
            CoreError::Input { path, message } if count > 1 => CoreError::Input {
                path,
                message: format!("{message} ({} more images have a fault)", count - 1),
            },
            first => first,
        });
    }
    draft.warnings.push(format!("{count} images cannot be trained on; the first: {first}"));
    Ok(())
}

fn find_masks(draft: &mut Draft, views: &mut [View]) -> Result<()> {
    let beside_images = draft.image_folders.iter().filter(|folder| folder.ends_with("images"));
    let Some(folder) =
        beside_images.map(|images| images.with_file_name("masks")).find(|folder| folder.is_dir())
    else {
        return Ok(());
    };
    let index = FileIndex::of(&folder)?;
    if index.is_empty() {
        return Ok(());
    }
    let mut without = Vec::new();
    for view in views.iter_mut().filter(|view| view.mask.is_none()) {
        match index.mask_of(&view.name) {
            Some(path) => view.mask = Some(path.to_owned()),
            None => without.push(view.name.clone()),
        }
    }
    if without.len() == views.len() {
        draft.warnings.push(format!(
            "{}: no file there is the mask of a listed image (IMAGE.png, IMAGE.jpg.png or IMAGE.mask.png); \
             training without masks",
            folder.display()
        ));
    } else if !without.is_empty() {
        draft.warnings.push(format!(
            "{}: {} of {} images have no mask, so all their pixels count: {}",
            folder.display(),
            without.len(),
            views.len(),
            some_of(&without)
        ));
    }
    Ok(())
}

/// Warns of coordinates far from the origin: training stores positions in f32, whose steps become visible
/// there.
fn warn_of_far_origin(scene: &mut Scene) {
    // f32 resolves 6e-8 of a coordinate. At this ratio that is 6e-4 of the extent, one pixel in a picture
    // of 1600.
    const MAX_RATIO: f64 = 1e4;
    let extent = scene.extent();
    let farthest = scene.views.iter().map(|view| view.pose.centre().length()).fold(0.0, f64::max);
    if extent > 0.0 && farthest > MAX_RATIO * extent {
        scene.warnings.push(format!(
            "the cameras are {farthest:.0} units far from the origin but only {extent:.3} units from their middle, \
             which 32-bit positions cannot resolve; shift the model to a local origin (`colmap model_transformer`)"
        ));
    }
}

/// Checks what only training needs.
fn check_trainable(scene: &Scene, points_file: &Path, options: &DataConfig) -> Result<()> {
    let views = scene.views.len();
    let held_out = if options.test_every == 0 { 0 } else { views.div_ceil(options.test_every as usize) };
    if views < 2 || held_out >= views {
        return Err(CoreError::input(
            &scene.root,
            format!(
                "{views} usable image{}, {held_out} of them held out for testing: training needs at least two, one of \
                 them not held out; add photographs or set data.test_every",
                if views == 1 { "" } else { "s" }
            ),
        ));
    }
    if scene.points.is_empty() {
        return Err(CoreError::input(
            points_file,
            "there are no sparse points, and training starts from them; run `colmap point_triangulator` on the \
             poses, or export the points with the cameras",
        ));
    }
    // Camera models that cannot be undistorted are refused here, not after the upload.
    for camera in &scene.cameras {
        if scene.views.iter().any(|view| view.camera_id == camera.id) {
            camera.pinhole()?;
        }
    }
    Ok(())
}

/// The first few names and the number of the others.
fn some_of(names: &[String]) -> String {
    const SHOWN: usize = 3;
    let mut text = names.iter().take(SHOWN).map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN {
        text.push_str(&format!(" and {} more", names.len() - SHOWN));
    }
    text
}
