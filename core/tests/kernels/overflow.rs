//! Conditions that must not change a result: rubbish in buffers, short lists, other blocks, broken
//! neighbours.

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{
    Blocks, Frame, Gpu, GpuOptions, Overflow, Recorder, Renderer, block_capacity, counter, spatial_order,
};
use fathom_twins::samples;

use crate::device::{assert_same_bits, layouts, poison};
use crate::view::{ImageGradients, Scene, View, gradients_only, hard_scenes};

#[test]
fn rubbish_in_every_buffer_changes_no_byte() {
    for gpu in layouts() {
        for scene in hard_scenes(71, 300, 3) {
            let mut view = View::render(&gpu, &scene);
            let v = ImageGradients::random(72, view.pixels());
            let slots = view.backward(&v, &gradients_only());
            let before = (view.image(), view.range_image(), view.parameter_gradients());
            for buffer in view.frame.scratch() {
                poison(&gpu, buffer);
            }
            view.forward();
            let slots_after = view.backward(&v, &gradients_only());
            assert_same_bits(&format!("{}: image", scene.name), &before.0, &view.image());
            assert_same_bits(&format!("{}: range", scene.name), &before.1, &view.range_image());
            assert_same_bits(&format!("{}: slots", scene.name), &slots, &slots_after);
            assert_eq!(before.2, view.parameter_gradients(), "{}", scene.name);
        }
    }
}

#[test]
fn checks_at_run_time_change_no_byte() {
    let devices = layouts();
    let Some(unchecked) = devices.last() else { return };
    // Of its own, because devices of a release build have no checks.
    let options = GpuOptions { allow_cpu: true, shader_checks: Some(true), ..Default::default() };
    let checked = &Gpu::with_layout(options, unchecked.layout()).unwrap();
    assert!(checked.shader_checks() && !unchecked.shader_checks());
    for scene in hard_scenes(74, 300, 3) {
        let views = [checked, unchecked].map(|gpu| View::render(gpu, &scene));
        let v = ImageGradients::random(75, views[0].pixels());
        let slots = views.each_ref().map(|view| view.backward(&v, &gradients_only()));
        assert_same_bits(&format!("{}: image", scene.name), &views[0].image(), &views[1].image());
        assert_same_bits(&format!("{}: slots", scene.name), &slots[0], &slots[1]);
        assert_eq!(views[0].parameter_gradients(), views[1].parameter_gradients(), "{}", scene.name);
    }
}

#[test]
fn a_short_list_reports_its_need_and_stops_later_frames() {
    for gpu in layouts() {
        let scene = &hard_scenes(73, 300, 0)[0];
        let ample = View::render(&gpu, scene);
        let (visible, intersections) =
            (ample.counter(counter::VISIBLE) as u32, ample.counter(counter::INTERSECTIONS) as u32);
        assert!(visible > 100 && intersections > 1000);

        let mut view = View::render(&gpu, scene);
        let uniform = |iteration| fathom_core::gpu::FrameUniform { iteration, ..view.uniform };
        let frames = [uniform(5), uniform(6), uniform(7)];
        let run = |frame: &Frame| {
            for uniform in &frames {
                let mut recorder = Recorder::new(&gpu);
                frame.record_forward(&gpu, &mut recorder, &ample.blocks, uniform).unwrap();
                recorder.submit();
            }
            frame.overflow(&gpu).unwrap()
        };
        let mut frame = Frame::new(&gpu, 300, 1, 1).unwrap();
        frame.prepare_targets(&gpu, view.uniform.size).unwrap();
        assert_eq!(run(&frame), Some(Overflow { failed_at: 5, visible, intersections: 0 }));
        // Work that was queued after the failure rendered nothing and kept the first failure.
        let counters: Vec<u32> = gpu.read(&frame.counters, 0, 3).unwrap();
        assert_eq!(counters[counter::VISIBLE as usize..], [0, 0]);

        frame.grow(&gpu, Overflow { failed_at: 5, visible, intersections: 0 }).unwrap();
        let second = run(&frame);
        assert_eq!(second, Some(Overflow { failed_at: 5, visible: 0, intersections }));

        frame.grow(&gpu, second.unwrap()).unwrap();
        assert_eq!(run(&frame), None);
        view.frame = frame;
        assert_same_bits("image", &ample.image(), &view.image());
        assert_same_bits("range", &ample.range_image(), &view.range_image());
        let v = ImageGradients::random(74, view.pixels());
        let gradients = |view: &View| {
            view.backward(&v, &gradients_only());
            view.parameter_gradients()
        };
        assert_eq!(gradients(&ample), gradients(&view));
    }
}

