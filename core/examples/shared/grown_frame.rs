//! A frame whose lists hold what a view needs.

use std::error::Error;

use fathom_core::gpu::{Blocks, Frame, FrameUniform, Gpu, Recorder};

/// A frame after one forward pass over `view`, with lists that were grown until everything fitted.
///
/// # Errors
/// When the lists would be longer than the adapter can bind, or the device fails.
pub fn grown_frame(gpu: &Gpu, blocks: &Blocks, view: &FrameUniform) -> Result<Frame, Box<dyn Error>> {
    let n = blocks.total();
    let mut frame = Frame::new(gpu, n, n, n.saturating_mul(8))?;
    loop {
        frame.prepare_targets(gpu, view.size)?;
        let mut recorder = Recorder::new(gpu);
        frame.record_forward(gpu, &mut recorder, blocks, view)?;
        recorder.submit();
        let Some(overflow) = frame.overflow(gpu)? else { return Ok(frame) };
        if !overflow.fits(frame.limits()) {
            return Err(format!("{n} Gaussians need longer lists than can be bound: {overflow:?}").into());
        }
        frame.grow(gpu, overflow)?;
    }
}
