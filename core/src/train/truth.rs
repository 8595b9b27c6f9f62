//! Photographs at the sizes that training asks for.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use crate::Result;
use crate::picture::half;
use crate::views::{PackedImage, TrainView, ViewSource};

/// Bytes of reduced pictures that are kept; the full-size ones are the source's business.
const REDUCED_BYTES: usize = 512 << 20;

/// A view source with a bounded cache of reduced pictures.
pub(super) struct Truth {
    views: Arc<dyn ViewSource>,
    reduced: HashMap<(usize, u32), Arc<PackedImage>>,
    order: VecDeque<(usize, u32)>,
    bytes: usize,
}

impl Truth {
    pub(super) fn new(views: Arc<dyn ViewSource>) -> Self {
        Self { views, reduced: HashMap::new(), order: VecDeque::new(), bytes: 0 }
    }

    pub(super) fn views(&self) -> &[TrainView] {
        self.views.views()
    }

    /// View `index`, halved `level` times in linear light.
    pub(super) fn load(&mut self, index: usize, level: u32) -> Result<Arc<PackedImage>> {
        if level == 0 {
            return self.views.load(index);
        }
        if let Some(image) = self.reduced.get(&(index, level)) {
            return Ok(Arc::clone(image));
        }
        let image = Arc::new(half(&*self.load(index, level - 1)?));
        self.bytes += image.pixels.len() * 4;
        self.reduced.insert((index, level), Arc::clone(&image));
        self.order.push_back((index, level));
        while self.bytes > REDUCED_BYTES {
            let Some(oldest) = self.order.pop_front() else { break };
            if let Some(image) = self.reduced.remove(&oldest) {
                self.bytes -= image.pixels.len() * 4;
            }
        }
        Ok(image)
    }
}
