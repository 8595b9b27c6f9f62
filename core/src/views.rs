//! Photographs as a renderer and a trainer need them: pinhole, pose and packed pixels.

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
    /// Range in front of the camera that holds nothing but water ([`crate::floaters::clear_ranges`]), scene
    /// units; 0 if unknown.
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

/// What the rays of a view end on, for each cell of its picture.
#[derive(Clone, Debug, PartialEq)]
pub struct RayMap {
    /// Cells across.
    pub columns: u32,
    /// Cells down.
    pub rows: u32,
    /// Row-major from the top left, `columns * rows` entries. A pixel is in column
    /// `floor(x * columns / width)` of the cells, where x is its column and `width` the picture's; rows
    /// likewise.
    pub cells: Vec<EndsOn>,
    /// Range of the sparse points that the view sees in the cell, scene units; 0 if there are none, or if
    /// their ranges differ much.
    pub ranges: Vec<f32>,
    /// Distance from the colour of open water beyond which a pixel of an [`EndsOn::Edge`] cell shows a
    /// surface, sRGB, 0 to 1 a channel.
    pub alike: f32,
}

impl RayMap {
    /// The map as the device reads it: [`EndsOn`] in the two lowest bits of the range.
    #[cfg(any(feature = "gpu", test))]
    pub(crate) fn packed(&self) -> Vec<u32> {
        self.cells
            .iter()
            .zip(&self.ranges)
            .map(|(cell, range)| (range.to_bits() & !3) | *cell as u32)
            .collect()
    }
}

/// What a ray ends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u32)]
pub enum EndsOn {
    /// Not known.
    #[default]
    Unknown = 0,
    /// A surface.
    Surface = 1,
    /// Nothing: open water.
    Open = 2,
    /// Some rays end on a surface and the others on nothing: the colour of each pixel decides.
    Edge = 3,
}

/// Source of views and their pixels: a cache on a worker, a folder, a test.
pub trait ViewSource: Send + Sync {
    /// All views, in the order that seeds refer to (sorted by name).
    fn views(&self) -> &[TrainView];

    /// The pixels of view `index` at the size of its camera.
    ///
    /// # Errors
    /// When the photograph cannot be read; the message names the file.
    fn load(&self, index: usize) -> Result<Arc<PackedImage>>;

    /// What the rays of view `index` end on; `None` if unknown.
    fn map(&self, index: usize) -> Option<&RayMap> {
        let _ = index;
        None
    }

    /// How often each view is trained on relative to the others, above 0; `None` if all views are used
    /// equally.
    fn weights(&self) -> Option<&[f32]> {
        None
    }
}

/// Views that are trained on with different frequency.
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
                "{} weights for {} views; each view needs one finite weight above 0",
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

    fn map(&self, index: usize) -> Option<&RayMap> {
        self.source.map(index)
    }

    fn weights(&self) -> Option<&[f32]> {
        Some(&self.weights)
    }
}

/// Views with a map of what their rays end on.
pub struct Mapped {
    source: Arc<dyn ViewSource>,
    maps: Vec<RayMap>,
}

impl Mapped {
    /// `maps` holds one for each view of `source`.
    ///
    /// # Errors
    /// When it does not, or when a map does not hold `columns * rows` cells.
    pub fn new(source: Arc<dyn ViewSource>, maps: Vec<RayMap>) -> Result<Self> {
        let sound = |map: &RayMap| {
            let cells = u64::from(map.columns) * u64::from(map.rows);
            map.cells.len() as u64 == cells && map.ranges.len() as u64 == cells
        };
        if maps.len() != source.views().len() || !maps.iter().all(sound) {
            return Err(CoreError::Config(format!(
                "{} maps for {} views; each view needs one with columns * rows cells",
                maps.len(),
                source.views().len()
            )));
        }
        Ok(Self { source, maps })
    }
}

impl ViewSource for Mapped {
    fn views(&self) -> &[TrainView] {
        self.source.views()
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        self.source.load(index)
    }

    fn map(&self, index: usize) -> Option<&RayMap> {
        Some(&self.maps[index])
    }

    fn weights(&self) -> Option<&[f32]> {
        self.source.weights()
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
    /// Photographs of a single colour.
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
