//! A small scene on disk, written byte by byte so that the readers are not tested against themselves.

use std::path::{Path, PathBuf};

use crate::Result;
use crate::config::DataConfig;
use crate::scene::{Purpose, Scene, load_scene};

pub const WIDTH: u32 = 8;
pub const HEIGHT: u32 = 6;
/// Unit quaternions w x y z, exact in binary and in decimal text.
pub const QUATS: [[f64; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.0, 1.0, 0.0, 0.0]];

#[derive(Clone)]
pub struct CameraEntry {
    pub id: u32,
    pub model: u32,
    pub name: &'static str,
    pub width: u64,
    pub height: u64,
    pub params: Vec<f64>,
}

#[derive(Clone)]
pub struct ImageEntry {
    pub id: u32,
    pub quat_wxyz: [f64; 4],
    pub translation: [f64; 3],
    pub camera_id: u32,
    pub name: String,
    /// Pixels, and the ids of their points.
    pub points2d: Vec<([f64; 2], Option<u64>)>,
}

#[derive(Clone)]
pub struct PointEntry {
    pub position: [f64; 3],
    pub colour: [u8; 3],
    /// Ids of images.
    pub track: Vec<u32>,
    /// The 2D point of the images in the same order; missing ones are a 2D point that no image has.
    pub indices: Vec<u32>,
}

impl PointEntry {
    fn seen(&self) -> impl Iterator<Item = (u32, u32)> {
        let index = |at: usize| self.indices.get(at).copied().unwrap_or(7);
        self.track.iter().enumerate().map(move |(at, &image_id)| (image_id, index(at)))
    }
}

/// A valid model that tests damage.
#[derive(Clone)]
pub struct Model {
    pub cameras: Vec<CameraEntry>,
    pub images: Vec<ImageEntry>,
    pub points: Vec<PointEntry>,
}

impl Model {
    pub fn sample() -> Self {
        let names = ["left cam/b 2.png", "a.png", "left cam/c.png"];
        let images = (0..3).map(|i| ImageEntry {
            id: i as u32 + 10,
            quat_wxyz: QUATS[i],
            translation: [i as f64 * 0.5, -1.25, 2.0],
            camera_id: 3,
            name: names[i].to_owned(),
            points2d: vec![([1.5, 2.5], None); [2, 0, 1][i]],
        });
        let points = (0..4_u32).map(|i| PointEntry {
            position: [f64::from(i) * 0.25, 1.5, -2.0],
            colour: [i as u8, 128, 255],
            track: [vec![], vec![12], vec![10, 11], vec![]][i as usize].clone(),
            indices: Vec::new(),
        });
        Self { cameras: vec![pinhole(3)], images: images.collect(), points: points.collect() }
    }

    pub fn cameras_bin(&self) -> Vec<u8> {
        let mut out = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for camera in &self.cameras {
            out.extend(camera.id.to_le_bytes());
            out.extend(camera.model.to_le_bytes());
            out.extend(camera.width.to_le_bytes());
            out.extend(camera.height.to_le_bytes());
            camera.params.iter().for_each(|value| out.extend(value.to_le_bytes()));
        }
        out
    }

    pub fn images_bin(&self) -> Vec<u8> {
        let mut out = (self.images.len() as u64).to_le_bytes().to_vec();
        for image in &self.images {
            out.extend(image.id.to_le_bytes());
            image
                .quat_wxyz
                .iter()
                .chain(&image.translation)
                .for_each(|value| out.extend(value.to_le_bytes()));
            out.extend(image.camera_id.to_le_bytes());
            out.extend(image.name.as_bytes());
            out.push(0);
            out.extend((image.points2d.len() as u64).to_le_bytes());
            for (pixel, point) in &image.points2d {
                pixel.iter().for_each(|value| out.extend(value.to_le_bytes()));
                out.extend(point.unwrap_or(u64::MAX).to_le_bytes());
            }
        }
        out
    }

    pub fn points_bin(&self) -> Vec<u8> {
        let mut out = (self.points.len() as u64).to_le_bytes().to_vec();
        for (id, point) in self.points.iter().enumerate() {
            out.extend((id as u64 + 1).to_le_bytes());
            point.position.iter().for_each(|value| out.extend(value.to_le_bytes()));
            out.extend(point.colour);
            out.extend(0.5_f64.to_le_bytes());
            out.extend((point.track.len() as u64).to_le_bytes());
            for (image_id, index) in point.seen() {
                out.extend(image_id.to_le_bytes());
                out.extend(index.to_le_bytes());
            }
        }
        out
    }

