//! The choices of `partition.auto` for given workers.

use super::*;

fn auto(workers: u32, memory_gib: f64) -> JobConfig {
    let mut config = config(1, 1);
    (config.partition.auto, config.partition.workers, config.partition.memory_gib) =
        (true, workers, memory_gib);
    config
}

/// Two long lines of cameras at a right angle: rows of a column that runs along a line part nothing.
fn uneven() -> Vec<TrainView> {
    let mut views = survey(600);
    for (i, view) in views.iter_mut().enumerate() {
        let (along, aside) = (i as f64 % 300.0, 0.1 * (i as f64 * 0.7).sin());
        let eye = if i < 300 { DVec3::new(along, -3.0, aside) } else { DVec3::new(aside, -3.0, along) };
        let heading = if i % 2 == 0 { 1.0 } else { -1.0 };
        view.pose = Pose::looking_at(eye, eye + DVec3::new(0.3, 1.0, 0.0), DVec3::Z * heading);
    }
    views
}

/// A strip of sea floor below those lines.
fn strips() -> Points {
    let draw = |i: u32, k: u32| uniform_at(5, Stream::Test, i, k);
    let positions = (0..4000).map(|i| {
        let (along, aside) = (300.0 * draw(i, 0), 3.0 * draw(i, 1) - 1.5);
        if i % 2 == 0 { [along, 0.2 * draw(i, 2), aside] } else { [aside, 0.2 * draw(i, 2), along] }
    });
    Points { positions: positions.collect(), colours: vec![[0; 3]; 4000], ..Points::default() }
}

fn fits(plan: &Plan) -> bool {
    let memory = plan.cut.planned_for.unwrap().memory_bytes;
    plan.partitions.iter().all(|p| p.forecast.bytes <= memory)
}

#[test]
fn one_worker_that_has_the_memory_gets_one_partition() {
    let plan = planned(&survey(300), &floor(3000), &auto(1, 16.0));
    assert_eq!((plan.partitions.len(), plan.columns, plan.rows), (1, Some(1), Some(1)));
    assert_eq!(plan.global, None);
    assert!(
        plan.cut.reason.contains("one partition") && plan.cut.reason.contains("16.00 GiB"),
        "{}",
        plan.cut.reason
    );
    assert_eq!(plan.balance, Balance { cameras: 1.0, points: 1.0, seconds: 1.0, bytes: 1.0 });
}

#[test]
fn a_scene_that_does_not_fit_is_cut_until_every_run_does() {
    let (views, points) = (survey(800), floor(8000));
    let whole = planned(&views, &points, &auto(1, 64.0)).partitions[0].forecast.bytes;
    let share = |share: f64| whole as f64 * share / f64::from(1 << 30);
    let plan = planned(&views, &points, &auto(1, share(0.8)));
    assert!(
        plan.partitions.len() > 1 && fits(&plan),
        "{} partitions, {}",
        plan.partitions.len(),
        plan.cut.reason
    );
    assert!(plan.cut.reason.contains("too much"), "{}", plan.cut.reason);
    assert!(plan.warnings(&config(1, 1).train).is_empty());
    let more = planned(&views, &points, &auto(1, share(0.5)));
    assert!(more.partitions.len() > plan.partitions.len() && fits(&more), "{}", more.cut.reason);
}

#[test]
fn a_scene_that_no_cut_makes_fit_is_planned_with_a_warning() {
    let plan = planned(&survey(400), &floor(800), &auto(1, 0.0625));
    let warnings = plan.warnings(&config(1, 1).train);
    assert!(
        warnings.iter().any(|w| w.contains("is forecast to need") && w.contains("--max-gaussians")),
        "{warnings:?}"
    );
}

#[test]
fn more_workers_get_more_partitions_with_enough_cameras() {
    let (views, points) = (survey(1200), floor(6000));
    let of = |workers: u32| planned(&views, &points, &auto(workers, 64.0));
    let (two, eight) = (of(2), of(8));
    assert!(
        two.partitions.len() >= 2 && eight.partitions.len() > two.partitions.len(),
        "{}",
        eight.cut.reason
    );
    assert!(eight.cut.reason.contains("8 workers finish in 0."), "{}", eight.cut.reason);
    let many = of(500);
    for plan in [&two, &eight, &many] {
        assert!(plan.partitions.iter().all(|p| p.base_views.len() >= MIN_CAMERAS), "{}", plan.cut.reason);
    }
    // Too few cameras for two partitions.
    assert_eq!(planned(&survey(35), &points, &auto(8, 64.0)).partitions.len(), 1);
}

