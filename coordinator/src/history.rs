//! How the training of each task went: points of its curves and previews, which outlive the task, its worker
//! and this process.
//!
//! News wait in memory for some seconds. Then they are merged into the stored history of their task
//! ([`Logs::put_history`]), so that several coordinators can take turns on a task. If two write in the same
//! moment, the news of one are lost, as are those that wait in a crash. No decision depends on a history.

use std::collections::{BTreeMap, HashSet};
use std::mem;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fathom_proto::{v1, worker};
use prost::Message as _;

use crate::logs::LogError;
use crate::schedule::{JobId, Lease, TaskId};
use crate::services::encode::timestamp;
use crate::state::{State, stopped};
use crate::store::StoreError;

/// Points of a stored curve at most.
const MOST_POINTS: usize = 240;
/// Previews of a task at most.
const MOST_PREVIEWS: usize = 96;
/// Previews of a message that are read.
const MOST_PREVIEWS_IN_MESSAGE: usize = 8;
/// Points and previews of an answer about all tasks at most, and points of each of its tasks at least.
const MOST_IN_ANSWER: usize = 12_000;
const MOST_PREVIEWS_IN_ANSWER: usize = 2000;
const LEAST_OF_TASK: usize = 12;
/// Largest picture of a preview that is kept, bytes, as its worker states it: a JPEG of 480 x 480 pixels has
/// far less. Pages read no further.
const MAX_PICTURE_BYTES: u64 = 512 << 10;
/// Longest name of a view that is kept, bytes.
const MAX_NAME_BYTES: usize = 1024;
/// Points of a task that wait in memory at most.
const MOST_WAITING: usize = 480;
/// Points of a message that are read.
const MOST_IN_MESSAGE: usize = 64;
/// Pause between two rounds of storing.
const STORE_EVERY: Duration = Duration::from_secs(5);
/// An attempt that has reported in this time still runs: a second attempt at its task does not replace its
/// points, whose iterations are higher.
const RUNS_WITHIN_SECONDS: i64 = 60;

/// News that wait to be stored.
#[derive(Default)]
pub struct Waiting(Mutex<AllNews>);

/// News by task.
type ByTask = BTreeMap<(JobId, TaskId), News>;

#[derive(Default)]
struct AllNews {
    new: ByTask,
    /// Those that a round is storing: readers see them until they are stored.
    storing: ByTask,
}

/// What has arrived about a task.
#[derive(Clone, Default)]
struct News {
    points: Vec<v1::HistoryPoint>,
    previews: Vec<v1::Preview>,
}

impl News {
    /// Adds what came later.
    fn extend(&mut self, later: Self) {
        self.points.extend(later.points);
        self.previews.extend(later.previews);
        // The store does not answer: the latest are kept.
        self.points.drain(..self.points.len().saturating_sub(MOST_WAITING));
        self.previews.drain(..self.previews.len().saturating_sub(MOST_PREVIEWS));
    }
}

impl Waiting {
    fn lock(&self) -> MutexGuard<'_, AllNews> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes what a worker measured under a valid lease.
    pub fn add(&self, lease: &Lease, measured: Vec<worker::v1::Measured>, now_ms: u64) {
        let mut news = News::default();
        for worker::v1::Measured { progress, age_ms, previews } in measured.into_iter().take(MOST_IN_MESSAGE)
        {
            let time = Some(timestamp(now_ms.saturating_sub(age_ms.into())));
            let point =
                |progress| v1::HistoryPoint { time, attempt: lease.attempt, progress: Some(progress) };
            news.points.extend(progress.filter(is_readable).map(point));
            let sound = previews.into_iter().filter(is_sound);
            news.previews.extend(sound.take(MOST_PREVIEWS_IN_MESSAGE));
        }
        if !news.points.is_empty() || !news.previews.is_empty() {
            self.lock().new.entry((lease.job.clone(), lease.task)).or_default().extend(news);
        }
    }

    fn of_job(&self, job: &JobId) -> Vec<(TaskId, News)> {
        let AllNews { new, storing } = &*self.lock();
        let of_job = storing.iter().chain(new).filter(|((of, _), _)| of == job);
        of_job.map(|((_, task), news)| (*task, news.clone())).collect()
    }

    /// Begins a round of storing; returns the tasks with news.
    fn begin_round(&self) -> Vec<(JobId, TaskId)> {
        let AllNews { new, storing } = &mut *self.lock();
        storing.append(new);
        storing.keys().cloned().collect()
    }

    fn being_stored(&self, key: &(JobId, TaskId)) -> Option<News> {
        self.lock().storing.get(key).cloned()
    }

