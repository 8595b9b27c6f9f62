//! Hostile input for the reader of `plan.json`.

use fathom_core::config::JobConfig;
use fathom_core::scene::{PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use fathom_fuzz::{Target, run};
use glam::DVec3;

use crate::{Plan, PlanInput, plan};

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;

#[test]
fn fuzzed_plans_are_read_or_refused() {
    let camera = PinholeCamera { width: 40, height: 30, fx: 30.0, fy: 30.0, cx: 20.0, cy: 15.0 };
    let view = |i: u32| {
        let eye = DVec3::new(f64::from(i % 12), -2.0, f64::from(i / 12));
        let pose = Pose::looking_at(eye, eye + DVec3::new(0.1, 1.0, 0.05), DVec3::Z);
        TrainView { name: format!("{i:02}.jpg"), camera, pose, clear_range: 0.0 }
    };
    let views: Vec<TrainView> = (0..48).map(view).collect();
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (2, 1);
    let input = PlanInput { views: &views, points: &Points::default(), config: &config };
    let mut small = plan(&input).unwrap();
    small.partitions.truncate(1);
    let read = |bytes: &[u8]| {
        let Ok(plan) = Plan::from_json(bytes) else { return false };
        // `fathom eval --plan` asks for them.
        let _ = plan.seam_lines(&JobConfig::default().seams);
        true
    };
    run(&Target::new("plan.json", vec![serde_json::to_vec(&small).unwrap()], &read));
}
