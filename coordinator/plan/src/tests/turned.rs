//! Surveys that are tilted in their frame.

use super::*;

/// A survey of 60 x 20 whose world is turned by `degrees` about the vertical.
fn askew(degrees: f64) -> (Vec<TrainView>, Points) {
    let turn = DQuat::from_rotation_y(degrees.to_radians());
    let long = DVec3::new(3.0, 1.0, 1.0);
    let views = survey(400)
        .into_iter()
        .map(|view| {
            let pose = &view.pose;
            let (eye, ahead, down) = (pose.centre() * long, pose.forward(), pose.down());
            TrainView { pose: Pose::looking_at(turn * eye, turn * (eye + ahead), turn * down), ..view }
        })
        .collect();
    let points = floor(1500);
    let positions = points
        .positions
        .iter()
        .map(|&p| (turn * (DVec3::from(p.map(f64::from)) * long)).as_vec3().to_array());
    (views, Points { positions: positions.collect(), ..points.clone() })
}

#[test]
fn a_tilted_survey_is_cut_like_an_aligned_one() {
    let config = config(3, 1);
    let (views, points) = askew(0.0);
    let straight = planned(&views, &points, &config);
    assert_eq!(straight.alignment.turn.rule, TurnRule::SmallGain);
    for degrees in [20.0, 40.0, -35.0] {
        let (views, points) = askew(degrees);
        let plan = planned(&views, &points, &config);
        let turn = plan.alignment.turn;
        assert_eq!(turn.rule, TurnRule::CompactCells, "{degrees}: {turn:?}");
        // from_rotation_y takes z towards x, and so does the turn back.
        assert!((turn.degrees + degrees).abs() < 8.0, "{degrees}: {turn:?}");
        for (a, b) in straight.partitions.iter().zip(&plan.partitions) {
            let common = a.base_views.iter().filter(|view| b.base_views.contains(view)).count();
            assert!(common * 10 > a.base_views.len() * 8, "{degrees}: {common} of {}", a.base_views.len());
            for axis in [0, 2] {
                let [a, b] = [a, b].map(|p| p.extended_box.side(axis));
                assert!((a - b).abs() < 0.25 * a, "{degrees}: side {axis} is {b} in place of {a}");
            }
        }
    }
}

#[test]
fn the_configuration_can_disable_the_turn() {
    let (views, points) = askew(30.0);
    let mut config = config(3, 1);
    config.partition.rotate = false;
    let plan = planned(&views, &points, &config);
    let turn = plan.alignment.turn;
    assert_eq!(turn, Turn { rule: TurnRule::Off, degrees: 0.0, perimeter_ratio: None });
    let level = DQuat::from_rotation_arc(plan.alignment.down.into(), DVec3::Y);
    assert_eq!(plan.alignment.rotation(), level, "to the last bit");
}

#[test]
fn a_turned_plan_keeps_and_trains_by_the_same_axes() {
    let (views, points) = askew(30.0);
    let plan = planned(&views, &points, &config(4, 2));
    assert_eq!(plan.alignment.turn.rule, TurnRule::CompactCells);
    let mut kept = 0;
    for &position in &points.positions {
        let keepers: Vec<&Partition> = plan.partitions.iter().filter(|p| plan.keeps(p, position)).collect();
        assert_eq!(keepers.len(), 1, "{position:?}");
        assert!(plan.focuses(keepers[0], position));
        kept += 1;
    }
    assert_eq!(kept, plan.partitions.iter().map(|p| p.cell_points).sum::<u64>());
}
