//! The counts and times of benchmarks.

use std::sync::atomic::{AtomicU32, Ordering};

use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{KernelTime, Recorder};
use fathom_twins::samples;

use crate::device::device;
use crate::view::{Scene, View};

/// Gaussians of this opacity in a row along the view, each wider than the picture.
fn stack(count: usize, opacity_logit: f32) -> Scene {
    let mut model = Gaussians::empty(0);
    for i in 0..count {
        model.means.push([0.0, 0.0, 0.01 * i as f32]);
        model.quats.push([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.push([2.0; 3]);
        model.opacity_logits.push(opacity_logit);
        model.sh_coeffs.push([0.5; 3]);
    }
    Scene::new("stack", model, 75, 53)
}

#[test]
fn evaluations_count_whole_tiles_and_are_needed_until_rays_end() {
    let Some(gpu) = device() else { return };
    let count = 60;
    for (opacity_logit, ends) in [(-4.0, false), (10.0, true)] {
        let view = View::render(&gpu, &stack(count, opacity_logit));
        let work = view.frame.workload(&gpu, &view.uniform).unwrap();
        let tiles = view.uniform.tile_count();
        let all = u64::from(tiles * gpu.tile() * gpu.tile()) * count as u64;
        assert_eq!((work.visible, work.intersections), (count as u32, tiles * count as u32));
        assert_eq!(work.listed_evaluations, all);
        if ends {
            // Opacity 0.99995: a ray ends after two or three of the sixty.
            assert!(work.needed_evaluations > 0 && work.needed_evaluations <= all / 20, "{work:?}");
        } else {
            assert_eq!(
                work.needed_evaluations, all,
                "at least a third of the light passes the last Gaussian"
            );
        }
    }
}

/// A clock that advances by one tick at each reading.
fn ticking() -> f64 {
    static TICKS: AtomicU32 = AtomicU32::new(0);
    f64::from(TICKS.fetch_add(1, Ordering::Relaxed))
}

#[test]
fn a_stepped_recording_gives_the_bytes_of_one_submission() {
    let Some(gpu) = device() else { return };
    let scene = Scene::new("random", samples::random(5, 300, 2), 75, 53);
    let view = View::render(&gpu, &scene);
    let image = view.image();
    let run = |mut recorder: Recorder<'_>| -> Vec<KernelTime> {
        gpu.write(&view.frame.targets().unwrap().image, 0, &vec![[7.0_f32; 4]; view.pixels()]);
        view.frame.record_forward(&gpu, &mut recorder, &view.blocks, &view.uniform).unwrap();
        let times = recorder.submit_timed().unwrap();
        assert!(view.image() == image, "the pictures must be the same");
        times
    };
    let stepped = run(Recorder::stepped(&gpu, ticking));
    assert!(stepped.iter().any(|time| time.kernel == "sort_scatter" && time.dispatches > 1), "{stepped:?}");
    for time in &stepped {
        assert_eq!(time.seconds, f64::from(time.dispatches), "{}: one tick per dispatch", time.kernel);
    }
    if gpu.has_timestamps() {
        let names =
            |times: &[KernelTime]| -> Vec<_> { times.iter().map(|t| (t.kernel, t.dispatches)).collect() };
        assert_eq!(names(&stepped), names(&run(Recorder::timed(&gpu))));
    }
}
