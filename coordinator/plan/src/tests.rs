use std::collections::{BTreeMap, BTreeSet};

use fathom_core::config::WaterConfig;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::seams::Axis;
use glam::DQuat;
use proptest::prelude::*;

use super::*;

mod auto;
mod border_stage;
mod by_weight;
mod faults;
mod neighbours;
mod turned;

const CAMERA: PinholeCamera =
    PinholeCamera { width: 640, height: 480, fx: 500.0, fy: 510.0, cx: 310.0, cy: 250.0 };

/// Random cameras 3 units above a sea floor of 20 x 20, looking forward and down.
fn survey(count: u32) -> Vec<TrainView> {
    (0..count)
        .map(|i| {
            let draw = |k: u32| f64::from(uniform_at(2, Stream::Test, i, k));
            let eye = DVec3::new(20.0 * draw(0), -3.0 + 0.3 * draw(1), 20.0 * draw(2));
            // Headings alternate as on lawn-mower lines, so that the cameras' down vectors cancel.
            let heading = if i / 2 % 2 == 0 { -1.0 } else { 1.0 };
            let ahead = DVec3::new(draw(3) - 0.5, 1.0, draw(4) - 0.5);
            TrainView {
                name: format!("view{i:05}"),
                camera: CAMERA,
                pose: Pose::looking_at(eye, eye + ahead, DVec3::new(0.0, 0.2, heading)),
                clear_range: 0.0,
            }
        })
        .collect()
}

fn floor(count: u32) -> Points {
    let draw = |i: u32, k: u32| uniform_at(4, Stream::Test, i, k);
    Points {
        positions: (0..count)
            .map(|i| [24.0 * draw(i, 0) - 2.0, 0.5 * draw(i, 1), 24.0 * draw(i, 2) - 2.0])
            .collect(),
        colours: vec![[0; 3]; count as usize],
        ..Points::default()
    }
}

/// Cameras at these places of the plane, all looking one way.
fn views_at(at: &[(i32, i32)]) -> Vec<TrainView> {
    let view = |(i, &(x, z)): (usize, &(i32, i32))| {
        let eye = DVec3::new(x.into(), 0.0, z.into());
        let pose = Pose::looking_at(eye, eye + DVec3::new(0.3, 0.1, 1.0), DVec3::Y);
        TrainView { name: format!("{i:03}"), camera: CAMERA, pose, clear_range: 0.0 }
    };
    at.iter().enumerate().map(view).collect()
}

fn config(columns: u32, rows: u32) -> JobConfig {
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (columns, rows);
    config
}

fn planned(views: &[TrainView], points: &Points, config: &JobConfig) -> Plan {
    plan(&PlanInput { views, points, config }).unwrap()
}

#[test]
fn under_water_the_plan_says_how_far_each_view_is_clear() {
    let (views, points) = (survey(40), floor(20_000));
    let plan_with = |change: fn(&mut JobConfig)| {
        let mut config = config(2, 1);
        change(&mut config);
        planned(&views, &points, &config)
    };
    let plan = plan_with(|_| {});
    assert_eq!(plan.clear_ranges.len(), views.len());
    for (view, range) in views.iter().zip(&plan.clear_ranges) {
        // The floor is 2.7 to 3.5 below; a view far outside of it may see too little.
        assert!(*range == 0.0 || (1.35..5.0).contains(range), "{}: {range}", view.name);
    }
    assert!(plan.held_out.iter().all(|view| plan.clear_ranges[*view as usize] == 0.0));
    assert!(plan.clear_ranges.iter().filter(|range| **range > 0.0).count() > 25);
    assert_eq!(Plan::from_json(&serde_json::to_vec(&plan).unwrap()).unwrap(), plan);
    assert!(plan_with(|config| config.water = WaterConfig::none()).clear_ranges.is_empty());
    assert!(plan_with(|config| config.water.floater_weight = 0.0).clear_ranges.is_empty());
}

// Fault 10 of the public code: test cameras are partitioned too.
#[test]
fn each_training_view_and_no_held_out_view_has_a_base_set() {
    let views = survey(203);
    let plan = planned(&views, &floor(500), &config(3, 2));
    let expected: Vec<u32> = (0..203).filter(|i| i % 8 == 0).collect();
    assert_eq!(plan.held_out, expected);
    let mut homes = BTreeMap::new();
    for partition in &plan.partitions {
        for &view in &partition.base_views {
            assert_eq!(homes.insert(view, partition.id), None, "view {view} has two homes");
        }
        for view in &partition.chosen_views {
            assert!(!plan.held_out.contains(view), "held-out view {view} in partition {}", partition.id);
        }
        assert!(partition.base_views.iter().all(|view| partition.chosen_views.contains(view)));
        assert!(partition.chosen_views.is_sorted() && partition.base_views.is_sorted());
    }
    assert_eq!(homes.keys().copied().collect::<Vec<_>>(), plan.training_views());
}

