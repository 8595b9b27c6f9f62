//! The effects of weights on a plan.

use super::*;

/// A plan of 4 x 3 partitions whose weights differ, in this mode.
fn weighed(mode: WeightMode) -> (Plan, JobConfig) {
    let mut config = config(4, 3);
    config.partition.weights = mode;
    config.partition.weight_terms.clamp = 4.0;
    (planned(&survey(500), &floor(3000), &config), config)
}

#[test]
fn weights_change_the_loss_or_the_sampling_and_no_budget() {
    use WeightMode::{Joint, LossFactor};
    let (plain, _) = weighed(WeightMode::None);
    assert!(plain.partitions.iter().all(|p| p.weighed == Weighed::default()));
    for mode in [LossFactor, Joint] {
        let (plan, _) = weighed(mode);
        assert_eq!(plan.weights, mode);
        for (p, before) in plan.partitions.iter().zip(&plain.partitions) {
            let Weighed { loss_factor, sampling } = p.weighed;
            assert_eq!(loss_factor, if mode == LossFactor { p.weight } else { 1.0 });
            assert_eq!(sampling != 1.0, mode == Joint, "partition {}", p.id);
            assert_eq!(*p, Partition { weighed: p.weighed, ..before.clone() }, "{mode:?}");
        }
    }
}

#[test]
fn the_global_stage_weighs_views_and_keeps_their_sum() {
    let (plan, _) = weighed(WeightMode::Joint);
    let weights = plan.view_weights();
    let training = plan.training_views();
    assert_eq!(weights.len(), training.len());
    let mean = weights.iter().map(|&weight| f64::from(weight)).sum::<f64>() / weights.len() as f64;
    assert!((mean - 1.0).abs() < 1e-6, "{mean}");
    for p in &plan.partitions {
        for view in &p.base_views {
            let at = training.binary_search(view).unwrap();
            assert_eq!(weights[at], p.weighed.sampling as f32, "view {view}");
        }
    }
    assert!(weighed(WeightMode::LossFactor).0.view_weights().is_empty());
}

#[test]
fn one_partition_has_nothing_to_weigh() {
    for mode in [WeightMode::LossFactor, WeightMode::Joint] {
        let mut config = config(1, 1);
        config.partition.weights = mode;
        let plan = planned(&survey(100), &floor(500), &config);
        let only = &plan.partitions[0];
        assert_eq!(only.weighed, Weighed::default(), "{mode:?}");
        assert!(plan.view_weights().is_empty());
    }
}

#[test]
fn a_plan_warns_if_all_weights_are_equal() {
    let (views, points) = (survey(400), floor(4000));
    let warned = |columns: u32, clamp: f64, mode: WeightMode| {
        let mut config = config(columns, columns);
        (config.partition.weights, config.partition.weight_terms.clamp) = (mode, clamp);
        let warnings = planned(&views, &points, &config).warnings(&config.train);
        warnings.iter().filter(|warning| warning.contains("weight_terms.clamp")).count()
    };
    assert_eq!(warned(3, 0.01, WeightMode::Joint), 1, "all at the clamp");
    assert_eq!(warned(1, 4.0, WeightMode::Joint), 0, "one partition has nothing to weigh");
    assert_eq!(warned(3, 4.0, WeightMode::Joint), 0);
    assert_eq!(warned(3, 0.01, WeightMode::None), 0);
}