#[test]
fn lists_that_just_fit_do_not_overflow() {
    for gpu in layouts() {
        let scene = &hard_scenes(75, 200, 0)[0];
        let mut view = View::render(&gpu, scene);
        let image = view.image();
        let (visible, intersections) =
            (view.counter(counter::VISIBLE) as u32, view.counter(counter::INTERSECTIONS) as u32);
        view.frame = Frame::new(&gpu, 200, visible, intersections).unwrap();
        view.frame.prepare_targets(&gpu, view.uniform.size).unwrap();
        view.forward();
        assert_same_bits("image", &image, &view.image());
    }
}

/// Gaussians `from..to` of the model.
fn part(model: &Gaussians, from: usize, to: usize) -> Gaussians {
    let mut part = Gaussians::empty(model.sh_degree);
    (from..to).for_each(|index| part.push_from(model, index));
    part
}

#[test]
fn blocks_and_frozen_context_give_the_bytes_of_one_block() {
    for gpu in layouts() {
        for scene in hard_scenes(76, 301, 2) {
            let n = scene.model.len();
            let (half, most) = (n / 3, 2 * n / 3);
            let whole = View::render(&gpu, &scene);
            let mut blocks = Blocks::new(&gpu, 2).unwrap();
            for (from, to) in [(0, half), (half, most)] {
                blocks
                    .push_trainable(&gpu, &part(&scene.model, from, to), (to - from) as u32, Moments::F32)
                    .unwrap();
            }
            for (from, to) in [(most, most + 1), (most + 1, n)] {
                let part = part(&scene.model, from, to);
                blocks.push_frozen(&gpu, &part, &spatial_order(&part)).unwrap();
            }
            let parts = View::render_blocks(&gpu, &scene, blocks);
            assert_same_bits(&format!("{}: image", scene.name), &whole.image(), &parts.image());
            assert_same_bits(&format!("{}: range", scene.name), &whole.range_image(), &parts.range_image());
            assert_eq!(whole.tile_lists(), parts.tile_lists(), "{}", scene.name);
            let v = ImageGradients::random(77, whole.pixels());
            let (all, some) = (whole.backward(&v, &gradients_only()), parts.backward(&v, &gradients_only()));
            assert_same_bits(&format!("{}: slots", scene.name), &all, &some);
            let (all, some) = (whole.parameter_gradients(), parts.parameter_gradients());
            assert_eq!(some.len(), most);
            for index in 0..most {
                for parameter in 0..all.parameters() {
                    let (a, b) = (all.parameter(index, parameter), some.parameter(index, parameter));
                    assert_eq!(a.to_bits(), b.to_bits(), "{}: parameter {parameter} of {index}", scene.name);
                }
            }
        }
    }
}

#[test]
fn an_empty_block_takes_nothing_from_the_block_before_it() {
    for gpu in layouts() {
        let scene = Scene::new("room to grow", samples::random(78, 200, 0), 75, 53);
        let whole = View::render(&gpu, &scene);
        // The cap needs a second block, which has no Gaussian yet.
        let mut blocks = Blocks::new(&gpu, 0).unwrap();
        blocks.push_trainable(&gpu, &scene.model, block_capacity(Moments::F32) + 64, Moments::F32).unwrap();
        assert_eq!(blocks.iter().len(), 2);
        let mut roomy = View::prepare(&gpu, &scene, blocks);
        // Lists are sized by the cap, as in a trainer, not by the count; entries beyond the count are
        // rubbish.
        roomy.frame = Frame::new(&gpu, 1024, 1024, 16_384).unwrap();
        roomy.frame.prepare_targets(&gpu, roomy.uniform.size).unwrap();
        for rubbish in [0_u32, 0x7FFF_FFFF] {
            gpu.write(&roomy.frame.flags, 0, &[rubbish; 1024]);
            roomy.forward();
            assert_same_bits("image", &whole.image(), &roomy.image());
            let args: Vec<[u32; 3]> =
                gpu.read(&roomy.frame.args, u64::from(counter::ARGS_BLOCK) * 12, 2).unwrap();
            let groups = (whole.counter(counter::VISIBLE) as u32).div_ceil(64);
            assert_eq!(args[0][0] * args[0][1] * args[0][2], groups, "groups of the full block");
            assert_eq!(args[1][0] * args[1][1] * args[1][2], 0, "groups of the empty block");
            let v = ImageGradients::random(79, whole.pixels());
            whole.backward(&v, &gradients_only());
            roomy.backward(&v, &gradients_only());
            let (all, some) = (whole.parameter_gradients(), roomy.parameter_gradients());
            assert_eq!(all, some);
            assert!(all.means.iter().any(|mean| mean[0] != 0.0));
            let (_, _, training) = roomy.blocks.trainable().nth(1).unwrap();
            let moments: Vec<f32> = gpu.read(&training.moments, 0, 24 * 64).unwrap();
            assert!(moments.iter().all(|&value| value == 0.0), "the empty block must not be written");
        }
    }
}

