//! COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`.
//!
//! Lines that start with `#` are comments. An image takes two lines; the second (its 2D points) is always
//! present but may be empty. A name is the rest of its line and may hold spaces.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::str::SplitAsciiWhitespace;

use super::colmap::{Lenses, RawImage, RawPoints, image_pose};
use super::{Camera, CameraModel};
use crate::{CoreError, Result};

pub(super) fn read_cameras(path: &Path) -> Result<Vec<Camera>> {
    let mut file = Lines::open(path)?;
    let mut cameras = Vec::new();
    while let Some(line) = file.next_entry()? {
        let mut words = line.split_ascii_whitespace();
        let fault = |message: String| file.fault(&message);
        let id = number(&mut words, "the camera id").map_err(fault)?;
        let name = words.next().unwrap_or_default();
        let model = CameraModel::from_name(name).ok_or_else(|| {
            file.fault(&format!(
                "camera {id} has the unknown camera model \"{name}\"; Fathom knows the 18 models of COLMAP 4.1"
            ))
        })?;
        let width = number(&mut words, "the width").map_err(fault)?;
        let height = number(&mut words, "the height").map_err(fault)?;
        let params = words.map(parse_float).collect::<Result<Vec<_>, _>>().map_err(fault)?;
        if params.len() != model.param_count() {
            return Err(file.fault(&format!(
                "camera {id} has {} parameters, but {} takes {}",
                params.len(),
                model.name(),
                model.param_count()
            )));
        }
        let camera = Camera { id, model, width, height, params };
        camera.check().map_err(fault)?;
        cameras.push(camera);
    }
    Ok(cameras)
}

/// The number of images: half of the lines that are not comments.
pub(super) fn image_count(path: &Path) -> Result<u64> {
    let mut file = Lines::open(path)?;
    let mut count = 0;
    while file.next_entry()?.is_some() {
        file.next_line()?;
        count += 1;
    }
    Ok(count)
}

pub(super) fn read_images(path: &Path, lenses: &Lenses) -> Result<Vec<RawImage>> {
    let mut file = Lines::open(path)?;
    let mut images = Vec::new();
    while let Some(line) = file.next_entry()? {
        let fault = |message: String| file.fault(&message);
        // Nine fields, then the name unchanged, spaces included.
        let mut rest = line.trim();
        let mut word = || {
            let (word, tail) = rest.split_once(|c: char| c.is_ascii_whitespace()).unwrap_or((rest, ""));
            rest = tail.trim_start();
            word.to_owned()
        };
        let id = parse_integer::<u32>(&word(), "the image id").map_err(fault)?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = parse_float(&word()).map_err(fault)?;
        }
        let camera_id = parse_integer(&word(), "the camera id").map_err(fault)?;
        let name = rest.to_owned();
        if name.is_empty() {
            return Err(file.fault(
                "an image line needs 10 fields (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME); \
                 was the empty second line of an image lost?",
            ));
        }
        let [qw, qx, qy, qz, tx, ty, tz] = pose;
        let pose = image_pose(&name, [qw, qx, qy, qz], [tx, ty, tz]).map_err(fault)?;
        let place = format!("line {}", file.number);
        let mut seen = Vec::new();
        // The line of 2D points, which is missing after the last image if an editor has trimmed the file.
        if let Some(points) = file.next_line()? {
            let mut count = 0;
            let mut pixel = [f64::NAN; 2];
            for word in points.split_ascii_whitespace() {
                match count % 3 {
                    2 if word.parse::<u64>().is_ok_and(|id| id != u64::MAX) => {
                        seen.push((count / 3, lenses.place(camera_id, pixel)));
                    }
                    2 => {}
                    // What is no number has no place.
                    axis => pixel[axis as usize] = parse_float(word).unwrap_or(f64::NAN),
                }
                count += 1_u32;
            }
            if count % 3 != 0 {
                return Err(file.fault(&format!(
                    "{count} numbers of 2D points are not a multiple of three (X Y POINT3D_ID); \
                     the file is truncated or the second line of an image is missing"
                )));
            }
        }
        images.push(RawImage { id, name, camera_id, pose, place, seen });
    }
    Ok(images)
}