    fn is_stored(&self, key: &(JobId, TaskId)) {
        self.lock().storing.remove(key);
    }

    /// Ends a round. What could not be stored waits for the next one.
    fn end_round(&self) {
        let AllNews { new, storing } = &mut *self.lock();
        for (key, mut news) in mem::take(storing) {
            news.extend(new.remove(&key).unwrap_or_default());
            new.insert(key, news);
        }
    }
}

/// Whether a preview has what it needs: a page shows its texts.
fn is_sound(preview: &v1::Preview) -> bool {
    let is_blob = |blob: &v1::BlobRef| {
        blob.size_bytes <= MAX_PICTURE_BYTES
            && blob.digest.len() == 64
            && blob.digest.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
    };
    preview.view.len() <= MAX_NAME_BYTES
        && !preview.view.contains(char::is_control)
        && preview.render.as_ref().is_some_and(is_blob)
        && preview.clear.as_ref().is_none_or(is_blob)
        && preview.psnr_db.is_none_or(f64::is_finite)
}

/// Whether all numbers of a report can be drawn.
fn is_readable(progress: &v1::Progress) -> bool {
    let held_out = progress.held_out.as_ref();
    let of_rgb = |of: &v1::Rgb| [of.red, of.green, of.blue];
    let water = progress.water.iter().flat_map(|water| [water.beta_d, water.beta_b, water.b_inf]);
    let errors = progress.water.iter().filter_map(|water| water.standard_error);
    let errors = errors.flat_map(|errors| [errors.beta_d, errors.beta_b, errors.b_inf]);
    let mut errors = errors.flatten().flat_map(|of| [of.red, of.green, of.blue]).flatten();
    let spent = progress.time_spent.iter().flat_map(|spent| {
        [
            spent.seconds,
            spent.fetching_seconds,
            spent.training_seconds,
            spent.photographs_seconds,
            spent.watching_seconds,
            spent.sending_seconds,
            spent.disk_seconds.unwrap_or_default(),
        ]
    });
    progress.iterations_per_second.is_finite()
        && progress.loss.is_finite()
        && water.flatten().all(|of| of_rgb(&of).iter().all(|value| value.is_finite()))
        && errors.all(|error| error.is_finite() && error >= 0.0)
        && spent.into_iter().all(f32::is_finite)
        && held_out.is_none_or(|held_out| held_out.psnr_db.is_finite() && held_out.ssim.is_finite())
}

/// Stores points until the coordinator stops, and what waits then.
pub async fn store(shared: Arc<State>) {
    let mut stopping = shared.stopping.clone();
    loop {
        let is_last = tokio::select! {
            () = stopped(&mut stopping) => true,
            () = tokio::time::sleep(STORE_EVERY) => false,
        };
        store_waiting(&shared).await;
        if is_last {
            return;
        }
    }
}

/// Stores what waits now.
pub async fn store_waiting(shared: &State) {
    let waiting = &shared.history;
    let mut failed = None;
    for key in waiting.begin_round() {
        let Some(news) = waiting.being_stored(&key) else { continue };
        match merge(shared, &key.0, key.1, &news).await {
            Ok(()) => waiting.is_stored(&key),
            Err(error) => {
                let is_away = matches!(error, LogError::Store(StoreError::Unavailable(_)));
                failed = Some(error);
                // Every other task would wait for the database as long.
                if is_away {
                    break;
                }
            }
        }
    }
    waiting.end_round();
    if let Some(error) = failed {
        tracing::debug!(%error, "points of curves wait for the next try");
    }
}

/// Adds news to the stored history of a task.
async fn merge(shared: &State, job: &JobId, task: TaskId, news: &News) -> Result<(), LogError> {
    match shared.jobs.job_row(job).await {
        Ok(_) => {}
        // It was deleted, and its history with it.
        Err(StoreError::JobNotFound(_)) => return Ok(()),
        Err(error) => return Err(error.into()),
    }
    let mut known = stored(shared, job, Some(task)).await?.remove(&task).unwrap_or_default();
    add_all(&mut known, news);
    known.task_id = task.to_string();
    if shared.logs.is_on_disk() && shared.objects.check_space(0).await.is_err() {
        // Space is for results.
        return Ok(());
    }
    shared.logs.put_history(job, task, known.encode_to_vec()).await
}

