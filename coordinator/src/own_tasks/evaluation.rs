//! The evaluation of a job: that of one task, or of several that measured a part of the held-out views each.

use std::ops::Range;
use std::sync::Arc;

use fathom_core::cover::{CoverReport, CoverSums};
use fathom_core::seams::{SeamReport, SeamSums};
use fathom_proto::worker::v1::{Evaluation, ViewMetrics};
use prost::Message;
use serde::de::DeserializeOwned;

use super::OwnTaskError;
use super::artifacts::unreadable;
use crate::objects::BlobStore;
use crate::schedule::{Artifact, Stage, TaskState};
use crate::store::JobView;

/// Longest evaluation that a task may submit, bytes: half a kB for each of some 100,000 held-out views.
pub const MAX_EVALUATION_BYTES: u64 = 64 << 20;

/// The held-out views of part `part` of `parts`, counted from 0, as positions in their list.
pub fn views_of_part(part: usize, parts: usize, held_out: usize) -> Range<usize> {
    let at = |part: usize| part * held_out / parts.max(1);
    at(part)..at(part + 1)
}

/// Measurements on all held-out views of a job.
pub struct Evaluated {
    /// Each view, ascending as in the plan.
    pub views: Vec<ViewMetrics>,
    /// At the borders of cells; `None` for a single partition.
    pub seams: Option<SeamReport>,
    /// How well the model covers the views; `None` if not measured.
    pub cover: Option<CoverReport>,
    /// Display gains of the images of J among the renders, linear light; `None` where there is no water.
    pub clear_gains: Option<[f64; 3]>,
}

/// The evaluation of a job with this many held-out views; `None` without any.
pub async fn read(
    objects: &Arc<BlobStore>,
    view: &JobView,
    held_out: usize,
) -> Result<Option<Evaluated>, OwnTaskError> {
    let (mut all, parts) = (None::<Collected>, view.job.shape.evaluations as usize);
    for (record, _) in &view.tasks {
        let TaskState::Done { result, .. } = &record.state else { continue };
        if record.task.stage != Stage::Evaluate {
            continue;
        }
        let bytes = objects.read_at_most(result, MAX_EVALUATION_BYTES).await?;
        let part =
            Evaluation::decode(bytes).map_err(|error| unreadable(Artifact::Evaluation, result, &error))?;
        let all = all.get_or_insert_default();
        match record.task.part {
            None => all.whole(part)?,
            Some(number) => {
                let views = views_of_part((number as usize).saturating_sub(1), parts, held_out);
                all.part(part, views.len())?;
            }
        }
    }
    Ok(all.map(Collected::evaluated))
}

/// What was read so far.
#[derive(Default)]
struct Collected {
    views: Vec<ViewMetrics>,
    clear_gains: Option<[f64; 3]>,
    /// Of a task that measured all views.
    seams: Option<SeamReport>,
    cover: Option<CoverReport>,
    /// Of tasks that measured a part each.
    seam_sums: SeamSums,
    cover_sums: CoverSums,
}

impl Collected {
    /// Adds the evaluation of all views.
    fn whole(&mut self, all: Evaluation) -> Result<(), OwnTaskError> {
        self.seams = parsed("borders", &all.seams_json)?;
        self.cover = parsed("cover", &all.cover_json)?;
        self.add_views(all);
        Ok(())
    }

    /// Adds that of the next `count` views. A report of them alone, which a worker of an earlier version
    /// sends, is none of all views.
    fn part(&mut self, part: Evaluation, count: usize) -> Result<(), OwnTaskError> {
        let differs = |what: &str, measured: usize| {
            OwnTaskError::failed(format!("{what} of {measured} views, and the task had {count}"))
        };
        if part.views.len() != count {
            return Err(differs("an evaluation", part.views.len()));
        }
        if let Some(mut sums) = parsed::<SeamSums>("sums at borders", &part.seam_sums_json)? {
            if sums.views() != count {
                return Err(differs("the borders", sums.views()));
            }
            // Workers send no more, and may not make the coordinator keep more.
            sums.thin();
            self.seam_sums.append(sums);
        }
        if let Some(sums) = parsed::<CoverSums>("sums of cover", &part.cover_sums_json)? {
            if sums.views() != count {
                return Err(differs("the cover", sums.views()));
            }
            self.cover_sums.append(sums);
        }
        self.add_views(part);
        Ok(())
    }

    fn add_views(&mut self, part: Evaluation) {
        if self.clear_gains.is_none() {
            let gains: Option<[f64; 3]> = part.clear_gains.as_slice().try_into().ok();
            self.clear_gains = gains.filter(|gains| gains.iter().all(|gain| gain.is_finite()));
        }
        self.views.extend(part.views);
    }

    /// A report of sums needs those of every view. They lack where a GPU had no room to measure borders.
    fn evaluated(self) -> Evaluated {
        let count = self.views.len();
        let is_whole = |measured: usize| measured > 0 && measured == count;
        let seams = is_whole(self.seam_sums.views()).then(|| self.seam_sums.report());
        let cover = is_whole(self.cover_sums.views()).then(|| self.cover_sums.report());
        Evaluated {
            views: self.views,
            seams: self.seams.or(seams),
            cover: self.cover.or(cover),
            clear_gains: self.clear_gains,
        }
    }
}

/// `None` for an empty text.
fn parsed<T: DeserializeOwned>(what: &str, text: &str) -> Result<Option<T>, OwnTaskError> {
    let text = Some(text).filter(|text| !text.is_empty());
    text.map(serde_json::from_str)
        .transpose()
        .map_err(|error| OwnTaskError::failed(format!("the {what} of an evaluation: {error}")))
}