#[test]
fn held_out_views_change_nothing_wherever_they_are() {
    let views = survey(160);
    let mut moved = views.clone();
    for view in moved.iter_mut().step_by(8) {
        view.pose = Pose::looking_at(DVec3::splat(1e4), DVec3::ZERO, DVec3::Z);
        view.camera.width *= 3;
    }
    let (points, config) = (floor(500), config(2, 2));
    assert_eq!(planned(&views, &points, &config), planned(&moved, &points, &config));
}

#[test]
fn point_order_and_view_names_do_not_change_the_cut() {
    let mut views = survey(120);
    let mut points = floor(800);
    let mut config = config(3, 3);
    config.data.test_every = 0;
    let cut = |views: &[TrainView], points: &Points| -> Vec<(Rect, BTreeSet<[u64; 3]>, u64)> {
        let plan = planned(views, points, &config);
        plan.partitions
            .iter()
            .map(|p| {
                let centre = |&i: &u32| views[i as usize].pose.translation.to_array().map(f64::to_bits);
                (p.cell, p.chosen_views.iter().map(centre).collect(), p.focus_points)
            })
            .collect()
    };
    let before = cut(&views, &points);
    points.positions.reverse();
    let names: Vec<String> = views.iter().map(|view| view.name.clone()).collect();
    views.rotate_left(47);
    for (view, name) in views.iter_mut().zip(names) {
        view.name = name;
    }
    // The up axis is a mean over views in order of name, so borders may move in their last bits.
    for (a, b) in before.iter().zip(cut(&views, &points)) {
        assert_eq!((&a.1, a.2), (&b.1, b.2));
        for (a, b) in [(a.0.x.hi, b.0.x.hi), (a.0.z.hi, b.0.z.hi)] {
            assert!((a.unwrap_or(0.0) - b.unwrap_or(0.0)).abs() < 1e-9);
        }
    }
}

#[test]
fn a_plan_does_not_depend_on_the_number_of_threads() {
    let (views, points, config) = (survey(300), floor(1000), config(4, 3));
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let four = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
    let first = one.install(|| planned(&views, &points, &config));
    let second = four.install(|| planned(&views, &points, &config));
    assert_eq!(serde_json::to_vec(&first).unwrap(), serde_json::to_vec(&second).unwrap());
}

#[test]
fn a_plan_survives_json_to_the_last_bit() {
    let plan = planned(&survey(300), &floor(1000), &config(4, 3));
    let json = serde_json::to_string_pretty(&plan).unwrap();
    assert_eq!(serde_json::from_str::<Plan>(&json).unwrap(), plan);
}

#[test]
fn one_partition_takes_everything_and_needs_no_global_stage() {
    let (views, points, config) = (survey(100), floor(500), config(1, 1));
    let plan = planned(&views, &points, &config);
    let [only] = plan.partitions.as_slice() else { panic!("{} partitions", plan.partitions.len()) };
    assert_eq!(plan.global, None);
    assert_eq!(only.chosen_views, plan.training_views());
    assert_eq!((only.iterations, only.max_gaussians), (config.train.iterations, config.train.max_gaussians));
    assert_eq!((only.focus_points, only.r_focus), (500, 1.0));
    assert!(plan.keeps(only, [1e9, -1e9, 1e9]) && plan.focuses(only, [-1e9, 1e9, -1e9]));
    assert!(!plan.keeps(only, [f32::NAN, 0.0, 0.0]));
}

#[test]
fn the_visibility_test_tells_cells_apart() {
    // Fault 1 of the public code: with the scene's box for every cell, all cells choose alike.
    let plan = planned(&survey(600), &floor(3000), &config(4, 4));
    for a in &plan.partitions {
        assert!(a.chosen_views.len() < 450, "partition {} takes {} of 525", a.id, a.chosen_views.len());
        for b in &plan.partitions[..a.id.0 as usize] {
            assert_ne!(a.chosen_views, b.chosen_views, "partitions {} and {}", a.id, b.id);
        }
    }
}

