//! Photographs for the trainer: decoded, undistorted and reduced on demand.

use std::collections::{HashMap, VecDeque};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

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

/// How long photographs took until they were ready, added over threads.
#[derive(Debug, Default)]
pub struct ReadingTime {
    disk_us: AtomicU64,
    decoding_us: AtomicU64,
}

impl ReadingTime {
    fn add(&self, disk: Duration, decoding: Duration) {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        self.disk_us.fetch_add(micros(disk), Ordering::Relaxed);
        self.decoding_us.fetch_add(micros(decoding), Ordering::Relaxed);
    }

    /// Both so far, microseconds.
    fn both(&self) -> [u64; 2] {
        [&self.disk_us, &self.decoding_us].map(|of| of.load(Ordering::Relaxed))
    }
}

/// Divides the wait for photographs into reading files and decoding, stretch by stretch.
pub struct DiskWait {
    reading: Arc<ReadingTime>,
    /// Of the photographs that were read before the stretch.
    before: [u64; 2],
    waited: Duration,
    disk: Duration,
    /// The share of the disk in the latest stretch in which photographs were read.
    share: f64,
}

impl DiskWait {
    /// For a run that has not waited yet.
    pub fn new(reading: Arc<ReadingTime>) -> Self {
        let before = reading.both();
        Self { reading, before, waited: Duration::ZERO, disk: Duration::ZERO, share: 0.0 }
    }

    /// The part of the disk in all that the run has waited so far. It never falls.
    pub fn after(&mut self, waited: Duration) -> Duration {
        let now = self.reading.both();
        let [disk, decoding] = [0, 1].map(|of| now[of].saturating_sub(self.before[of]) as f64);
        if disk + decoding > 0.0 {
            self.share = disk / (disk + decoding);
        }
        self.disk += waited.saturating_sub(self.waited).mul_f64(self.share);
        (self.before, self.waited) = (now, waited);
        self.disk
    }
}

/// Views of photographs in files, with the prepared pixels of recent ones in memory.
pub struct PhotographSource {
    views: Vec<TrainView>,
    files: Vec<PhotographFile>,
    mask_keep: MaskKeep,
    max_resolution: u32,
    prepared: Mutex<Prepared>,
    limit_bytes: u64,
    reading: Arc<ReadingTime>,
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
    /// at most `limit_bytes` of prepared pixels, and adds to `reading` what they take.
    ///
    /// # Errors
    /// When a camera model cannot be undistorted.
    pub fn new(
        files: Vec<PhotographFile>,
        mask_keep: MaskKeep,
        max_resolution: u32,
        limit_bytes: u64,
        reading: Arc<ReadingTime>,
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
        Ok(Self { views, files, mask_keep, max_resolution, prepared: Mutex::default(), limit_bytes, reading })
    }

    fn prepare(&self, index: usize) -> Result<PackedImage> {
        let file = &self.files[index];
        let begin = Instant::now();
        let read = |path: &PathBuf| std::fs::read(path).map_err(CoreError::io("read", path));
        let image = read(&file.image)?;
        let mask = file.mask.as_ref().map(read).transpose()?;
        let is_read = Instant::now();
        let photograph = Photograph { name: &file.view.name, image: &image, mask: mask.as_deref() };
        let (_, pixels) = prepare(&photograph, &file.camera, self.mask_keep, self.max_resolution)?;
        self.reading.add(is_read - begin, is_read.elapsed());
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
    fn the_disk_has_its_share_of_each_stretch() {
        let time = Arc::new(ReadingTime::default());
        let mut wait = DiskWait::new(Arc::clone(&time));
        let seconds = Duration::from_secs;
        assert_eq!(wait.after(Duration::ZERO), Duration::ZERO, "nothing was read");
        time.add(seconds(9), seconds(3));
        assert_eq!(wait.after(seconds(8)), seconds(6));
        // Decoded ahead, without a wait: nothing is taken back.
        time.add(Duration::ZERO, seconds(100));
        assert_eq!(wait.after(seconds(8)), seconds(6));
        time.add(seconds(1), seconds(1));
        assert_eq!(wait.after(seconds(10)), seconds(7));
        // What was read before ends a wait of this stretch.
        assert_eq!(wait.after(seconds(12)), seconds(8));
    }

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
