//! Previews of a task on a real device.

use super::super::previews::Previews;
use super::super::training::{Parts, parts_of_points};
use super::*;
use fathom_core::method;
use fathom_core::train::TrainRun;

#[test]
fn a_task_makes_the_previews_of_its_spec_when_they_are_due() {
    let Some(_) = executor("a_task_makes_the_previews_of_its_spec_when_they_are_due", None) else {
        return;
    };
    let gpu = fathom_core::gpu::device_for_test("previews").unwrap();
    let dir = tempfile::tempdir().unwrap();
    let mut input = task(dir.path(), 200).global();
    // The manifest has no view 9; a wrong index must not end the run.
    input.common.previews = vec![0, 2, 9];
    let config = input.train_config();
    let views = input.views(MIB).unwrap();
    let (Parts { focus, context, surfaces, medium, .. }, views) = parts_of_points(&input, views).unwrap();
    let extent = input.common.scene_extent;
    let run = TrainRun { config: config.clone(), extent, views, focus, context, surfaces, medium };
    let mut run = method::start(input.config.method, gpu, run).unwrap();
    run.advance(5).unwrap();

    let mut previews = Previews::of(&input, &config);
    assert!(previews.make(run.as_mut(), &|| true).is_none(), "they are not due at the beginning");
    previews.due_now();
    let pictures = previews.make(run.as_mut(), &|| true).unwrap();
    let names: Vec<&str> = pictures.iter().map(|picture| picture.view.as_str()).collect();
    assert_eq!(names, ["0.png", "2.png"]);
    for picture in &pictures {
        for jpeg in [Some(&picture.render), picture.clear.as_ref()].into_iter().flatten() {
            assert!(jpeg.starts_with(&[0xff, 0xd8]) && jpeg.ends_with(&[0xff, 0xd9]), "no JPEG");
        }
    }
    assert!(previews.make(run.as_mut(), &|| true).is_none(), "the next ones are due later");
    previews.due_now();
    let stopped = previews.make(run.as_mut(), &|| false).unwrap();
    assert!(stopped.is_empty(), "a task that must stop makes no picture");

    let off = TrainConfig { preview_seconds: 0, ..config };
    let mut none = Previews::of(&input, &off);
    none.due_now();
    assert!(none.make(run.as_mut(), &|| true).is_none());
}