#[test]
fn points_before_and_behind_cameras_are_counted_in_place() {
    // Fault 2 of the public code: a mask of a filtered array is applied to the unfiltered one.
    let (views, points) = (survey(200), floor(2000));
    let plan = planned(&views, &points, &config(3, 3));
    for partition in &plan.partitions {
        let within = |rect: &Rect| {
            points.positions.iter().filter(|&&p| rect.contains(plan.alignment.to_aligned(p))).count() as u64
        };
        assert_eq!(partition.focus_points, within(&partition.focus));
        assert_eq!(partition.cell_points, within(&partition.cell));
        assert!((partition.r_focus - partition.focus_points as f64 / 2000.0).abs() < 1e-12);
    }
    assert_eq!(plan.partitions.iter().map(|p| p.cell_points).sum::<u64>(), 2000);
}

// Fault 4 of the public code: grids of one row or one column lose what lies beyond their outer cameras.
#[test]
fn a_partition_trains_whatever_it_keeps_and_more() {
    for (columns, rows) in [(1, 4), (4, 1), (2, 1), (2, 2), (3, 3)] {
        let plan = planned(&survey(150), &floor(300), &config(columns, rows));
        for i in 0..3000 {
            let point = [0, 1, 2].map(|k| (uniform_at(8, Stream::Test, i, k) - 0.4) * 80.0);
            let keepers: Vec<&Partition> = plan.partitions.iter().filter(|p| plan.keeps(p, point)).collect();
            assert_eq!(keepers.len(), 1, "{columns}x{rows}: {point:?}");
            assert!(plan.focuses(keepers[0], point), "{columns}x{rows}: {point:?}");
        }
        for p in &plan.partitions {
            assert!(p.focus_points > p.cell_points, "the margin of partition {} has points", p.id);
        }
    }
}

#[test]
fn the_plan_follows_a_scene_that_is_moved_and_scaled() {
    // Fault 13 of the public code: constants in scene units and distances from the origin.
    let (views, points, config) = (survey(200), floor(1000), config(3, 2));
    let before = planned(&views, &points, &config);
    let (scale, shift) = (64.0, DVec3::new(4096.0, -2048.0, 8192.0));
    let moved_views: Vec<TrainView> = views
        .iter()
        .map(|view| {
            let rotation = view.pose.rotation;
            let translation = view.pose.translation * scale - rotation * shift;
            TrainView { pose: Pose { rotation, translation }, ..view.clone() }
        })
        .collect();
    let moved_points = Points {
        positions: points
            .positions
            .iter()
            .map(|p| [0, 1, 2].map(|k| p[k] * scale as f32 + shift[k] as f32))
            .collect(),
        ..points.clone()
    };
    let after = planned(&moved_views, &moved_points, &config);
    for (a, b) in before.partitions.iter().zip(&after.partitions) {
        assert_eq!((&a.base_views, a.iterations), (&b.base_views, b.iterations));
        assert_eq!(a.chosen_views, b.chosen_views);
        assert!((a.weight - b.weight).abs() < 1e-3, "{} against {}", a.weight, b.weight);
        // f32 positions after the shift are good to 0.0005 units.
        assert!((a.depth * scale - b.depth).abs() < 0.01, "{} against {}", a.depth, b.depth);
    }
}

#[test]
fn a_turned_world_is_cut_like_an_upright_one() {
    let (views, points, config) = (survey(200), floor(1000), config(3, 2));
    let before = planned(&views, &points, &config);
    let turn = DQuat::from_axis_angle(DVec3::new(0.36, 0.48, 0.8), 2.0);
    let turned: Vec<TrainView> = views
        .iter()
        .map(|view| {
            let rotation = view.pose.rotation * turn.inverse();
            TrainView { pose: Pose { rotation, translation: view.pose.translation }, ..view.clone() }
        })
        .collect();
    let turned_points = Points {
        positions: points
            .positions
            .iter()
            .map(|&p| (turn * DVec3::from(p.map(f64::from))).as_vec3().to_array())
            .collect(),
        ..points
    };
    let after = planned(&turned, &turned_points, &config);
    assert_eq!(before.alignment.rule, after.alignment.rule);
    let down = turn * DVec3::from(before.alignment.down);
    assert!(down.distance(after.alignment.down.into()) < 1e-9);
    // Heights above the cutting plane stay what they were; a square survey may come out a quarter turn on.
    for (a, b) in points_of(&views).zip(points_of(&turned)) {
        let (a, b) = (before.alignment.rotation() * a, after.alignment.rotation() * b);
        assert!((a.y - b.y).abs() < 1e-9, "{a} against {b}");
    }
}

