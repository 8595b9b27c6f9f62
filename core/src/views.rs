//! What a renderer and a trainer need of photographs: pinhole, pose and packed pixels.

use std::sync::Arc;

use crate::scene::{PinholeCamera, Pose};
use crate::{CoreError, Result};

/// One view: its pinhole camera (after undistortion and resizing) and its pose.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainView {
    /// Name of the photograph; unique in a scene.
    pub name: String,
    /// The camera of the pixels that [`ViewSource::load`] gives.
    pub camera: PinholeCamera,
    /// World to camera.
    pub pose: Pose,
    /// Range up to which there is nothing but water before it ([`crate::floaters::clear_ranges`]), scene units; 0 where nobody
    /// knows.
    pub clear_range: f32,
}

/// Pixels as the GPU takes them: one u32 a pixel, R in the lowest byte, sRGB, 8 bit.
///
/// The highest byte is the mask: 255 counts in the loss, 0 is ignored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedImage {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Row-major from the top left, `width * height` entries.
    pub pixels: Vec<u32>,
}

/// Where pixels come from: a cache on a worker, a folder, a test.
pub trait ViewSource: Send + Sync {
    /// All views, in the order that seeds refer to (sorted by name).
    fn views(&self) -> &[TrainView];

    /// The pixels of view `index` at the size of its camera.
    ///
    /// # Errors
    /// When the photograph cannot be read; the message names the file.
    fn load(&self, index: usize) -> Result<Arc<PackedImage>>;

    /// How often each view is to be seen against the others, above 0; `None` where all are seen alike.
    fn weights(&self) -> Option<&[f32]> {
        None
    }
}

/// Views that are not all seen alike.
pub struct Weighted {
    source: Arc<dyn ViewSource>,
    weights: Vec<f32>,
}

impl Weighted {
    /// `weights` holds one finite number above 0 for each view of `source`.
    ///
    /// # Errors
    /// When it does not.
    pub fn new(source: Arc<dyn ViewSource>, weights: Vec<f32>) -> Result<Self> {
        let sound = |weight: &f32| *weight > 0.0 && weight.is_finite();
        if weights.len() != source.views().len() || !weights.iter().all(sound) {
            return Err(CoreError::Config(format!(
                "{} weights, which must be finite and above 0, for {} views",
                weights.len(),
                source.views().len()
            )));
        }
        Ok(Self { source, weights })
    }
}

impl ViewSource for Weighted {
    fn views(&self) -> &[TrainView] {
        self.source.views()
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        self.source.load(index)
    }

    fn weights(&self) -> Option<&[f32]> {
        Some(&self.weights)
    }
}

/// Photographs in memory.
#[derive(Clone, Debug, Default)]
pub struct InMemory {
    /// The views.
    pub views: Vec<TrainView>,
    /// The photograph of each view, of the size of its camera.
    pub images: Vec<Arc<PackedImage>>,
}

impl InMemory {
    /// Every photograph all of one colour.
    pub fn plain(views: Vec<TrainView>, pixel: u32) -> Self {
        let plain = |view: &TrainView| {
            let (width, height) = (view.camera.width, view.camera.height);
            Arc::new(PackedImage { width, height, pixels: vec![pixel; width as usize * height as usize] })
        };
        let images = views.iter().map(plain).collect();
        Self { views, images }
    }
}

impl ViewSource for InMemory {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        Ok(Arc::clone(&self.images[index]))
    }
}
