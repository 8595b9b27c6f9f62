//! Cameras by what they contribute: the share of a view that shows surfaces of the coarse model in a
//! partition's box.
//!
//! A partition uses its own cameras that show anything of it, and others that show at least a configured
//! share. If they are too few, the next best are added. The choice is a pure function of the shares, for any
//! order of views.

use crate::selection::MIN_CAMERAS;

/// The share of every partition in every training view.
#[derive(Clone, Debug, PartialEq)]
pub struct Contributions {
    views: Vec<u32>,
    partitions: usize,
    shares: Vec<f32>,
}

impl Contributions {
    /// `views` are indices into the scene's views; `shares`, 0 to 1, are those of all partitions for the
    /// first view, then for the second. Returns a sentence if they are invalid.
    pub fn new(views: Vec<u32>, partitions: u32, shares: Vec<f32>) -> Result<Self, String> {
        let partitions = partitions as usize;
        if partitions == 0 || views.len().checked_mul(partitions) != Some(shares.len()) {
            let (views, shares) = (views.len(), shares.len());
            return Err(format!("{shares} shares for {views} views and {partitions} partitions"));
        }
        if let Some(share) = shares.iter().find(|share| !(0.0..=1.0).contains(*share)) {
            return Err(format!("{share} is not a share between 0 and 1"));
        }
        Ok(Self { views, partitions, shares })
    }

    /// Number of partitions.
    pub fn partitions(&self) -> usize {
        self.partitions
    }

    /// The views, in their order.
    pub fn views(&self) -> &[u32] {
        &self.views
    }

    /// The share of one partition in each of `training`; 0 for unknown views.
    fn of_partition(&self, partition: usize, training: &[u32]) -> Vec<(u32, f64)> {
        let rows = self.views.iter().zip(self.shares.chunks_exact(self.partitions));
        let mut known: Vec<(u32, f64)> = rows
            .map(|(&view, row)| (view, row.get(partition).map_or(0.0, |&share| f64::from(share))))
            .collect();
        known.sort_by_key(|(view, _)| *view);
        let share =
            |view: u32| known.binary_search_by_key(&view, |(known, _)| *known).map_or(0.0, |at| known[at].1);
        training.iter().map(|&view| (view, share(view))).collect()
    }
}

/// The cameras of a partition.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// Views, ascending.
    pub views: Vec<u32>,
    /// How many of them were taken to reach [`MIN_CAMERAS`].
    pub filled: u32,
    /// Mean share over them.
    pub mean_contribution: f64,
}

