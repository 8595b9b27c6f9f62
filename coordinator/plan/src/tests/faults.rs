//! Faults of the public code of SMP-UWGS that concern the plan and had no test yet. The others are tested
//! elsewhere: 1 and 2 in `tests.rs`, 3 and 6 in `visibility.rs`, 4 in `cells.rs`.

use super::*;

/// Fault 5: the strip along a border tests y where the axis is z, and pairs without a common border crash.
#[test]
fn a_margin_beyond_a_z_border_has_points_at_any_height() {
    let (views, mut points) = (survey(200), floor(2000));
    // Heights independent of z: a test of y would take other points.
    for (i, position) in points.positions.iter_mut().enumerate() {
        position[1] = [0.0, 7.0, -9.0][i % 3];
    }
    let plan = planned(&views, &points, &config(1, 4));
    for border in plan.shared_borders() {
        assert_eq!(border.axis, Axis::Z);
        let (low, high) = (&plan.partitions[border.low.0 as usize], &plan.partitions[border.high.0 as usize]);
        let reaches = low.focus.z.hi.unwrap();
        assert!(reaches > border.at, "the margin reaches over the border");
        let mut crossing = 0;
        for &position in &points.positions {
            let z = plan.alignment.to_aligned(position).z;
            if z > border.at && z <= reaches {
                assert!(plan.focuses(low, position), "{position:?}");
                crossing += usize::from(plan.keeps(high, position));
            }
        }
        assert!(crossing > 20, "{crossing} points of the neighbour are in the margin");
    }
}

/// Fault 5, second half: partitions without a common border are not neighbours, and are never paired.
#[test]
fn cells_that_are_apart_share_no_border() {
    let plan = planned(&survey(300), &floor(500), &config(1, 5));
    for a in &plan.partitions {
        for b in &plan.partitions {
            let borders = plan.shared_borders();
            let meet = borders.iter().any(|border| (border.low, border.high) == (a.id, b.id));
            assert_eq!(meet, b.id.0 == a.id.0 + 1, "{} and {}", a.id, b.id);
        }
    }
}

/// Fault 10: a cached plan is used again although the settings have changed. There is no cache: a plan is a
/// function of its input, and every setting of the cut is in it.
#[test]
fn a_plan_changes_with_every_setting_of_the_cut() {
    let (views, points, before) = (survey(200), floor(800), config(3, 2));
    let plan = planned(&views, &points, &before);
    assert_eq!(plan, planned(&views, &points, &before));
    type Change = fn(&mut fathom_core::config::PartitionConfig);
    let changes: [(&str, Change); 8] = [
        ("columns", |p| p.columns = 2),
        ("rows", |p| p.rows = 3),
        ("extend_base", |p| p.extend_base = 0.1),
        ("extend_edge", |p| p.extend_edge = 1.0),
        ("visibility", |p| p.visibility = 0.9),
        ("visibility_edge_factor", |p| p.visibility_edge_factor = 1.0),
        ("iterations_per_partition", |p| p.iterations_per_partition = 7),
        ("rotate", |p| p.rotate = false),
    ];
    for (name, change) in changes {
        let mut after = before.clone();
        change(&mut after.partition);
        assert_ne!(plan, planned(&views, &points, &after), "{name}");
    }
}

/// Fault 10: an empty cell takes the minimum of nothing. A cell without points is planned, and so is one
/// between cameras at one coordinate.
#[test]
fn cells_without_points_or_width_are_planned() {
    let mut views = survey(64);
    for (i, view) in views.iter_mut().enumerate() {
        let eye = DVec3::new(5.0, -3.0, view.pose.centre().z);
        let heading = if i / 2 % 2 == 0 { 1.0 } else { -1.0 };
        view.pose = Pose::looking_at(eye, eye + DVec3::new(0.1, 1.0, 0.0), DVec3::Z * heading);
    }
    let mut points = floor(300);
    points.positions.retain(|position| position[2] > 15.0);
    let plan = planned(&views, &points, &config(3, 3));
    assert_eq!(plan.partitions.len(), 9);
    for partition in &plan.partitions {
        assert!(!partition.base_views.is_empty());
        assert!((0..3).all(|axis| partition.extended_box.side(axis) > 0.0), "{:?}", partition.extended_box);
    }
}