fn points_of(views: &[TrainView]) -> impl Iterator<Item = DVec3> {
    views.iter().map(|view| view.pose.centre())
}

#[test]
fn iterations_follow_cameras_and_caps_follow_points() {
    let (views, points, config) = (survey(300), floor(2000), config(3, 3));
    let plan = planned(&views, &points, &config);
    let training = plan.training_views().len() as f64;
    for p in &plan.partitions {
        let iterations = f64::from(config.train.iterations) * p.chosen_views.len() as f64 / training;
        assert!((f64::from(p.iterations) - iterations).abs() <= 0.5, "partition {}", p.id);
        let cap = f64::from(config.train.max_gaussians) * p.r_focus;
        assert!((f64::from(p.max_gaussians) - cap).abs() <= 0.5, "partition {}", p.id);
    }
    let global = plan.global.unwrap();
    assert_eq!((global.iterations, global.max_gaussians, global.max_resolution), (3000, 750_000, 320));
}

#[test]
fn weights_follow_equation_5_and_stay_between_0_and_1() {
    let plan = planned(&survey(300), &floor(2000), &config(4, 4));
    let deepest = plan.partitions.iter().map(|p| p.depth).fold(0.0, f64::max);
    assert!(deepest > 0.0);
    let mut unclamped = 0;
    for p in &plan.partitions {
        let gamma = match p.layer {
            Layer::Corner => 2.0,
            Layer::Edge => 1.5,
            Layer::Inner => 1.0,
        };
        let by_hand = (p.mean_visibility + 0.01) * (1.0 + 0.12 * (1.0 + p.depth / deepest).ln()) * gamma;
        assert!((p.weight - by_hand.clamp(0.0, 1.0)).abs() < 1e-12, "partition {}", p.id);
        unclamped += usize::from(by_hand < 1.0);
    }
    assert!(unclamped > 0, "all weights are clamped, so the formula was not tested");
}

#[test]
fn scenes_without_points_are_planned_but_refused_for_training() {
    let plan = planned(&survey(200), &Points::default(), &config(3, 2));
    assert_eq!(plan.extent.points, None);
    for p in &plan.partitions {
        assert!(p.chosen_views.len() < 175 && p.extended_box.side(1) > 0.0, "partition {}", p.id);
        assert_eq!((p.focus_points, p.depth, p.r_focus), (0, 0.0, 0.0));
    }
    assert!(matches!(plan.require_points(), Err(PlanError::NoPoints)));
}

#[test]
fn a_partition_without_points_gets_a_quarter_of_a_share() {
    let mut points = floor(500);
    points.positions.retain(|p| p[0] < 6.0);
    let config = config(4, 1);
    let plan = planned(&survey(300), &points, &config);
    let empty: Vec<&Partition> = plan.partitions.iter().filter(|p| p.focus_points == 0).collect();
    assert!(!empty.is_empty() && empty.len() < 4, "{} of 4 have no points", empty.len());
    for partition in empty {
        assert_eq!(partition.max_gaussians, config.train.max_gaussians / 16);
    }
    assert!(plan.require_points().is_ok());
}

#[test]
fn a_plan_warns_of_weak_partitions_and_missing_metrics() {
    let (views, points, train) = (survey(160), floor(4000), config(1, 1).train);
    assert_eq!(planned(&views, &points, &config(2, 2)).warnings(&train), Vec::<String>::new());

    let mut nothing_held_out = config(1, 1);
    nothing_held_out.data.test_every = 0;
    let warnings = planned(&views, &points, &nothing_held_out).warnings(&train);
    assert!(matches!(&warnings[..], [one] if one.contains("--test-every")), "{warnings:?}");

    let few = planned(&survey(12), &points, &config(1, 1)).warnings(&train);
    assert!(matches!(&few[..], [one] if one.starts_with("partition 0 trains on 10 cameras")), "{few:?}");

    let mut west = points.clone();
    west.positions.iter_mut().for_each(|point| point[0] = point[0].min(0.0));
    let plan = planned(&views, &west, &config(2, 1));
    assert_eq!(plan.partitions[1].cell_points, 0, "the cameras of the second column stand farther east");
    let warnings = plan.warnings(&train);
    assert!(
        matches!(&warnings[..], [one] if one.starts_with("partition 1 has no sparse points")),
        "{warnings:?}"
    );
    assert!(planned(&views, &Points::default(), &config(2, 1)).warnings(&train).is_empty(), "only inspected");
}

