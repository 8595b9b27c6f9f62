//! Previews: small pictures of held-out views while a run trains, for those who watch the job.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fathom_core::Result;
use fathom_core::config::TrainConfig;
use fathom_core::method::Run;
use fathom_core::metrics::psnr;
use fathom_core::picture::{encode_jpeg, prepared_camera};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::train::Preview;
use fathom_core::views::{PackedImage, ViewSource};

use super::TaskInput;

/// The first previews come this soon: a user wants to see at once that a scene is the right way up.
const FIRST_AFTER: Duration = Duration::from_secs(5);
/// Longest side of a picture, pixels.
const MOST_PIXELS: u32 = 480;
/// Pauses grow to this share of the time that the attempt has taken, so that a long run has few previews.
const OF_ELAPSED: u32 = 8;
/// Previews take at most this share of the time.
const OF_COST: u32 = 50;

/// A picture of a view.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The name of the view.
    pub view: String,
    /// As the camera sees it, a JPEG.
    pub render: Bytes,
    /// The same without the water, a JPEG; `None` where there is none.
    pub clear: Option<Bytes>,
    /// PSNR of the render against the photograph, dB; `None` without a photograph, or if they are equal.
    pub psnr_db: Option<f64>,
}

/// A view in previews.
struct PreviewedView {
    name: String,
    source: Option<Arc<dyn ViewSource>>,
    /// Read at the first preview, and kept: it is small.
    photograph: Option<Arc<PackedImage>>,
}

impl PreviewedView {
    fn psnr_db(&mut self, preview: &Preview) -> Option<f64> {
        if let Some(source) = self.source.take() {
            let read = source.load(0);
            self.photograph = read.inspect_err(|error| tracing::debug!(%error, "a preview has no PSNR")).ok();
        }
        let render = PackedImage::from_rgb8(preview.width, preview.height, &preview.render);
        Some(psnr(&render, self.photograph.as_ref()?)).filter(|psnr| psnr.is_finite())
    }
}

/// The previews of an attempt.
pub struct Previews {
    views: Vec<PreviewedView>,
    /// The camera of each.
    cameras: Vec<(PinholeCamera, Pose)>,
    every: Duration,
    begun: Instant,
    due: Instant,
}

impl Previews {
    /// Those that the task asks for. A view without a usable camera has none.
    pub fn of(task: &TaskInput, config: &TrainConfig) -> Self {
        let seen = |&index: &u32| {
            let view = task.manifest.views.get(index as usize)?;
            let camera = prepared_camera(task.manifest.camera(view.camera_id)?, MOST_PIXELS).ok()?;
            // Without its photograph a view has previews all the same.
            let source = task.views_of(&[index], &[], MOST_PIXELS, 0).ok();
            let seen = PreviewedView { name: view.name.clone(), source, photograph: None };
            Some((seen, (camera, view.pose)))
        };
        let wanted = config.preview_seconds > 0;
        let (views, cameras) = task.common.previews.iter().filter(|_| wanted).filter_map(seen).unzip();
        let every = Duration::from_secs(config.preview_seconds.into());
        let begun = Instant::now();
        Self { views, cameras, every, begun, due: begun + every.min(FIRST_AFTER) }
    }

    /// Makes the next ones due.
    #[cfg(test)]
    pub fn due_now(&mut self) {
        self.due = self.begun;
    }

    /// Makes those that are due, as long as `go_on` returns true. A failure ends them, and nothing else: the
    /// run goes on.
    pub fn make(&mut self, run: &mut dyn Run, go_on: &dyn Fn() -> bool) -> Option<Vec<Picture>> {
        let begin = Instant::now();
        if self.cameras.is_empty() || begin < self.due {
            return None;
        }
        let made = run.preview(&self.cameras, go_on).and_then(|previews| {
            let picture = |(view, preview): (&mut PreviewedView, Preview)| -> Result<Picture> {
                let jpeg = |rgb: &[u8]| encode_jpeg(preview.width, preview.height, rgb).map(Bytes::from);
                let clear = preview.clear.as_deref().map(jpeg).transpose()?;
                let psnr_db = view.psnr_db(&preview);
                Ok(Picture { view: view.name.clone(), render: jpeg(&preview.render)?, clear, psnr_db })
            };
            self.views.iter_mut().zip(previews).map(picture).collect::<Result<Vec<_>>>()
        });
        let end = Instant::now();
        self.due = end + pause(self.every, end - self.begun, end - begin);
        made.inspect_err(|error| {
            tracing::warn!(%error, "no further previews of this attempt");
            self.cameras.clear();
        })
        .ok()
    }
}

/// The pause after previews that took `cost`, `elapsed` after the beginning.
fn pause(every: Duration, elapsed: Duration, cost: Duration) -> Duration {
    every.max(elapsed / OF_ELAPSED).max(cost * OF_COST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_run_has_few_previews_and_slow_ones_are_rare() {
        let every = Duration::from_secs(30);
        let previews = |hours: u64, cost: Duration| {
            let (mut at, mut count) = (every, 0);
            while at < Duration::from_secs(3600 * hours) {
                count += 1;
                at += cost + pause(every, at, cost);
            }
            count
        };
        assert!((20..40).contains(&previews(1, Duration::ZERO)), "{}", previews(1, Duration::ZERO));
        assert!(previews(24, Duration::ZERO) < 64, "{}", previews(24, Duration::ZERO));
        assert!(previews(1, Duration::from_secs(10)) <= 8, "{}", previews(1, Duration::from_secs(10)));
    }
}