pub(super) fn read_points(path: &Path, into: &mut RawPoints<'_>) -> Result<()> {
    let mut file = Lines::open(path)?;
    while let Some(line) = file.next_entry()? {
        let mut words = line.split_ascii_whitespace();
        let fault = |message: String| file.fault(&message);
        let _point_id: u64 = number(&mut words, "the point id").map_err(fault)?;
        let mut position = [0.0; 3];
        for value in &mut position {
            *value = parse_float(words.next().unwrap_or_default()).map_err(fault)?;
        }
        let mut colour = [0_u8; 3];
        for value in &mut colour {
            *value = number(&mut words, "a colour (0 to 255)").map_err(fault)?;
        }
        let _reprojection_error = words.next();
        while let Some(image_id) = words.next() {
            let image_id = parse_integer(image_id, "the image id of a track").map_err(fault)?;
            let index = number(&mut words, "the 2D point of a track").map_err(fault)?;
            into.see(image_id, index);
        }
        into.push(position, colour);
    }
    Ok(())
}

/// Lines with their numbers, from 1.
struct Lines {
    file: BufReader<File>,
    path: PathBuf,
    buffer: String,
    number: usize,
}

impl Lines {
    fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(CoreError::io("read", path))?;
        let file = BufReader::with_capacity(1 << 18, file);
        Ok(Self { file, path: path.to_owned(), buffer: String::new(), number: 0 })
    }

    /// The next line, comments and empty lines included.
    fn next_line(&mut self) -> Result<Option<&str>> {
        self.buffer.clear();
        self.number += 1;
        let read = self.file.read_line(&mut self.buffer).map_err(|source| {
            if source.kind() == std::io::ErrorKind::InvalidData {
                CoreError::input(&self.path, format!("line {}: not valid UTF-8", self.number))
            } else {
                CoreError::Io { action: "read", path: self.path.clone(), source }
            }
        })?;
        Ok((read > 0).then_some(self.buffer.trim_end()))
    }

    /// The next line that is neither empty nor a comment.
    fn next_entry(&mut self) -> Result<Option<String>> {
        while let Some(line) = self.next_line()? {
            if !line.trim().is_empty() && !line.starts_with('#') {
                return Ok(Some(line.to_owned()));
            }
        }
        Ok(None)
    }

    fn fault(&self, message: &str) -> CoreError {
        CoreError::input(&self.path, format!("line {}: {message}", self.number))
    }
}

fn number<T: std::str::FromStr>(words: &mut SplitAsciiWhitespace<'_>, what: &str) -> Result<T, String> {
    parse_integer(words.next().unwrap_or_default(), what)
}

fn parse_integer<T: std::str::FromStr>(word: &str, what: &str) -> Result<T, String> {
    match word.parse() {
        Ok(value) => Ok(value),
        Err(_) if word.is_empty() => Err(format!("the line ends before {what}; the file is truncated")),
        Err(_) => Err(format!("found \"{word}\" instead of {what}")),
    }
}

/// A float as any C library prints it, including `-nan(ind)` of Windows.
fn parse_float(word: &str) -> Result<f64, String> {
    let lower = word.to_ascii_lowercase();
    let unsigned = lower.trim_start_matches(['-', '+']);
    if unsigned.starts_with("nan") || unsigned.starts_with("1.#") {
        return Ok(f64::NAN);
    }
    match word.parse() {
        Ok(value) => Ok(value),
        Err(_) if word.is_empty() => Err("the line ends before a number; the file is truncated".to_owned()),
        Err(_) => Err(format!("\"{word}\" is not a number")),
    }
}