    pub fn write_binary(&self, folder: &Path) {
        std::fs::create_dir_all(folder).unwrap();
        std::fs::write(folder.join("cameras.bin"), self.cameras_bin()).unwrap();
        std::fs::write(folder.join("images.bin"), self.images_bin()).unwrap();
        std::fs::write(folder.join("points3D.bin"), self.points_bin()).unwrap();
    }

    pub fn cameras_txt(&self) -> String {
        let mut out = "# Camera list\n".to_owned();
        for camera in &self.cameras {
            let params: Vec<String> = camera.params.iter().map(f64::to_string).collect();
            let CameraEntry { id, name, width, height, .. } = camera;
            out.push_str(&format!("{id} {name} {width} {height} {}\n", params.join(" ")));
        }
        out
    }

    pub fn images_txt(&self) -> String {
        let mut out = "# Image list\n".to_owned();
        for image in &self.images {
            let numbers: Vec<String> =
                image.quat_wxyz.iter().chain(&image.translation).map(f64::to_string).collect();
            out.push_str(&format!("{} {} {} {}\n", image.id, numbers.join(" "), image.camera_id, image.name));
            for ([x, y], point) in &image.points2d {
                out.push_str(&format!("{x} {y} {} ", point.map_or("-1".to_owned(), |id| id.to_string())));
            }
            out.push('\n');
        }
        out
    }

    pub fn points_txt(&self) -> String {
        let mut out = "# Point list\n".to_owned();
        for (id, point) in self.points.iter().enumerate() {
            let PointEntry { position: [x, y, z], colour: [r, g, b], .. } = point;
            let track: String =
                point.seen().map(|(image_id, index)| format!(" {image_id} {index}")).collect();
            out.push_str(&format!("{} {x} {y} {z} {r} {g} {b} 0.5{track}\n", id + 1));
        }
        out
    }

    pub fn write_text(&self, folder: &Path) {
        std::fs::create_dir_all(folder).unwrap();
        std::fs::write(folder.join("cameras.txt"), self.cameras_txt()).unwrap();
        std::fs::write(folder.join("images.txt"), self.images_txt()).unwrap();
        std::fs::write(folder.join("points3D.txt"), self.points_txt()).unwrap();
    }

    pub fn write_photographs(&self, folder: &Path) {
        for image in &self.images {
            write_png(&folder.join(&image.name), WIDTH, HEIGHT);
        }
    }
}

pub fn pinhole(id: u32) -> CameraEntry {
    let (width, height) = (u64::from(WIDTH), u64::from(HEIGHT));
    CameraEntry { id, model: 1, name: "PINHOLE", width, height, params: vec![10.5, 11.0, 4.25, 3.0] }
}

pub fn write_png(path: &Path, width: u32, height: u32) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb([x as u8, y as u8, 99])).save(path).unwrap();
}

/// A dataset in a temporary folder: `images/` and `sparse/0`, binary.
pub struct Dataset {
    folder: tempfile::TempDir,
}

impl Dataset {
    pub fn empty() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    pub fn binary(model: &Model) -> Self {
        let dataset = Self::empty();
        model.write_binary(&dataset.path("sparse/0"));
        model.write_photographs(&dataset.path("images"));
        dataset
    }

    pub fn text(model: &Model) -> Self {
        let dataset = Self::empty();
        model.write_text(&dataset.path("sparse/0"));
        model.write_photographs(&dataset.path("images"));
        dataset
    }

    pub fn path(&self, relative: &str) -> PathBuf {
        self.folder.path().join(relative)
    }

    pub fn write(&self, relative: &str, bytes: impl AsRef<[u8]>) {
        std::fs::create_dir_all(self.path(relative).parent().unwrap()).unwrap();
        std::fs::write(self.path(relative), bytes).unwrap();
    }

    pub fn load_at(&self, relative: &str, purpose: Purpose) -> Result<Scene> {
        load_scene(&self.path(relative), purpose, &DataConfig::default())
    }

    pub fn train(&self) -> Scene {
        self.load_at("", Purpose::Train).unwrap()
    }

    pub fn inspect(&self) -> Scene {
        self.load_at("", Purpose::Inspect).unwrap()
    }

    /// The error message of loading for training; it must name `file`.
    pub fn refused(&self, file: &str) -> String {
        let message = self.load_at("", Purpose::Train).unwrap_err().to_string();
        assert!(message.contains(file), "\"{message}\" does not name {file}");
        message
    }
}

pub fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "\"{message}\" does not say \"{part}\"");
    }
}
