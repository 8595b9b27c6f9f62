//! Plans by the cameras' shares of the coarse model.

use super::*;

/// Random shares of a plan's partitions in its views, with the order of the views rotated by `turn`.
fn contributions(plan: &Plan, turn: usize) -> Contributions {
    let mut views = plan.training_views();
    views.rotate_left(turn);
    let partitions = plan.partitions.len() as u32;
    let draw = |view: u32, k: u32| (0.3 * uniform_at(12, Stream::Test, view, k) - 0.15).max(0.0);
    let shares = views.iter().flat_map(|&view| (0..partitions).map(move |k| draw(view, k))).collect();
    Contributions::new(views, partitions, shares).unwrap()
}

#[test]
fn a_plan_by_contribution_changes_only_views_and_dependents() {
    let (views, points) = (survey(300), floor(2000));
    let config = config(3, 2);
    let input = PlanInput { views: &views, points: &points, config: &config };
    let before = plan(&input).unwrap();
    assert_eq!(before.selection, CameraSelection::Visibility);
    let known = contributions(&before, 0);
    let after = plan_by_contribution(&input, &before, &known).unwrap();
    assert_eq!(after.selection, CameraSelection::Contribution);
    assert_eq!(
        plan_by_contribution(&input, &before, &contributions(&before, 71)).unwrap(),
        after,
        "another order of rows"
    );
    let training = after.training_views();
    for (p, was) in after.partitions.iter().zip(&before.partitions) {
        let expected = contribution::choose(&known, p.id.0 as usize, &training, &was.base_views, 0.05);
        assert_eq!((&p.chosen_views, p.filled_views), (&expected.views, expected.filled));
        assert_eq!(p.mean_contribution, Some(expected.mean_contribution));
        assert_eq!(p.iterations, budget::iterations(&config, p.chosen_views.len(), training.len()));
        assert!(p.chosen_views.iter().all(|view| training.contains(view)), "a held-out view in {}", p.id);
        assert_ne!(p.chosen_views, was.chosen_views);
        let again = Partition {
            chosen_views: was.chosen_views.clone(),
            filled_views: was.filled_views,
            mean_contribution: None,
            iterations: was.iterations,
            weighed: was.weighed,
            forecast: was.forecast.clone(),
            ..p.clone()
        };
        assert_eq!(&again, was);
    }
    assert_eq!(after.balance, Balance::of(&after.partitions));
    let again = Plan {
        partitions: before.partitions.clone(),
        balance: before.balance,
        selection: before.selection,
        ..after
    };
    assert_eq!(again, before);
}

#[test]
fn contributions_of_another_plan_are_refused() {
    let (views, points, config) = (survey(100), floor(500), config(2, 2));
    let input = PlanInput { views: &views, points: &points, config: &config };
    let first = plan(&input).unwrap();
    let training = first.training_views();
    let of = |views: Vec<u32>, partitions: u32| {
        let shares = vec![0.5; views.len() * partitions as usize];
        plan_by_contribution(&input, &first, &Contributions::new(views, partitions, shares).unwrap())
    };
    assert!(of(training.clone(), 4).is_ok());
    // Another build may cut differently: contributions belong to the boxes of one plan.
    let mut moved = first.clone();
    moved.partitions[0].cell.x.hi = Some(1e3);
    let shares = Contributions::new(training.clone(), 4, vec![0.5; training.len() * 4]).unwrap();
    let kept = plan_by_contribution(&input, &moved, &shares).unwrap();
    assert_eq!(kept.partitions[0].cell.x.hi, Some(1e3));
    let fewer = PlanInput { views: &views[1..], points: &points, config: &config };
    let refused = plan_by_contribution(&fewer, &first, &shares);
    assert!(matches!(refused, Err(PlanError::OtherContributions)), "views of another scene");
    let twice: Vec<u32> = training.iter().copied().chain([1]).collect();
    for (views, partitions) in
        [(training.clone(), 3), (training[1..].to_vec(), 4), (twice, 4), ((0..100).collect(), 4)]
    {
        let count = views.len();
        assert!(
            matches!(of(views, partitions), Err(PlanError::OtherContributions)),
            "{count} views, {partitions}"
        );
    }
}