/// Chooses for one partition among `training` (ascending, without held-out views). `own` is ascending. A
/// partition that no view shows keeps its own cameras.
pub fn choose(
    contributions: &Contributions,
    partition: usize,
    training: &[u32],
    own: &[u32],
    least: f64,
) -> Choice {
    let shares = contributions.of_partition(partition, training);
    let is_own = |view: u32| own.binary_search(&view).is_ok();
    let is_chosen = |&(view, share): &(u32, f64)| share > 0.0 && (share >= least || is_own(view));
    let (mut chosen, mut next): (Vec<_>, Vec<_>) = shares.into_iter().partition(is_chosen);
    next.retain(|(_, share)| *share > 0.0);
    next.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    next.truncate(MIN_CAMERAS.saturating_sub(chosen.len()));
    let filled = next.len() as u32;
    chosen.extend(next);
    if chosen.is_empty() {
        chosen = training.iter().filter(|&&view| is_own(view)).map(|&view| (view, 0.0)).collect();
    }
    chosen.sort_by_key(|(view, _)| *view);
    let sum: f64 = chosen.iter().map(|(_, share)| share).sum();
    Choice {
        mean_contribution: sum / chosen.len().max(1) as f64,
        views: chosen.into_iter().map(|(view, _)| view).collect(),
        filled,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Views 0, 1, 2 ... that show these shares of the only partition.
    fn showing(shares: &[f32]) -> (Contributions, Vec<u32>) {
        let views: Vec<u32> = (0..shares.len() as u32).collect();
        (Contributions::new(views.clone(), 1, shares.to_vec()).unwrap(), views)
    }

    #[test]
    fn own_views_need_any_share_and_others_the_threshold() {
        let mut shares = vec![0.5; 20];
        shares.extend([0.0, 0.01, 0.01, 0.05, 0.049]);
        let (known, training) = showing(&shares);
        let choice = choose(&known, 0, &training, &[20, 21], 0.05);
        let expected: Vec<u32> = (0..20).chain([21, 23]).collect();
        assert_eq!((choice.views, choice.filled), (expected, 0), "20 is its own and shows nothing");
        let mean = (20.0 * 0.5 + 0.01 + 0.05) / 22.0;
        assert!((choice.mean_contribution - mean).abs() < 1e-6, "{}", choice.mean_contribution);
    }

    #[test]
    fn too_few_are_filled_up_with_the_next_best_that_show_anything() {
        let mut shares: Vec<f32> = (0..30).map(|i| 0.04 - 0.001 * i as f32).collect();
        shares[7] = 0.0;
        let (known, training) = showing(&shares);
        let choice = choose(&known, 0, &training, &[29], 0.05);
        let expected: Vec<u32> = (0..MIN_CAMERAS as u32).filter(|view| *view != 7).chain([29]).collect();
        assert_eq!((choice.views, choice.filled), (expected, MIN_CAMERAS as u32 - 1));
        let (known, training) = showing(&[0.02, 0.0, 0.03]);
        assert_eq!(
            choose(&known, 0, &training, &[1], 0.05).views,
            [0, 2],
            "a view without a share fills nothing"
        );
    }

    #[test]
    fn a_partition_that_nobody_shows_keeps_its_own() {
        let (known, training) = showing(&[0.0; 9]);
        let choice = choose(&known, 0, &training, &[2, 5], 0.05);
        assert_eq!(choice, Choice { views: vec![2, 5], filled: 0, mean_contribution: 0.0 });
    }

    #[test]
    fn shares_that_are_none_are_refused() {
        assert!(Contributions::new(vec![1, 2], 2, vec![0.0, 0.5, 1.0, 0.25]).is_ok());
        for (partitions, shares) in [
            (2, vec![0.5; 3]),
            (0, Vec::new()),
            (1, vec![0.5, f32::NAN]),
            (1, vec![0.5, 1.01]),
            (1, vec![-0.1, 0.0]),
        ] {
            assert!(Contributions::new(vec![1, 2], partitions, shares.clone()).is_err(), "{shares:?}");
        }
    }

    proptest! {
        #[test]
        fn a_choice_depends_on_shares_and_has_training_views_only(
            shares in prop::collection::vec(prop_oneof![Just(0.0_f32), 0.0_f32..0.2], 3..80),
            own_of in 1_u32..9,
            held_out_of in 2_u32..9,
            turn in 0_usize..80,
            least in 0.0_f64..0.2,
        ) {
            let views: Vec<u32> = (0..shares.len() as u32).collect();
            let (training, held_out): (Vec<u32>, Vec<u32>) =
                views.iter().partition(|view| **view % held_out_of != 0);
            let own: Vec<u32> = training.iter().copied().filter(|view| view % own_of == 0).collect();
            // The second of two partitions; held-out views are known too, and must not be chosen.
            let both = shares.iter().flat_map(|&share| [0.9, share]).collect();
            let known = Contributions::new(views.clone(), 2, both).unwrap();
            let choice = choose(&known, 1, &training, &own, least);

            let mut rows: Vec<(u32, f32)> = views.iter().copied().zip(shares.iter().copied()).collect();
            rows.rotate_left(turn % shares.len());
            let turned = rows.iter().flat_map(|&(_, share)| [0.9, share]).collect();
            let turned = Contributions::new(rows.iter().map(|row| row.0).collect(), 2, turned).unwrap();
            prop_assert_eq!(&choose(&turned, 1, &training, &own, least), &choice, "another order");

            prop_assert!(choice.views.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert!(held_out.iter().all(|view| !choice.views.contains(view)));
            let share = |view: u32| f64::from(shares[view as usize]);
            let showing = training.iter().filter(|view| share(**view) > 0.0).count();
            if showing == 0 {
                prop_assert_eq!(&choice.views, &own);
            } else {
                prop_assert!(choice.views.len() >= MIN_CAMERAS.min(showing));
                prop_assert!(choice.views.iter().all(|&view| share(view) > 0.0));
                let enough = |view: &&u32| share(**view) > 0.0 && (share(**view) >= least || own.contains(view));
                prop_assert!(training.iter().filter(enough).all(|view| choice.views.contains(view)));
                prop_assert!(choice.filled == 0 || choice.views.len() == MIN_CAMERAS.min(showing));
            }
        }
    }
}
