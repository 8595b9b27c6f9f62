//! Culling by chunks: it must skip most chunks that a view does not see, and none that it sees.

use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Blocks, CULL_CHUNK, FrameUniform, Gpu, spatial_order};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_twins::samples::{self, off_centre_view};
use glam::DVec3;

use crate::device::{assert_same_bits, layouts};
use crate::view::{Scene, View};

const COUNT: usize = 8 * CULL_CHUNK as usize;

/// Cameras outside and inside a box of side 2, with wide and narrow angles; one looks away from it.
fn cameras() -> Vec<(&'static str, PinholeCamera, Pose)> {
    let (wide, pose) = off_centre_view(75, 53, 3.0);
    let narrow = PinholeCamera { fx: 12.0 * wide.fx, fy: 12.0 * wide.fy, ..wide };
    let looking = |eye: DVec3, at: DVec3| Pose::looking_at(eye, at, DVec3::Y);
    vec![
        ("all of it", wide, pose),
        ("a narrow angle", narrow, looking(DVec3::new(0.5, 0.6, -3.0), DVec3::new(0.5, 0.5, 0.0))),
        ("from inside", wide, looking(DVec3::new(0.1, 0.2, 0.3), DVec3::new(1.0, 0.1, 0.4))),
        ("narrow from inside", narrow, looking(DVec3::new(-0.3, 0.1, 0.0), DVec3::new(-0.9, 0.5, 0.2))),
        ("looking away", wide, looking(DVec3::new(0.0, 0.1, -4.0), DVec3::new(0.0, 0.2, -9.0))),
    ]
}

/// Visible Gaussians, and the number of chunks that the culling kept.
fn visible(gpu: &Gpu, view: &View) -> (Vec<usize>, u32) {
    let chunks = |block: &fathom_core::gpu::Block| -> u32 {
        gpu.read::<u32>(&block.chunk_seen, 0, block.chunks() as usize).unwrap().iter().sum()
    };
    (view.visible(), view.blocks.iter().map(chunks).sum())
}

#[test]
fn bounds_skip_many_chunks_and_nothing_visible() {
    type Make = fn(u32, usize, u8) -> Gaussians;
    let models: [(&str, Make); 4] = [
        ("random", samples::random),
        ("needles", samples::needles),
        ("huge", samples::huge),
        ("beyond the border", samples::beyond_the_border),
    ];
    for gpu in layouts() {
        for (kind, make) in models {
            let mut model = make(31, COUNT, 0);
            // Most Gaussians are small, so that chunks have limited bounds.
            model.log_scales.iter_mut().for_each(|scales| *scales = scales.map(|s| s - 2.5));
            // Both blocks use the same order, because it decides the blending of Gaussians of equal depth.
            let mut ordered = Gaussians::empty(0);
            spatial_order(&model).iter().for_each(|&index| ordered.push_from(&model, index as usize));
            let model = ordered;
            let order: Vec<u32> = (0..COUNT as u32).collect();
            let mut blocks = Blocks::new(&gpu, 0).unwrap();
            blocks.push_frozen(&gpu, &model, &order).unwrap();
            let mut bounded =
                View::prepare_lists(&gpu, &Scene::new(kind, model.clone(), 75, 53), blocks, 1 << 20);
            let mut blocks = Blocks::new(&gpu, 0).unwrap();
            blocks.push_trainable(&gpu, &model, COUNT as u32, Default::default()).unwrap();
            let mut all = View::prepare_lists(&gpu, &Scene::new(kind, model, 75, 53), blocks, 1 << 20);
            for (name, camera, pose) in cameras() {
                let uniform = FrameUniform::of_camera(&camera, &pose, gpu.tile());
                // A band of the picture has its own rectangle.
                for uniform in [uniform, uniform.bands(3, gpu.tile())[1]] {
                    (bounded.uniform, all.uniform) = (uniform, uniform);
                    bounded.forward();
                    all.forward();
                    let (seen, chunks) = visible(&gpu, &bounded);
                    let (expected, every) = visible(&gpu, &all);
                    assert_eq!(seen, expected, "{kind}, {name}");
                    assert_eq!(every, 8);
                    if kind == "random" && name == "a narrow angle" {
                        assert!((1..=5).contains(&chunks), "{name}: {chunks} of 8 chunks");
                    }
                    if name == "looking away" && kind == "random" {
                        assert_eq!((chunks, seen.len()), (0, 0));
                    }
                }
                if kind == "random" {
                    assert_same_bits("image", &all.image(), &bounded.image());
                }
            }
        }
    }
}