async fn stored(
    shared: &State,
    job: &JobId,
    task: Option<TaskId>,
) -> Result<BTreeMap<TaskId, v1::TaskHistory>, LogError> {
    let stored = shared.logs.histories(job, task).await?;
    // Files are not synced: one that a power cut has damaged counts as none.
    let history = |(task, bytes): (TaskId, Vec<u8>)| {
        let known = v1::TaskHistory::decode(&*bytes).ok()?;
        Some((task, v1::TaskHistory { task_id: task.to_string(), ..known }))
    };
    Ok(stored.into_iter().filter_map(history).collect())
}

/// The digests of all pictures that the history of a job names.
///
/// # Errors
/// When the disk or the database fails.
pub async fn pictures(shared: &State, job: &JobId) -> Result<HashSet<String>, LogError> {
    // In this order: what is stored in between is there twice.
    let waiting = shared.history.of_job(job);
    let stored = stored(shared, job, None).await?;
    let waiting = waiting.into_iter().flat_map(|(_, news)| news.previews);
    let previews = waiting.chain(stored.into_values().flat_map(|history| history.previews));
    Ok(previews.flat_map(|of| [of.render, of.clear]).flatten().map(|picture| picture.digest).collect())
}

/// The history of one task of a job, or of all, with what waits in this process. That of many tasks is
/// thinned ([`MOST_IN_ANSWER`]).
///
/// # Errors
/// When the disk or the database fails.
pub async fn of_job(shared: &State, job: &JobId, task: Option<TaskId>) -> Result<v1::History, LogError> {
    // In this order: what is stored in between is there twice, which `add` tolerates.
    let waiting = shared.history.of_job(job);
    let mut tasks = stored(shared, job, task).await?;
    for (of, news) in waiting.into_iter().filter(|(of, _)| task.is_none_or(|task| task == *of)) {
        let history = tasks.entry(of).or_default();
        history.task_id = of.to_string();
        add_all(history, &news);
    }
    let mut tasks: Vec<_> = tasks.into_values().collect();
    thin_all(&mut tasks);
    Ok(v1::History { tasks })
}

/// Thins the histories of many tasks, so that the answer of a job of a thousand partitions has a bound.
fn thin_all(tasks: &mut [v1::TaskHistory]) {
    let points = (MOST_IN_ANSWER / tasks.len().max(1)).max(LEAST_OF_TASK);
    let previews: usize = tasks.iter().map(|task| task.previews.len()).sum();
    for task in tasks.iter_mut() {
        while task.points.len() > points {
            halve(&mut task.points);
        }
        if previews > MOST_PREVIEWS_IN_ANSWER {
            let latest = task.previews.last().map_or(0, |preview| preview.iteration);
            task.previews.retain(|preview| preview.iteration == latest);
        }
    }
}

fn add_all(history: &mut v1::TaskHistory, news: &News) {
    news.points.iter().for_each(|point| add(&mut history.points, *point));
    for preview in &news.previews {
        show(&mut history.previews, preview);
    }
}

fn iteration(point: &v1::HistoryPoint) -> u32 {
    point.progress.map_or(0, |progress| progress.iteration)
}

/// Adds a point behind a curve, and thins the curve when it has become too long.
fn add(curve: &mut Vec<v1::HistoryPoint>, point: v1::HistoryPoint) {
    let seconds = |point: &v1::HistoryPoint| point.time.map_or(0, |time| time.seconds);
    if let Some(last) = curve.last_mut() {
        if iteration(&point) == iteration(last) && point.attempt == last.attempt {
            // It knows more: a measurement of this iteration, or the time until its result was stored.
            *last = point;
            return;
        }
        let is_behind = iteration(&point) > iteration(last);
        let still_runs = seconds(&point) - seconds(last) < RUNS_WITHIN_SECONDS;
        if !is_behind && (point.attempt <= last.attempt || still_runs) {
            return;
        }
        curve.retain(|known| iteration(known) < iteration(&point));
    }
    // The latest point may be closer to the one before it than others are; the next one takes its place then.
    if let [earlier @ .., before, last] = curve.as_slice() {
        let between = |a: &v1::HistoryPoint, b: &v1::HistoryPoint| iteration(b).saturating_sub(iteration(a));
        let mut gaps: Vec<u32> = earlier.windows(2).map(|pair| between(&pair[0], &pair[1])).collect();
        gaps.sort_unstable();
        let usual = gaps.get(gaps.len() / 2).copied().unwrap_or_default();
        if between(before, last) < usual {
            curve.pop();
        }
    }
    curve.push(point);
    if curve.len() > MOST_POINTS {
        halve(curve);
    }
}

/// Leaves out every other point between the first and the last.
fn halve(curve: &mut Vec<v1::HistoryPoint>) {
    let last = curve.len().saturating_sub(1);
    let mut place = 0;
    curve.retain(|_| {
        place += 1;
        place % 2 == 1 || place - 1 == last
    });
}

