//! The effects of weights on a plan.

use super::*;

/// A plan of 4 x 3 partitions whose weights differ, in this mode.
fn weighed(mode: WeightMode, strategy: Strategy) -> (Plan, JobConfig) {
    let mut config = config(4, 3);
    (config.partition.weights, config.train.strategy) = (mode, strategy);
    config.partition.weight_terms.clamp = 4.0;
    (planned(&survey(500), &floor(3000), &config), config)
}

#[test]
fn weights_move_work_between_partitions_and_add_none() {
    use Strategy::{Classic, Mcmc};
    use WeightMode::{DensityThreshold, IterationBudget, Joint, LossFactor};
    let (plain, _) = weighed(WeightMode::None, Mcmc);
    assert!(plain.partitions.iter().all(|p| p.weighed == Weighed::nothing(p.iterations, p.max_gaussians)));
    let budgets = |plan: &Plan| -> (Vec<u32>, Vec<u32>) {
        plan.partitions.iter().map(|p| (p.iterations, p.max_gaussians)).unzip()
    };
    let sum = |values: &[u32]| values.iter().map(|&value| u64::from(value)).sum::<u64>();
    let (iterations, caps) = budgets(&plain);
    for (mode, strategy) in [
        (LossFactor, Mcmc),
        (DensityThreshold, Mcmc),
        (DensityThreshold, Classic),
        (IterationBudget, Mcmc),
        (Joint, Mcmc),
    ] {
        let (plan, _) = weighed(mode, strategy);
        assert_eq!(plan.weights, mode);
        let (now_iterations, now_caps) = budgets(&plan);
        assert_eq!((sum(&now_iterations), sum(&now_caps)), (sum(&iterations), sum(&caps)), "{mode:?}");
        assert_eq!(now_iterations != iterations, mode == IterationBudget, "{mode:?}");
        assert_eq!(now_caps != caps, (mode, strategy) == (DensityThreshold, Mcmc), "{mode:?}");
        for (p, before) in plan.partitions.iter().zip(&plain.partitions) {
            assert_eq!((p.weight, &p.chosen_views), (before.weight, &before.chosen_views), "{mode:?}");
            let Weighed {
                loss_factor,
                gradient_factor,
                sampling,
                unweighed_iterations,
                unweighed_max_gaussians,
            } = p.weighed;
            assert_eq!(
                (unweighed_iterations, unweighed_max_gaussians),
                (before.iterations, before.max_gaussians)
            );
            assert_eq!(loss_factor, if mode == LossFactor { p.weight } else { 1.0 });
            let divides = (mode, strategy) == (DensityThreshold, Classic);
            assert_eq!(gradient_factor, if divides { 1.0 / p.weight } else { 1.0 });
            assert_eq!(sampling != 1.0, mode == Joint, "partition {}", p.id);
        }
    }
}

#[test]
fn budgets_are_proportional_to_weight_times_old_budget() {
    let (plan, _) = weighed(WeightMode::IterationBudget, Strategy::Mcmc);
    let share = |p: &Partition| f64::from(p.weighed.unweighed_iterations) * p.weight;
    let total: f64 = plan.partitions.iter().map(|p| f64::from(p.iterations)).sum();
    let sum: f64 = plan.partitions.iter().map(share).sum();
    for p in &plan.partitions {
        assert!((f64::from(p.iterations) - share(p) / sum * total).abs() < 1.0, "partition {}", p.id);
    }
    let (plan, _) = weighed(WeightMode::DensityThreshold, Strategy::Mcmc);
    for p in &plan.partitions {
        let written = format!("{} trained Gaussians", p.max_gaussians);
        assert!(p.forecast.formula.starts_with(&written), "{} for {written}", p.forecast.formula);
    }
}

#[test]
fn the_global_stage_weighs_views_and_keeps_their_sum() {
    let (plan, _) = weighed(WeightMode::Joint, Strategy::Mcmc);
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
    assert!(weighed(WeightMode::LossFactor, Strategy::Mcmc).0.view_weights().is_empty());
}

#[test]
fn one_partition_has_nothing_to_weigh() {
    for mode in
        [WeightMode::LossFactor, WeightMode::DensityThreshold, WeightMode::IterationBudget, WeightMode::Joint]
    {
        let mut config = config(1, 1);
        config.partition.weights = mode;
        let plan = planned(&survey(100), &floor(500), &config);
        let only = &plan.partitions[0];
        assert_eq!(
            only.weighed,
            Weighed::nothing(config.train.iterations, config.train.max_gaussians),
            "{mode:?}"
        );
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