#[test]
fn broken_gaussians_change_nothing_of_the_others() {
    for gpu in layouts() {
        for degree in [0, 3] {
            let sound = samples::random(80, 150, degree);
            let (broken, faults) = samples::degenerate(degree);
            // Broken Gaussians before, between and after the sound ones.
            let mut mixed = Gaussians::empty(degree);
            let mut place = Vec::new();
            for index in 0..sound.len() {
                if index % 11 == 0 && index / 11 < faults.len() {
                    mixed.push_from(&broken, index / 11);
                }
                place.push(mixed.len());
                mixed.push_from(&sound, index);
            }
            (0..faults.len()).for_each(|fault| mixed.push_from(&broken, fault));
            let (clean, dirty) = (Scene::new("sound", sound, 75, 53), Scene::new("mixed", mixed, 75, 53));
            let (clean, dirty) = (View::render(&gpu, &clean), View::render(&gpu, &dirty));
            assert_same_bits("image", &clean.image(), &dirty.image());
            assert_same_bits("range", &clean.range_image(), &dirty.range_image());
            let v = ImageGradients::random(81, clean.pixels());
            clean.backward(&v, &gradients_only());
            dirty.backward(&v, &gradients_only());
            let (a, b) = (clean.parameter_gradients(), dirty.parameter_gradients());
            let mut sound_places = vec![false; b.len()];
            for (index, &at) in place.iter().enumerate() {
                sound_places[at] = true;
                for parameter in 0..a.parameters() {
                    let (clean, dirty) = (a.parameter(index, parameter), b.parameter(at, parameter));
                    assert_eq!(
                        clean.to_bits(),
                        dirty.to_bits(),
                        "parameter {parameter} of {index}, degree {degree}"
                    );
                }
            }
            for at in (0..b.len()).filter(|&at| !sound_places[at]) {
                for parameter in 0..b.parameters() {
                    assert_eq!(
                        b.parameter(at, parameter),
                        0.0,
                        "broken Gaussian {at}: gradient of parameter {parameter}"
                    );
                }
            }
        }
    }
}

#[test]
fn each_kind_of_broken_gaussian_leaves_the_background_alone() {
    for gpu in layouts() {
        let (broken, faults) = samples::degenerate(1);
        for (index, fault) in faults.iter().enumerate() {
            let scene = Scene::new(fault, part(&broken, index, index + 1), 20, 20);
            let view = View::render(&gpu, &scene);
            let [r, g, b] = scene.background;
            assert!(view.image().iter().all(|pixel| *pixel == [r, g, b, 0.0]), "{fault}");
        }
    }
}

#[test]
fn a_renderer_grows_its_lists_and_forgets_the_previous_view() {
    for gpu in layouts() {
        // Huge splats in many tiles exceed the initial intersection lists of a renderer.
        let scene = Scene::new("huge", samples::huge(82, 400, 0), 128, 96);
        let expected = View::render(&gpu, &scene);
        assert!(expected.counter(counter::INTERSECTIONS) > 4096, "the scene must overflow the first lists");
        let mut renderer = Renderer::new(std::sync::Arc::clone(&gpu), &scene.model).unwrap();
        for _ in 0..2 {
            let rendered = renderer.render(&scene.camera, &scene.pose, scene.background).unwrap();
            let image: Vec<[f32; 3]> = expected.image().iter().map(|p| [p[0], p[1], p[2]]).collect();
            assert_same_bits("image", &image, &rendered.rgb);
            assert_same_bits("range", &expected.range_image(), &rendered.range);
            // A picture of another size in between.
            let small = scene.camera.resized(33, 20);
            assert_eq!(renderer.render(&small, &scene.pose, scene.background).unwrap().rgb.len(), 33 * 20);
        }
    }
}
