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
    let run =
        TrainRun { config: config.clone(), extent, views, focus, context, surfaces, medium, surface: None };
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
        // That of the held-out measurement at the same size.
        let index = if picture.view == "0.png" { 0 } else { 2 };
        let one = input.views_of(&[index], &[], 480, 0).unwrap();
        let measured = run.measure(one.as_ref(), &|| true).unwrap().unwrap().psnr_db;
        let shown = picture.psnr_db.unwrap();
        assert!((shown - measured).abs() < 0.5, "{}: {shown} dB, measured {measured} dB", picture.view);
    }
    assert!(previews.make(run.as_mut(), &|| true).is_none(), "the next ones are due later");
    previews.due_now();
    let stopped = previews.make(run.as_mut(), &|| false).unwrap();
    assert!(stopped.is_empty(), "a task that must stop makes no picture");

    // A photograph that was not fetched takes the PSNR alone.
    let fetched = std::mem::take(&mut input.files);
    let mut blind = Previews::of(&input, &config);
    blind.due_now();
    let pictures = blind.make(run.as_mut(), &|| true).unwrap();
    assert!(pictures.len() == 2 && pictures.iter().all(|picture| picture.psnr_db.is_none()));
    input.files = fetched;

    let off = TrainConfig { preview_seconds: 0, ..config };
    let mut none = Previews::of(&input, &off);
    none.due_now();
    assert!(none.make(run.as_mut(), &|| true).is_none());
}
