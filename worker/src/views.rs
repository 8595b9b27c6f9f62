//! Photographs for the trainer: decoded, undistorted and reduced on demand.

use std::collections::{HashMap, VecDeque};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use fathom_core::config::MaskKeep;
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::scene::{Camera, ManifestView};
use fathom_core::views::{PackedImage, TrainView, ViewSource};
use fathom_core::{CoreError, Result};

/// A photograph on this machine.
#[derive(Clone, Debug)]
pub struct PhotographFile {
    /// Its pose in the scene.
    pub view: ManifestView,
    /// Its camera.
    pub camera: Camera,
    /// The file.
    pub image: PathBuf,
    /// Its mask.
    pub mask: Option<PathBuf>,
    /// As in [`TrainView`].
    pub clear_range: f32,
}

/// Views of photographs in files, with the prepared pixels of recent ones in memory.
pub struct PhotographSource {
    views: Vec<TrainView>,
    files: Vec<PhotographFile>,
    mask_keep: MaskKeep,
    max_resolution: u32,
    prepared: Mutex<Prepared>,
    limit_bytes: u64,
}

#[derive(Default)]
struct Prepared {
    images: HashMap<usize, Arc<PackedImage>>,
    /// Sorted by last use, most recent last.
    order: VecDeque<usize>,
    bytes: u64,
}

impl PhotographSource {
    /// Views of these files, in this order, with at most `max_resolution` pixels on the longest side. Keeps
    /// at most `limit_bytes` of prepared pixels.
    ///
    /// # Errors
    /// When a camera model cannot be undistorted.
    pub fn new(
        files: Vec<PhotographFile>,
        mask_keep: MaskKeep,
        max_resolution: u32,
        limit_bytes: u64,
    ) -> Result<Self> {
        let view = |file: &PhotographFile| {
            let camera = prepared_camera(&file.camera, max_resolution)?;
            Ok(TrainView {
                name: file.view.name.clone(),
                camera,
                pose: file.view.pose,
                clear_range: file.clear_range,
            })
        };
        let views = files.iter().map(view).collect::<Result<_>>()?;
        Ok(Self { views, files, mask_keep, max_resolution, prepared: Mutex::default(), limit_bytes })
    }

    fn prepare(&self, index: usize) -> Result<PackedImage> {
        let file = &self.files[index];
        let read = |path: &PathBuf| std::fs::read(path).map_err(CoreError::io("read", path));
        let image = read(&file.image)?;
        let mask = file.mask.as_ref().map(read).transpose()?;
        let photograph = Photograph { name: &file.view.name, image: &image, mask: mask.as_deref() };
        let (_, pixels) = prepare(&photograph, &file.camera, self.mask_keep, self.max_resolution)?;
        Ok(pixels)
    }
}

impl ViewSource for PhotographSource {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        if let Some(image) = self.prepared.lock().unwrap_or_else(PoisonError::into_inner).take(index) {
            return Ok(image);
        }
        // Prepare outside the lock, so that others can load at the same time.
        let image = Arc::new(self.prepare(index)?);
        let mut prepared = self.prepared.lock().unwrap_or_else(PoisonError::into_inner);
        prepared.insert(index, Arc::clone(&image), self.limit_bytes);
        Ok(image)
    }
}

impl Prepared {
    fn take(&mut self, index: usize) -> Option<Arc<PackedImage>> {
        let image = self.images.get(&index)?;
        self.order.retain(|known| *known != index);
        self.order.push_back(index);
        Some(Arc::clone(image))
    }

    fn insert(&mut self, index: usize, image: Arc<PackedImage>, limit_bytes: u64) {
        let size = |image: &PackedImage| 4 * image.pixels.len() as u64;
        if self.images.contains_key(&index) {
            return;
        }
        self.bytes += size(&image);
        self.images.insert(index, image);
        self.order.push_back(index);
        while self.bytes > limit_bytes && self.order.len() > 1 {
            let oldest = self.order.pop_front().and_then(|oldest| self.images.remove(&oldest));
            self.bytes -= oldest.map_or(0, |image| size(&image));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_pictures_go_first() {
        let image = || Arc::new(PackedImage { width: 5, height: 5, pixels: vec![0; 25] });
        let mut prepared = Prepared::default();
        for index in 0..3 {
            prepared.insert(index, image(), 300);
        }
        assert!(prepared.take(0).is_some());
        prepared.insert(3, image(), 300);
        assert!(prepared.take(1).is_none(), "1 was used least recently");
        assert!([0, 2, 3].into_iter().all(|index| prepared.take(index).is_some()));
        assert_eq!(prepared.bytes, 300);
    }
}
