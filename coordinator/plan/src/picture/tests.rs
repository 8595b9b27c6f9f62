use fathom_core::config::JobConfig;
use fathom_core::scene::{PinholeCamera, Pose};

use super::*;
use crate::{PlanInput, plan};

fn views(count: u32) -> Vec<TrainView> {
    let camera = PinholeCamera { width: 40, height: 30, fx: 30.0, fy: 30.0, cx: 20.0, cy: 15.0 };
    (0..count)
        .map(|i| {
            let eye = DVec3::new(f64::from(i % 20), 0.0, f64::from(i / 20) * 2.0);
            TrainView {
                name: format!("{i:04}"),
                camera,
                pose: Pose::looking_at(eye, eye + DVec3::new(0.2, 0.3, 1.0), DVec3::Y),
                clear_range: 0.0,
            }
        })
        .collect()
}

fn drawn(columns: u32, rows: u32) -> (Plan, Vec<TrainView>, Vec<u8>) {
    let views = views(200);
    let points = Points {
        positions: (0..400u16).map(|i| [f32::from(i % 20), 1.0, f32::from(i / 20)]).collect(),
        colours: vec![[0; 3]; 400],
        ..Points::default()
    };
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (columns, rows);
    let plan = plan(&PlanInput { views: &views, points: &points, config: &config }).unwrap();
    let png = draw(&plan, &views, &points, "A test: 200 cameras").unwrap();
    (plan, views, png)
}

#[test]
fn cameras_have_their_partitions_colour_and_held_out_are_white() {
    let (plan, views, png) = drawn(3, 2);
    let picture = image::load_from_memory(&png).unwrap().to_rgb8();
    let map = Map::new(&plan, &views);
    let at = |view: u32| {
        let [x, y] = map.pixel(aligned_centre(&plan, &views[view as usize]));
        picture.get_pixel(x as u32, y as u32).0
    };
    let (mut own, mut all) = (0, 0);
    for partition in &plan.partitions {
        for &view in &partition.base_views {
            own += usize::from(at(view) == map.colour(partition));
            all += 1;
        }
    }
    // A label covers some cameras of each cell.
    assert!(own * 10 > all * 7, "{own} of {all} cameras have their colour");
    let white = plan.held_out.iter().filter(|&&view| at(view) == [255; 3]).count();
    assert!(white * 10 > plan.held_out.len() * 7, "{white} of {} held-out views", plan.held_out.len());
}

#[test]
fn a_plan_gives_the_same_bytes_and_any_grid_can_be_drawn() {
    assert_eq!(drawn(2, 2).2, drawn(2, 2).2);
    for (columns, rows) in [(1, 1), (1, 5), (7, 1), (12, 14)] {
        let png = drawn(columns, rows).2;
        assert_eq!(image::load_from_memory(&png).unwrap().width(), WIDTH, "{columns}x{rows}");
    }
}

#[test]
fn a_partition_with_few_of_its_own_cameras_can_be_drawn() {
    let (mut plan, views, _) = drawn(2, 1);
    let partition = &mut plan.partitions[0];
    // As the choice by contribution may leave it.
    partition.chosen_views = vec![partition.base_views[0], plan.held_out[0]];
    partition.chosen_views.sort_unstable();
    assert_eq!(counts(partition), "1 + 1");
    let png = draw(&plan, &views, &Points::default(), "A test").unwrap();
    assert_eq!(image::load_from_memory(&png).unwrap().width(), WIDTH);
}

#[test]
fn the_scale_bar_has_a_round_length_below_its_room() {
    for (longest, expected) in [(37.0, 20.0), (5.0, 5.0), (0.19, 0.1), (999.0, 500.0), (1.0, 1.0)] {
        assert!((legend::round_length(longest) - expected).abs() < 1e-12 * expected, "{longest}");
    }
}

#[test]
fn large_numbers_are_grouped() {
    assert_eq!([0, 999, 1000, 1_234_567].map(legend::grouped), ["0", "999", "1,000", "1,234,567"]);
}
