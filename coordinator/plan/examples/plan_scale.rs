//! Time and memory of a plan of a large survey, synthetic: lawn-mower lines over an undulating sea floor.
//!
//! ```text
//! cargo run --example plan_scale -- [CAMERAS] [POINTS] [COLUMNSxROWS|auto] [down|ahead]
//! ```
//! 100,000 cameras, 10 million points and 16x16 by default, as in a survey of a square kilometre. With
//! `ahead`, cameras look along their lines, like a vehicle's: their images show many cells, down-looking ones
//! show few.

use std::process::ExitCode;
use std::time::Instant;

use fathom_core::config::JobConfig;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use fathom_plan::{Balance, Plan, PlanInput, picture, plan};
use glam::DVec3;
use rayon::prelude::*;

/// Side of the survey, metres.
const SIDE: f64 = 1000.0;
/// Height above the floor, metres.
const HEIGHT: f64 = 6.0;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let argument =
        |index: usize, default: &str| arguments.get(index).map_or(default, |a| a.as_str()).to_owned();
    let (Ok(cameras), Ok(points)) = (argument(0, "100000").parse(), argument(1, "10000000").parse()) else {
        eprintln!("plan_scale [CAMERAS] [POINTS] [COLUMNSxROWS|auto] [down|ahead]");
        return ExitCode::FAILURE;
    };
    let mut config = JobConfig::default();
    let grid = argument(2, "16x16");
    match grid.split_once('x').map(|(columns, rows)| (columns.parse(), rows.parse())) {
        Some((Ok(columns), Ok(rows))) => (config.partition.columns, config.partition.rows) = (columns, rows),
        _ => (config.partition.auto, config.partition.workers) = (true, 8),
    }

    let (views, points) = (survey(cameras, argument(3, "down") == "ahead"), floor(points));
    println!("made {} cameras and {} points, {} in memory", views.len(), points.len(), memory());
    let begin = Instant::now();
    match plan(&PlanInput { views: &views, points: &points, config: &config }) {
        Ok(plan) => {
            println!("planned in {:.1} s, at most {} in memory", begin.elapsed().as_secs_f64(), memory());
            describe(&plan);
            let begin = Instant::now();
            let drawn = picture::draw(&plan, &views, &points, "A synthetic survey");
            let bytes = drawn.map_or(0, |png| png.len());
            println!(
                "drawn in {:.1} s, {bytes} bytes, at most {} in memory",
                begin.elapsed().as_secs_f64(),
                memory()
            );
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn describe(plan: &Plan) {
    let chosen: usize = plan.partitions.iter().map(|partition| partition.chosen_views.len()).sum();
    let Balance { cameras, points, seconds, bytes } = plan.balance;
    println!("{} partitions, {}", plan.partitions.len(), plan.cut.reason);
    println!(
        "{chosen} cameras in all of them; largest / mean: cameras {cameras:.2}, points {points:.2}, time {seconds:.2}, memory {bytes:.2}"
    );
}

/// Lines along x, a picture every few metres, headings alternating.
fn survey(count: u32, ahead: bool) -> Vec<TrainView> {
    let camera = PinholeCamera { width: 1600, height: 1200, fx: 1300.0, fy: 1300.0, cx: 800.0, cy: 600.0 };
    let lines = f64::from(count).sqrt().ceil() as u32;
    (0..count)
        .into_par_iter()
        .map(|i| {
            let (line, step) = (i / lines, i % lines);
            let heading = if line % 2 == 0 { 1.0 } else { -1.0 };
            let along = SIDE * (0.5 + heading * (f64::from(step) / f64::from(lines) - 0.5));
            let shake = |k: u32| f64::from(uniform_at(3, Stream::Test, i, k)) - 0.5;
            let eye = DVec3::new(
                along + shake(0),
                -HEIGHT + shake(1),
                SIDE * f64::from(line) / f64::from(lines) + shake(2),
            );
            let forward = DVec3::X * heading;
            let pose = if ahead {
                Pose::looking_at(eye, eye + forward + DVec3::Y * 0.4, DVec3::Y)
            } else {
                Pose::looking_at(eye, eye + DVec3::new(0.1 * shake(3), 1.0, 0.1 * shake(4)), -forward)
            };
            TrainView { name: format!("{i:07}.jpg"), camera, pose, clear_range: 0.0 }
        })
        .collect()
}

fn floor(count: u32) -> Points {
    let positions = (0..count)
        .into_par_iter()
        .map(|i| {
            let draw = |k: u32| uniform_at(4, Stream::Test, i, k) * SIDE as f32;
            let (x, z) = (draw(0), draw(1));
            [x, (x * 0.05).sin() + (z * 0.03).cos(), z]
        })
        .collect();
    Points { positions, colours: vec![[128; 3]; count as usize], ..Points::default() }
}

/// Peak memory of this process, as Linux counts it.
fn memory() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or(" unknown");
    line.trim().to_owned()
}