/// Adds a preview; when there are too many, every other iteration between the first and the last is left
/// out.
fn show(previews: &mut Vec<v1::Preview>, new: &v1::Preview) {
    if previews.iter().any(|known| known.iteration == new.iteration && known.view == new.view) {
        return;
    }
    let place = previews.partition_point(|known| known.iteration <= new.iteration);
    previews.insert(place, new.clone());
    while previews.len() > MOST_PREVIEWS {
        let mut iterations: Vec<u32> = previews.iter().map(|preview| preview.iteration).collect();
        iterations.dedup();
        // All of one iteration: more views than a run shows.
        if iterations.len() <= 2 {
            previews.truncate(MOST_PREVIEWS);
            return;
        }
        let last = iterations.len() - 1;
        let is_kept = |iteration: u32| {
            iterations.iter().position(|&known| known == iteration).is_none_or(|at| at % 2 == 0 || at == last)
        };
        previews.retain(|preview| is_kept(preview.iteration));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(attempt: u32, iteration: u32, seconds: i64) -> v1::HistoryPoint {
        let progress = v1::Progress { iteration, ..v1::Progress::default() };
        let time = prost_types::Timestamp { seconds, nanos: 0 };
        v1::HistoryPoint { time: Some(time), attempt, progress: Some(progress) }
    }

    fn iterations(curve: &[v1::HistoryPoint]) -> Vec<u32> {
        curve.iter().map(iteration).collect()
    }

    #[test]
    fn a_long_curve_stays_even_and_keeps_its_ends() {
        let mut curve = Vec::new();
        for step in 1..=30_000 {
            add(&mut curve, point(1, step, step.into()));
            assert!(curve.len() <= MOST_POINTS);
            assert_eq!((iteration(&curve[0]), iteration(&curve[curve.len() - 1])), (1, step));
        }
        let steps = iterations(&curve);
        assert!(steps.len() > MOST_POINTS / 3, "{}", steps.len());
        let gaps: Vec<u32> = steps.windows(2).map(|pair| pair[1] - pair[0]).collect();
        // The last one apart, which waits for its place.
        let (widest, narrowest) = (gaps.iter().max(), gaps[..gaps.len() - 1].iter().min());
        assert!(widest <= narrowest.map(|gap| gap * 4).as_ref(), "{widest:?} {narrowest:?}");
    }

    #[test]
    fn a_resumed_attempt_replaces_the_points_after_its_checkpoint() {
        let mut curve = Vec::new();
        for step in [10, 20, 30, 40] {
            add(&mut curve, point(1, step, 0));
        }
        add(&mut curve, point(2, 25, RUNS_WITHIN_SECONDS));
        add(&mut curve, point(2, 35, RUNS_WITHIN_SECONDS + 1));
        assert_eq!(iterations(&curve), [10, 20, 25, 35]);
        assert_eq!(curve.iter().map(|point| point.attempt).collect::<Vec<_>>(), [1, 1, 2, 2]);
    }

    #[test]
    fn a_second_attempt_is_left_out_until_it_leads() {
        let mut curve = vec![point(1, 50, 100)];
        add(&mut curve, point(2, 10, 101));
        assert_eq!(iterations(&curve), [50]);
        add(&mut curve, point(2, 60, 102));
        add(&mut curve, point(1, 55, 103));
        assert_eq!(iterations(&curve), [50, 60]);
        // Twice the same, as when it was stored and sent again.
        add(&mut curve, point(2, 60, 102));
        assert_eq!(iterations(&curve), [50, 60]);
    }

    #[test]
    fn points_that_cannot_be_drawn_or_are_too_many_are_left_out() {
        let waiting = Waiting::default();
        let lease = Lease {
            job: "01a21ea5539c6b5f23ab".parse().unwrap(),
            task: crate::schedule::Stage::Global.task(),
            attempt: 1,
            fence: 1,
        };
        let measured = |loss, iteration| worker::v1::Measured {
            progress: Some(v1::Progress { loss, iteration, ..v1::Progress::default() }),
            age_ms: 500,
            previews: Vec::new(),
        };
        waiting.add(&lease, vec![measured(f32::NAN, 1), measured(0.5, 2)], 10_000);
        let of_job = waiting.of_job(&lease.job);
        assert_eq!(of_job.len(), 1);
        assert_eq!(iterations(&of_job[0].1.points), [2]);
        assert_eq!(of_job[0].1.points[0].time.map(|time| (time.seconds, time.nanos)), Some((9, 500_000_000)));
        for round in 0..20 {
            let many = (0..1000).map(|step| measured(0.5, 1000 * round + step)).collect();
            waiting.add(&lease, many, 20_000);
        }
        assert_eq!(waiting.of_job(&lease.job)[0].1.points.len(), MOST_WAITING);
    }

    fn preview(view: &str, iteration: u32) -> v1::Preview {
        let render = Some(v1::BlobRef { digest: "a".repeat(64), size_bytes: 1 });
        v1::Preview { view: view.to_owned(), iteration, render, clear: None, psnr_db: Some(20.0) }
    }

    #[test]
    fn news_are_visible_until_stored_and_wait_after_a_failure() {
        let waiting = Waiting::default();
        let [one, two] = [1, 2].map(|part| Lease {
            job: "01a21ea5539c6b5f23ab".parse().unwrap(),
            task: crate::schedule::Stage::Partition.task_of(part),
            attempt: 1,
            fence: 1,
        });
        let measured = |iteration| worker::v1::Measured {
            progress: Some(v1::Progress { iteration, ..v1::Progress::default() }),
            ..worker::v1::Measured::default()
        };
        waiting.add(&one, vec![measured(1)], 0);
        waiting.add(&two, vec![measured(1)], 0);
        let keys = waiting.begin_round();
        assert_eq!(
            (keys.len(), waiting.of_job(&one.job).len()),
            (2, 2),
            "a reader misses what is stored now"
        );
        waiting.add(&two, vec![measured(2)], 0);
        assert!(waiting.being_stored(&keys[0]).is_some());
        waiting.is_stored(&keys[0]);
        waiting.end_round();
        let left = waiting.of_job(&one.job);
        assert_eq!((left.len(), left[0].0, iterations(&left[0].1.points)), (1, two.task, vec![1, 2]));
    }

    #[test]
    fn the_answer_about_a_thousand_tasks_has_a_bound() {
        let mut curve = Vec::new();
        (1..=500).for_each(|step| add(&mut curve, point(1, step, step.into())));
        let previews: Vec<_> = (1..=20).flat_map(|step| [preview("a", step), preview("b", step)]).collect();
        let task = v1::TaskHistory { task_id: "partition-0001".into(), points: curve, previews };
        let mut few = vec![task.clone(); 4];
        thin_all(&mut few);
        assert_eq!(few, vec![task.clone(); 4]);
        let mut many = vec![task.clone(); 2000];
        thin_all(&mut many);
        assert!(many[0].points.len() >= LEAST_OF_TASK / 2 && many[0].previews.len() == 2);
        assert_eq!(many[0].points.last(), task.points.last());
        let bytes = v1::History { tasks: many }.encoded_len();
        assert!(bytes < 4 << 20, "{bytes} bytes");
    }

    #[test]
    fn many_previews_are_thinned_and_the_ends_stay() {
        let mut previews = Vec::new();
        for iteration in 1..=500 {
            for view in ["a", "b"] {
                show(&mut previews, &preview(view, iteration));
                show(&mut previews, &preview(view, iteration));
            }
            assert!(previews.len() <= MOST_PREVIEWS);
            assert_eq!((previews[0].iteration, previews[previews.len() - 1].iteration), (1, iteration));
        }
        assert!(previews.len() > MOST_PREVIEWS / 3, "{}", previews.len());
        assert!(previews.is_sorted_by_key(|preview| preview.iteration));
        for index in 0..200 {
            show(&mut previews, &preview(&index.to_string(), 900));
        }
        assert!(previews.len() <= MOST_PREVIEWS);
    }

    #[test]
    fn a_hostile_preview_is_left_out() {
        assert!(is_sound(&preview("dive/one.png", 1)));
        assert!(!is_sound(&preview("one\u{1b}[2J", 1)) && !is_sound(&preview(&"x".repeat(2000), 1)));
        let digest = v1::BlobRef { digest: "../../x".into(), size_bytes: 1 };
        assert!(!is_sound(&v1::Preview { render: Some(digest.clone()), ..preview("a", 1) }));
        assert!(!is_sound(&v1::Preview { clear: Some(digest), ..preview("a", 1) }));
        assert!(!is_sound(&v1::Preview { render: None, ..preview("a", 1) }));
        assert!(!is_sound(&v1::Preview { psnr_db: Some(f64::NAN), ..preview("a", 1) }));
        let large = v1::BlobRef { digest: "a".repeat(64), size_bytes: 1 << 30 };
        assert!(!is_sound(&v1::Preview { render: Some(large), ..preview("a", 1) }));
    }
}