#[cfg(test)]
impl Evaluated {
    /// Of these parts, each with its number of views.
    pub(crate) fn of_parts(parts: Vec<(Evaluation, usize)>) -> Result<Self, OwnTaskError> {
        let mut all = Collected::default();
        parts.into_iter().try_for_each(|(part, count)| all.part(part, count))?;
        Ok(all.evaluated())
    }

    /// Of one task.
    pub(crate) fn of_one(evaluation: Evaluation) -> Result<Self, OwnTaskError> {
        let mut all = Collected::default();
        all.whole(evaluation)?;
        Ok(all.evaluated())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use serde_json::json;

    use super::*;

    /// A view whose open pixels have this light, and whose band of the border has these squares.
    fn part(names: &[&str], holes: f64, squares: u64) -> Evaluation {
        let zone = |squares: u64| json!({"pixels": 1000, "squares": squares, "ssim": 900.0});
        let seams = |_: &&str| {
            json!({"border": zone(squares), "border_flank": zone(3000), "control": zone(3000),
                "control_flank": zone(3000), "interior": zone(3000), "least": 10.0})
        };
        let share = |sum: f64| json!({"sum": sum, "pixels": 100.0});
        let cover = |_: &&str| json!({"holes": share(holes), "open_water": share(0.0), "unseen": share(0.0)});
        let steps = |step: f32| json!({"pairs": 20 * names.len(), "steps": vec![step; 20 * names.len()]});
        let steps = [steps(squares as f32), steps(1.0)];
        let seam_sums = json!({"band": 0.5, "views": names.iter().map(seams).collect::<Vec<_>>(),
            "border_steps": steps, "control_steps": steps});
        let cover_sums = json!({"views": names.iter().map(cover).collect::<Vec<_>>(),
            "brightest": vec![1; 256]});
        Evaluation {
            views: names
                .iter()
                .map(|name| ViewMetrics { name: (*name).into(), ..Default::default() })
                .collect(),
            seam_sums_json: seam_sums.to_string(),
            cover_sums_json: cover_sums.to_string(),
            clear_gains: vec![1.0, 2.0, 3.0],
            ..Evaluation::default()
        }
    }

    #[test]
    fn parts_of_an_evaluation_give_the_report_of_all_views() {
        let all =
            Evaluated::of_parts(vec![(part(&["a", "b"], 10.0, 3000), 2), (part(&["c"], 40.0, 6000), 1)]);
        let all = all.unwrap();
        let names: Vec<&str> = all.views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!((names, all.clear_gains), (vec!["a", "b", "c"], Some([1.0, 2.0, 3.0])));
        let (seams, cover) = (all.seams.unwrap(), all.cover.unwrap());
        assert_eq!((cover.all.holes, cover.views.len()), (Some(0.2), 3));
        // Two views without a loss, and one with 3 dB.
        let loss = seams.seam_db.unwrap();
        assert!((loss - 10.0 * 2_f64.log10() / 3.0).abs() < 1e-9, "{loss}");
        assert_eq!((seams.border.views, seams.border.pixels, seams.band), (3, 3000, 0.5));
        // The median is that of all steps: 40 of 3000, 20 of 6000.
        assert_eq!((seams.range_step.border.pairs, seams.range_step.border.median), (60, Some(3000.0)));
    }

    #[test]
    fn a_part_without_borders_leaves_no_report_of_borders() {
        let without = Evaluation { seam_sums_json: String::new(), ..part(&["a"], 1.0, 1) };
        let all = Evaluated::of_parts(vec![(without, 1), (part(&["b"], 1.0, 1), 1)]).unwrap();
        assert!(all.seams.is_none() && all.cover.is_some(), "the report of a part as that of the whole");
    }

    #[test]
    fn a_part_of_an_earlier_version_has_no_report_of_all_views() {
        let cover_json = r#"{"holes": 0.5, "views": [{"holes": 0.5}]}"#.to_owned();
        let views = part(&["b"], 1.0, 1).views;
        let earlier = Evaluation { views, cover_json, ..Evaluation::default() };
        assert_eq!(Evaluated::of_one(earlier.clone()).unwrap().cover.unwrap().all.holes, Some(0.5));
        let all = Evaluated::of_parts(vec![(part(&["a"], 1.0, 1), 1), (earlier, 1)]).unwrap();
        assert!(all.cover.is_none() && all.views.len() == 2, "{:?}", all.cover);
    }

    #[test]
    fn parts_have_all_views_in_order() {
        for (parts, held_out) in [(1, 8), (3, 8), (5, 5), (4, 1000)] {
            let ranges: Vec<usize> =
                (0..parts).flat_map(|part| views_of_part(part, parts, held_out)).collect();
            assert_eq!(ranges, (0..held_out).collect::<Vec<_>>());
        }
    }

    #[test]
    fn sums_that_do_not_fit_their_views_are_refused() {
        let right = part(&["a"], 1.0, 1);
        assert!(Evaluated::of_parts(vec![(right.clone(), 1)]).is_ok());
        assert!(Evaluated::of_parts(vec![(right.clone(), 2)]).is_err(), "a view is missing");
        let mut wrong = right.clone();
        wrong.views.clear();
        assert!(Evaluated::of_parts(vec![(wrong, 0)]).is_err(), "sums of a view that is not there");
        let broken = Evaluation { cover_sums_json: "{".into(), ..right };
        assert!(Evaluated::of_parts(vec![(broken, 1)]).is_err());
    }
}