#[test]
fn a_plan_explains_its_measurements_during_training() {
    let (views, points) = (survey(160), floor(4000));
    let warnings = |columns: u32, eval_every: u32| {
        let mut config = config(columns, 1);
        (config.train.iterations, config.train.eval_every) = (8000, eval_every);
        planned(&views, &points, &config).warnings(&config.train)
    };
    assert!(warnings(1, 8000).is_empty());
    assert!(matches!(&warnings(1, 8001)[..], [one] if one.contains("nothing is measured")));
    // The coarse model has a quarter of the iterations.
    assert!(
        matches!(&warnings(2, 2000)[..], [one] if one.contains("measures the coarse model only, at its "))
    );
    assert!(
        matches!(&warnings(2, 2001)[..], [one] if one.contains("has only 2000 iterations, so nothing is measured"))
    );
}

#[test]
fn points_that_are_not_finite_are_left_out() {
    let mut points = floor(100);
    points.positions[7] = [f32::NAN, 0.0, 0.0];
    points.positions[8] = [0.0, f32::INFINITY, 0.0];
    assert_eq!(planned(&survey(50), &points, &config(2, 2)).points, 98);
}

// Fault 10 of the public code: fewer cameras than cells, and the minimum of an empty list.
#[test]
fn fewer_training_views_than_partitions_is_an_error_with_advice() {
    let (views, points, config) = (survey(10), floor(100), config(3, 3));
    let error = plan(&PlanInput { views: &views, points: &points, config: &config }).unwrap_err().to_string();
    assert!(error.contains("8 training views (2 held out) cannot fill 3x3"), "{error}");
    assert!(error.contains("--partitions 1x1") && error.contains("--test-every"), "{error}");
    let none = plan(&PlanInput { views: &[], points: &points, config: &config });
    assert!(matches!(none, Err(PlanError::TooFewViews { training: 0, .. })));
}

#[test]
fn views_that_nothing_can_be_projected_with_are_refused_by_name() {
    type Spoil = fn(&mut TrainView);
    let spoil: [(&str, Spoil); 5] = [
        ("pose is not finite", |view| view.pose.translation.y = f64::NAN),
        ("unit quaternion", |view| view.pose.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 2.0)),
        ("no pixels", |view| view.camera.height = 0),
        ("focal length", |view| view.camera.fy = 0.0),
        ("principal point", |view| view.camera.cx = f64::INFINITY),
    ];
    for (words, spoil) in spoil {
        let mut views = survey(20);
        spoil(&mut views[13]);
        let input = PlanInput { views: &views, points: &floor(10), config: &config(1, 1) };
        let error = plan(&input).unwrap_err().to_string();
        assert!(error.contains("view00013") && error.contains(words), "{error}");
    }
}

#[test]
fn unsorted_or_repeated_view_names_are_refused() {
    for (at, name) in [(4, "view00003"), (4, "a")] {
        let mut views = survey(9);
        views[at].name = name.to_owned();
        let input = PlanInput { views: &views, points: &floor(10), config: &config(1, 1) };
        assert!(matches!(plan(&input), Err(PlanError::UnsortedViews { .. })), "{name}");
    }
}

#[test]
fn a_plan_reads_back_and_another_version_is_refused() {
    let (views, points) = (survey(100), floor(500));
    let plan = planned(&views, &points, &config(2, 2));
    let json = serde_json::to_vec(&plan).unwrap();
    assert_eq!(Plan::from_json(&json).unwrap(), plan);
    let older = Plan::from_json(br#"{"format": 2, "columns": 2}"#).unwrap_err();
    assert!(older.contains("format 2") && older.contains("submit it again"), "{older}");
    assert!(Plan::from_json(b"{}").unwrap_err().contains("cannot be read"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn any_grid_over_any_cameras_gives_a_whole_plan(
        at in prop::collection::vec((-3i32..3, -3i32..3), 16..40),
        columns in 1u32..=4,
        rows in 1u32..=4,
    ) {
        let views = views_at(&at);
        let mut config = config(columns, rows);
        config.data.test_every = 0;
        let plan = planned(&views, &Points::default(), &config);
        prop_assert_eq!(plan.partitions.len() as u32, columns * rows);
        for (k, p) in plan.partitions.iter().enumerate() {
            prop_assert_eq!(p.id, PartitionId(k as u32));
            prop_assert!(!p.base_views.is_empty());
            prop_assert!(p.iterations >= 1 && p.max_gaussians >= 16);
            prop_assert!(p.weight.is_finite() && p.extended_box.side(0) > 0.0);
        }
        prop_assert_eq!(plan.partitions.iter().map(|p| p.base_views.len()).sum::<usize>(), at.len());
    }
}