#[test]
fn even_surveys_get_a_grid_and_uneven_ones_recursive_cuts() {
    let points = floor(6000);
    let even = planned(&survey(1200), &points, &auto(8, 64.0));
    assert_eq!(even.cut.shape, CutShape::Grid, "{}", even.cut.reason);
    let (Some(columns), Some(rows)) = (even.columns, even.rows) else { panic!("{even:?}") };
    assert_eq!((columns * rows) as usize, even.partitions.len());
    assert!(even.partitions.iter().all(|p| p.path.is_empty() && p.column.is_some() && p.row.is_some()));

    let plan = planned(&uneven(), &strips(), &auto(8, 64.0));
    assert_eq!(plan.cut.shape, CutShape::Recursive, "{}", plan.cut.reason);
    assert_eq!((plan.columns, plan.rows), (None, None));
    assert!(plan.partitions.iter().all(|p| !p.path.is_empty() && p.column.is_none() && p.row.is_none()));
    assert!(
        plan.cut.reason.contains("cameras are uneven") || plan.cut.reason.contains("no grid"),
        "{}",
        plan.cut.reason
    );
}

#[test]
fn a_recursive_plan_keeps_every_rule_of_a_grid() {
    let (views, points) = (uneven(), strips());
    let plan = planned(&views, &points, &auto(8, 64.0));
    assert_eq!(plan.cut.shape, CutShape::Recursive);
    let mut homes = BTreeSet::new();
    for (k, p) in plan.partitions.iter().enumerate() {
        assert_eq!(p.id, PartitionId(k as u32));
        assert!(p.base_views.iter().all(|view| homes.insert(*view)), "a view has two homes");
        assert!(p.chosen_views.iter().all(|view| !plan.held_out.contains(view)));
        for &view in &p.base_views {
            let centre = plan.alignment.rotation() * views[view as usize].pose.centre();
            // The last camera of a cell lies on its border, but for roundings.
            assert!(p.cell.distance(centre) < 1e-9, "view {view} lies outside of its cell");
        }
    }
    assert_eq!(homes.into_iter().collect::<Vec<_>>(), plan.training_views());
    for i in 0..3000 {
        let point = [0, 1, 2].map(|k| (uniform_at(9, Stream::Test, i, k) - 0.3) * 700.0);
        let keepers: Vec<&Partition> = plan.partitions.iter().filter(|p| plan.keeps(p, point)).collect();
        assert_eq!(keepers.len(), 1, "{point:?}");
        assert!(plan.focuses(keepers[0], point), "{point:?}");
    }
    for border in plan.shared_borders() {
        assert!(plan.neighbours(border.low).contains(&border.high));
    }
    let json = serde_json::to_string(&plan).unwrap();
    assert_eq!(serde_json::from_str::<Plan>(&json).unwrap(), plan);
}

#[test]
fn a_choice_does_not_depend_on_threads_or_point_order() {
    let (views, points, config) = (uneven(), strips(), auto(6, 2.0));
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let first = one.install(|| planned(&views, &points, &config));
    let mut reversed = points.clone();
    reversed.positions.reverse();
    assert_eq!(first, planned(&views, &reversed, &config));
}

#[test]
fn configured_memory_wins_over_reported_and_that_over_default() {
    let (views, points) = (survey(300), floor(1000));
    let planned_for = |config: &JobConfig, connected: Connected| {
        let input = PlanInput { views: &views, points: &points, config };
        plan_for(&input, connected).unwrap().cut.planned_for.unwrap()
    };
    let three = Connected { workers: 3, memory_bytes: Some(5 << 30) };
    let of = |workers, memory_bytes, memory_from| PlannedFor { workers, memory_bytes, memory_from };
    assert_eq!(planned_for(&auto(0, 0.0), three), of(3, 5 << 30, MemoryFrom::Workers));
    assert_eq!(planned_for(&auto(2, 12.0), three), of(2, 12 << 30, MemoryFrom::Configuration));
    assert_eq!(planned_for(&auto(0, 0.0), Connected::default()), of(1, 8 << 30, MemoryFrom::Default));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn any_choice_over_any_cameras_gives_a_whole_plan(
        at in prop::collection::vec((-6i32..6, -3i32..3), 1..120),
        workers in 1u32..=9,
        memory_gib in prop_oneof![Just(0.25), Just(1.0), Just(64.0)],
    ) {
        let views = views_at(&at);
        let mut config = auto(workers, memory_gib);
        config.data.test_every = 0;
        let plan = planned(&views, &floor(200), &config);
        prop_assert_eq!(plan.partitions.iter().map(|p| p.base_views.len()).sum::<usize>(), at.len());
        prop_assert!(plan.partitions.len() == 1 || plan.partitions.iter().all(|p| p.base_views.len() >= MIN_CAMERAS));
        prop_assert_eq!(plan.global.is_some(), plan.partitions.len() > 1);
        prop_assert!(!plan.cut.reason.is_empty());
        for i in 0..50 {
            let point = [0, 1, 2].map(|k| (uniform_at(9, Stream::Test, i, k) - 0.5) * 16.0);
            prop_assert_eq!(plan.partitions.iter().filter(|p| plan.keeps(p, point)).count(), 1);
        }
    }
}
