//! Tests tasks on a real device: too little memory, a lost device, a panic, and a partition in two tasks.

mod borders;
mod previews;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use fathom_core::config::WaterPartitions;
use fathom_core::exchange::Exchange;
use fathom_core::picture::encode_png;
use fathom_core::scene::{Camera, CameraModel, ManifestView, Points, Pose};
use fathom_core::water::{Consensus, WaterRecord};
use fathom_proto::worker::v1::{FirstPartResult, FocusBox};
use glam::DVec3;
use prost::Message;

use super::*;

const MIB: u64 = 1 << 20;

/// An executor; `None` without an adapter, as in [`fathom_core::gpu::device_for_test`].
fn executor(what: &str, memory_limit: Option<u64>) -> Option<CoreExecutor> {
    fathom_core::gpu::device_for_test(what)?;
    let options = GpuOptions { allow_cpu: true, memory_limit, ..GpuOptions::default() };
    Some(CoreExecutor::new(options, MIB).unwrap())
}

/// Training on a few grey photographs and points, with room for `cap` Gaussians of SH degree 3.
fn task(dir: &Path, cap: u32) -> TaskInput {
    let mut files = HashMap::new();
    let mut put = |bytes: Vec<u8>| {
        let digest = blake3::hash(&bytes).to_hex().to_string();
        let (path, blob) = (dir.join(&digest), BlobRef { digest: digest.clone(), bytes: bytes.len() as u64 });
        std::fs::write(&path, bytes).unwrap();
        files.insert(digest, path);
        blob
    };
    let mut points = Points::default();
    for index in 0..100_u8 {
        let (x, z) = (f32::from(index % 10), f32::from(index / 10));
        points.positions.push([0.2 * x - 1.0, 0.0, 0.2 * z - 1.0]);
        points.colours.push([100, 110, 120]);
    }
    let points = put(points.to_bytes());
    let view = |index: u8| ManifestView {
        name: format!("{index}.png"),
        camera_id: 1,
        pose: Pose::looking_at(DVec3::new(f64::from(index) - 1.0, -3.0, -0.5), DVec3::ZERO, DVec3::Y),
        image: put(encode_png(32, 24, &[100 + index; 32 * 24 * 3]).unwrap()),
        mask: None,
    };
    let views: Vec<ManifestView> = (0..3).map(view).collect();
    let camera = Camera {
        id: 1,
        model: CameraModel::Pinhole,
        width: 32,
        height: 24,
        params: vec![28.0, 28.0, 16.0, 12.0],
    };
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (4, 6);
    config.train.max_gaussians = 24 * cap;
    let common = CommonSpec {
        views: (0..views.len() as u32).collect(),
        max_resolution_px: 32,
        iterations: 20,
        max_gaussians: cap,
        scene_extent: 3.0,
        ..CommonSpec::default()
    };
    TaskInput {
        stage: Stage::Partition,
        config,
        manifest: Manifest { format: 1, source: "test".into(), cameras: vec![camera], views, points },
        common,
        work: Work::Partition(PartitionSpec::default()),
        inputs: HashMap::new(),
        state: None,
        neighbours: Vec::new(),
        checkpoint: None,
        checkpoint_iteration: 0,
        files,
        reading: Arc::default(),
    }
}

impl TaskInput {
    /// The same as a task of a global stage.
    fn global(self) -> Self {
        Self { stage: Stage::Global, work: Work::Global(GlobalSpec::default()), ..self }
    }

    /// The specification of a partition, for changes.
    fn partition_mut(&mut self) -> &mut PartitionSpec {
        match &mut self.work {
            Work::FirstPart(spec) | Work::Partition(spec) => spec,
            other => panic!("{other:?} is no partition"),
        }
    }
}

/// Runs a closure at the first report, and never stops.
struct AtFirstReport<F: Fn() + Send + Sync>(F);

impl<F: Fn() + Send + Sync> Control for AtFirstReport<F> {
    fn report(&self, _: Progress) {
        self.0();
    }

    fn checkpoint(&self, _: Bytes, _: u32) {}

    fn stop_reason(&self) -> Option<Stop> {
        None
    }

    fn upload(&self, _: Bytes) -> Result<BlobRef, TaskError> {
        unreachable!("training uploads nothing by itself")
    }
}

/// Keeps uploads, and leaves after the given number of reports.
struct Keeps {
    uploaded: Mutex<Vec<Bytes>>,
    reports_left: Mutex<Option<u32>>,
    reported: Mutex<Vec<(u32, u32)>>,
}

impl Keeps {
    fn new(reports_left: Option<u32>) -> Self {
        Self {
            uploaded: Mutex::default(),
            reports_left: Mutex::new(reports_left),
            reported: Mutex::default(),
        }
    }
}

impl Control for Keeps {
    fn report(&self, progress: Progress) {
        self.reported.lock().unwrap().push((progress.iteration, progress.iterations));
        if let Some(left) = self.reports_left.lock().unwrap().as_mut() {
            *left = left.saturating_sub(1);
        }
    }

    fn checkpoint(&self, _: Bytes, _: u32) {}

    fn stop_reason(&self) -> Option<Stop> {
        (*self.reports_left.lock().unwrap() == Some(0)).then_some(Stop::Leave)
    }

    fn upload(&self, bytes: Bytes) -> Result<BlobRef, TaskError> {
        let blob = BlobRef { digest: blake3::hash(&bytes).to_hex().to_string(), bytes: bytes.len() as u64 };
        self.uploaded.lock().unwrap().push(bytes);
        Ok(blob)
    }
}

#[track_caller]
fn failure(result: Result<TaskOutput, TaskError>) -> (FailClass, String) {
    match result {
        Err(TaskError::Failed { class, message }) => (class, message),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_task_too_large_reports_its_needs_and_the_next_one_runs() {
    let Some(executor) = executor("a task without memory", Some(64 * MIB)) else { return };
    let dir = tempfile::tempdir().unwrap();
    let quiet = AtFirstReport(|| {});
    for _ in 0..2 {
        let (class, message) = failure(executor.execute(&task(dir.path(), 200_000), &quiet));
        assert_eq!(class, FailClass::OutOfMemory);
        for part in [
            "needs at least",
            "has 64.0 MiB",
            "use more partitions or lower --max-gaussians (now --partitions 4x6, --max-gaussians 4800000, ",
        ] {
            assert!(message.contains(part), "no {part:?} in {message:?}");
        }
        executor.prepare().unwrap();
        let done = executor.execute(&task(dir.path(), 2000), &quiet).unwrap();
        assert!(done.gaussians >= 100);
    }
}

#[test]
fn only_a_mip_filter_model_has_it_in_its_header() {
    let Some(executor) = executor("the header of a model", None) else { return };
    let dir = tempfile::tempdir().unwrap();
    for mip_filter in [false, true] {
        let mut task = task(dir.path(), 500);
        task.config.train.mip_filter = mip_filter;
        let done = executor.execute(&task, &AtFirstReport(|| {})).unwrap();
        let model = dir.path().join("model.ply");
        std::fs::write(&model, &done.result).unwrap();
        assert_eq!(fathom_core::ply::drawing(&model).unwrap().mip_filter, mip_filter);
    }
}

#[test]
fn a_task_leaves_no_memory_behind_for_the_next_one() {
    let Some(executor) = executor("the memory of tasks in a row", None) else { return };
    let dir = tempfile::tempdir().unwrap();
    let peak = || {
        executor.execute(&task(dir.path(), 20_000), &AtFirstReport(|| {})).unwrap();
        let gpu = executor.slot().clone().unwrap();
        gpu.memory().unwrap().peak_bytes
    };
    let (first, second) = (peak(), peak());
    // The amount of pending writes at the peak depends on timing.
    assert!(first > 14 * MIB && second < first + 4 * MIB, "{first} bytes, then {second}");
}

#[test]
fn a_lost_device_fails_its_task_and_the_next_has_a_new_one() {
    let Some(executor) = executor("a task whose device is lost", None) else { return };
    let dir = tempfile::tempdir().unwrap();
    let lost = executor.slot().clone().unwrap();
    let lose = AtFirstReport(|| lost.device().destroy());
    let (class, message) = failure(executor.execute(&task(dir.path(), 500), &lose));
    assert_eq!(class, FailClass::Device, "{message}");
    assert!(message.contains("the GPU was lost"), "{message}");
    executor.prepare().unwrap();
    let next = executor.slot().clone().unwrap();
    assert!(!Arc::ptr_eq(&lost, &next));
    executor.execute(&task(dir.path(), 500), &AtFirstReport(|| {})).unwrap();
    assert!(Arc::ptr_eq(&next, executor.slot().as_ref().unwrap()), "a working device was discarded");
}

#[test]
fn a_device_that_was_lost_between_tasks_fails_none() {
    let Some(executor) = executor("a device lost between tasks", None) else { return };
    let dir = tempfile::tempdir().unwrap();
    let quiet = AtFirstReport(|| {});
    executor.slot().as_ref().unwrap().device().destroy();
    executor.prepare().unwrap();
    executor.execute(&task(dir.path(), 500), &quiet).unwrap();

    // If it is lost after the worker's check, one task fails.
    executor.slot().as_ref().unwrap().device().destroy();
    assert_eq!(failure(executor.execute(&task(dir.path(), 500), &quiet)).0, FailClass::Device);
    executor.execute(&task(dir.path(), 500), &quiet).unwrap();
}

#[test]
fn a_task_that_panics_leaves_no_device_for_the_next_one() {
    let Some(executor) = executor("a task that panics", None) else { return };
    let dir = tempfile::tempdir().unwrap();
    let before = executor.slot().clone().unwrap();
    let panics = AtFirstReport(|| panic!("a fault of the test's"));
    assert!(catch_unwind(AssertUnwindSafe(|| executor.execute(&task(dir.path(), 500), &panics))).is_err());
    executor.execute(&task(dir.path(), 500), &AtFirstReport(|| {})).unwrap();
    assert!(!Arc::ptr_eq(&before, executor.slot().as_ref().unwrap()));
}

#[test]
fn a_device_other_than_the_registered_one_is_not_used() {
    let Some(mut executor) = executor("another device than before", None) else { return };
    executor.adapter.name = "a GPU that was unplugged".into();
    *executor.slot() = None;
    let Err(TaskError::Failed { class, message }) = executor.prepare() else {
        panic!("another device was taken")
    };
    assert_eq!(class, FailClass::Device);
    assert!(message.contains("a GPU that was unplugged is gone"), "{message}");
}

#[test]
fn a_global_stage_reads_its_water_from_photographs_of_full_size() {
    let dir = tempfile::tempdir().unwrap();
    let mut task = task(dir.path(), 500).global();
    // Noise has other colours at half size.
    for (index, view) in (0_u8..).zip(&task.manifest.views) {
        let code = |at: u16| {
            let [low, high] = at.to_le_bytes();
            60 + blake3::hash(&[index, low, high]).as_bytes()[0] / 2
        };
        let pixels: Vec<u8> = (0..32 * 24 * 3).map(code).collect();
        std::fs::write(task.file(&view.image).unwrap(), encode_png(32, 24, &pixels).unwrap()).unwrap();
    }
    let mut water = |of_stage: u32, of_job: u32| {
        (task.common.max_resolution_px, task.config.data.max_resolution) = (of_stage, of_job);
        let views = task.views(MIB).unwrap();
        assert_eq!(views.views()[0].camera.width, of_stage);
        training::parts_of_points(&task, Arc::clone(&views)).unwrap().0.medium.unwrap().water
    };
    let full = water(32, 32);
    assert_eq!(water(16, 32), full);
    assert_ne!(water(16, 16), full);
}

/// A coarse model with a water, and a partition that holds all of it; the first part ends at iteration 14
/// of 20.
struct TwoTasks {
    dir: tempfile::TempDir,
    task: TaskInput,
    result: FirstPartResult,
    state: Bytes,
}

impl TwoTasks {
    fn new(executor: &CoreExecutor) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut task = task(dir.path(), 500).global();
        task.config.water.partitions = WaterPartitions::Joint;
        let coarse = executor.execute(&task, &AtFirstReport(|| {})).unwrap().result;
        task.inputs.insert(Artifact::CoarseModel, Self::put(dir.path(), "coarse.ply", &coarse));
        task.common.until_iteration = 14;
        let focus = Some(FocusBox {
            align_quat_wxyz: vec![1.0, 0.0, 0.0, 0.0],
            min_x: f64::NEG_INFINITY,
            max_x: f64::INFINITY,
            min_z: f64::NEG_INFINITY,
            max_z: f64::INFINITY,
        });
        task.stage = Stage::FirstPart;
        task.work = Work::FirstPart(PartitionSpec { index: 3, focus, ..PartitionSpec::default() });
        let control = Keeps::new(None);
        let done = executor.execute(&task, &control).unwrap();
        assert_eq!(control.reported.lock().unwrap().last(), Some(&(14, 14)));
        let result = FirstPartResult::decode(done.result).unwrap();
        let state = control.uploaded.into_inner().unwrap().pop().unwrap();
        assert_eq!(result.state.as_ref().unwrap().digest, blake3::hash(&state).to_hex().as_str());
        Self { dir, task, result, state }
    }

    fn put(dir: &Path, name: &str, bytes: &[u8]) -> PathBuf {
        let path = dir.join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }

    fn coarse(&self) -> WaterRecord {
        fathom_core::ply::water_record(self.task.input(Artifact::CoarseModel).unwrap()).unwrap().unwrap()
    }

    /// The second part, under a consensus that is half as clear as the coarse water.
    fn second(&self, state: Option<&[u8]>) -> (TaskInput, WaterRecord) {
        let mut water = self.coarse();
        water.beta_d = water.beta_d.map(|beta| 2.0 * beta);
        let consensus = Consensus { format: 1, water: water.clone(), partitions: Vec::new() };
        let json = serde_json::to_vec(&Exchange::new(Some(consensus), BTreeMap::new())).unwrap();
        let mut task = self.task.clone();
        (task.stage, task.work) = (Stage::Partition, Work::Partition(task.partition().unwrap().clone()));
        (task.common.from_iteration, task.common.until_iteration) = (14, 0);
        task.inputs.insert(Artifact::Exchange, Self::put(self.dir.path(), "exchange.json", &json));
        task.state = state.map(|bytes| Self::put(self.dir.path(), "state", bytes));
        (task, water)
    }

    /// The water in a model's header.
    fn header(&self, model: &Bytes) -> Option<WaterRecord> {
        fathom_core::ply::water_record(&Self::put(self.dir.path(), "model.ply", model)).unwrap()
    }
}

#[test]
fn a_first_part_trains_its_water_and_submits_the_evidence() {
    let Some(executor) = executor("the first part of a partition", None) else { return };
    let two = TwoTasks::new(&executor);
    let FirstPartResult { format, partition, beta_d, evidence, unit, .. } = &two.result;
    assert_eq!((*format, *partition, *unit), (1, 3, 1.0));
    assert_ne!(beta_d[..], two.coarse().beta_d, "the water did not move");
    assert!(evidence.len() == 9 && evidence.iter().all(|weight| *weight > 0.0), "{evidence:?}");

    // An interrupted task submits the same.
    let leaves = Keeps::new(Some(1));
    let Err(TaskError::Stopped { checkpoint: Some((checkpoint, done)) }) =
        executor.execute(&two.task, &leaves)
    else {
        panic!("it did not leave")
    };
    assert!(done > 0 && done < 14, "left at {done}");
    let mut again = two.task.clone();
    again.checkpoint = Some(TwoTasks::put(two.dir.path(), "checkpoint", &checkpoint));
    let control = Keeps::new(None);
    let output = executor.execute(&again, &control).unwrap();
    assert_eq!(output.resumed_from, done);
    assert_eq!(FirstPartResult::decode(output.result).unwrap(), two.result);
    assert!(control.uploaded.lock().unwrap()[0] == two.state, "another state");
}

#[test]
fn a_second_part_resumes_under_the_agreed_water() {
    let Some(executor) = executor("the second part of a partition", None) else { return };
    let two = TwoTasks::new(&executor);
    let (task, water) = two.second(Some(&two.state));
    let control = Keeps::new(None);
    let whole = executor.execute(&task, &control).unwrap();
    assert_eq!(two.header(&whole.result), Some(water), "the header differs from the consensus");
    let reported = control.reported.lock().unwrap().clone();
    assert!(reported.iter().all(|(done, of)| *of == 6 && *done <= 6), "{reported:?}");
    assert_eq!(reported.last(), Some(&(6, 6)));

    let leaves = Keeps::new(Some(1));
    // The first span has eight iterations.
    let mut slow = task.clone();
    slow.common.iterations = 40;
    let undisturbed = {
        let control = Keeps::new(None);
        let mut first = two.task.clone();
        first.common.iterations = 40;
        executor.execute(&first, &control).unwrap();
        let state = control.uploaded.into_inner().unwrap().pop().unwrap();
        slow.state = Some(TwoTasks::put(two.dir.path(), "slow state", &state));
        executor.execute(&slow, &Keeps::new(None)).unwrap()
    };
    let Err(TaskError::Stopped { checkpoint: Some((checkpoint, done)) }) = executor.execute(&slow, &leaves)
    else {
        panic!("it did not leave")
    };
    assert!(done > 0 && done < 26, "left at {done}");
    slow.checkpoint = Some(TwoTasks::put(two.dir.path(), "checkpoint", &checkpoint));
    let resumed = executor.execute(&slow, &Keeps::new(None)).unwrap();
    assert_eq!(resumed.resumed_from, done);
    assert!(resumed.result == undisturbed.result, "resumed to other bytes");
}

#[test]
fn a_state_that_does_not_fit_costs_time_and_not_the_job() {
    let Some(executor) = executor("a state of another run", None) else { return };
    let two = TwoTasks::new(&executor);
    let fits = executor.execute(&two.second(Some(&two.state)).0, &Keeps::new(None)).unwrap();
    for state in [None, Some(b"torn".as_slice())] {
        let (task, water) = two.second(state);
        let control = Keeps::new(None);
        let done = executor.execute(&task, &control).unwrap();
        assert_eq!(two.header(&done.result), Some(water));
        assert!(done.result != fits.result, "a run of its own has other bytes");
        let reported = control.reported.lock().unwrap().clone();
        assert!(reported.is_sorted() && reported.last() == Some(&(6, 6)), "{reported:?}");
    }
}

/// The cells of two neighbours meet at x = 0. This one renders the Gaussians that the other submitted, and
/// submits none of them.
#[test]
fn a_second_part_trains_its_cell_beside_its_neighbours() {
    let Some(executor) = executor("a partition beside its neighbours", None) else { return };
    let mut two = TwoTasks::new(&executor);
    let mut cell = two.task.partition_mut().focus.clone().unwrap();
    cell.max_x = 0.0;
    two.task.partition_mut().cell = Some(cell);
    let first = |water: WaterPartitions| {
        let mut task = two.task.clone();
        task.config.water.partitions = water;
        let control = Keeps::new(None);
        let result = FirstPartResult::decode(executor.execute(&task, &control).unwrap().result).unwrap();
        let [state, rows] = <[Bytes; 2]>::try_from(control.uploaded.into_inner().unwrap()).unwrap();
        assert_eq!(result.rows.as_ref().unwrap().digest, blake3::hash(&rows).to_hex().as_str());
        assert_eq!(
            result.beta_d.is_empty(),
            water == WaterPartitions::Frozen,
            "a partition that keeps the water reports nothing about it"
        );
        (task, state, rows)
    };
    let model = |bytes: &Bytes, name: &str| {
        fathom_core::ply::read_model(&TwoTasks::put(two.dir.path(), name, bytes)).unwrap()
    };
    for water in [WaterPartitions::Frozen, WaterPartitions::Joint] {
        let (mut task, state, rows) = first(water);
        assert!(state != two.state || water == WaterPartitions::Joint, "the water moved");
        let own = model(&rows, "own.ply");
        assert!(own.len() > 10 && own.means.iter().all(|mean| mean[0] <= 0.0), "rows beyond the cell");
        let second = two.second(Some(&state)).0;
        task.work = second.work.clone();
        (task.stage, task.common) = (second.stage, second.common.clone());
        (task.inputs, task.state) = (second.inputs.clone(), second.state);
        if water == WaterPartitions::Frozen {
            let json = serde_json::to_vec(&Exchange::new(None, BTreeMap::new())).unwrap();
            task.inputs.insert(Artifact::Exchange, TwoTasks::put(two.dir.path(), "exchange.json", &json));
        }
        let run = |neighbours: &[&PathBuf]| {
            let task = TaskInput {
                neighbours: neighbours.iter().map(|path| (*path).clone()).collect(),
                ..task.clone()
            };
            let result = executor.execute(&task, &Keeps::new(None)).unwrap().result;
            assert!(
                result == executor.execute(&task, &Keeps::new(None)).unwrap().result,
                "not the same bytes again"
            );
            let model = model(&result, "result.ply");
            // Training may move a Gaussian slightly over the border.
            let beyond = model.means.iter().filter(|mean| mean[0] > 0.1).count();
            assert!(20 * beyond < model.len(), "{beyond} of {} belong to its neighbour", model.len());
            (model, result)
        };
        // The neighbour submits the mirror image of this cell.
        let mut mirrored = own.clone();
        mirrored.means.iter_mut().for_each(|mean| mean[0] = 0.01 - mean[0]);
        let path = TwoTasks::put(
            two.dir.path(),
            "neighbour.ply",
            &fathom_core::ply::to_bytes(&mirrored, &[]).unwrap(),
        );
        let (beside, bytes) = run(&[&path]);
        let (alone, _) = run(&[]);
        assert!(
            beside.len() >= own.len() / 2 && beside.means != alone.means,
            "{water:?}: the neighbour has no effect"
        );
        // The neighbour's rows in this cell are ignored.
        let all_here = TwoTasks::put(two.dir.path(), "here.ply", &rows);
        assert!(run(&[&path, &all_here]).1 == bytes, "{water:?}: rows in this cell count");
        assert!(two.header(&bytes).is_some(), "no water");
    }
}

#[test]
fn a_partition_without_anything_to_train_follows_the_others() {
    let Some(executor) = executor("an empty partition", None) else { return };
    let mut two = TwoTasks::new(&executor);
    two.task.partition_mut().focus.as_mut().unwrap().min_x = 1e6;
    let control = Keeps::new(None);
    let first = FirstPartResult::decode(executor.execute(&two.task, &control).unwrap().result).unwrap();
    assert_eq!((first.state, first.evidence), (None, vec![0.0; 9]));
    assert_eq!(first.beta_d[..], two.coarse().beta_d);
    assert!(control.uploaded.lock().unwrap().is_empty());
    let (task, water) = two.second(None);
    let done = executor.execute(&task, &control).unwrap();
    assert_eq!((done.gaussians, two.header(&done.result)), (0, Some(water)));
}

#[test]
fn a_task_follows_the_factors_and_view_weights_of_its_spec() {
    let dir = tempfile::tempdir().unwrap();
    let mut task = task(dir.path(), 500);
    let plain = task.train_config();
    assert_eq!(plain.loss_factor, 1.0);
    assert!(task.views(0).unwrap().weights().is_none());
    let spec = task.partition_mut();
    spec.loss_factor = Some(0.25);
    let weighed = task.train_config();
    assert_eq!(weighed.loss_factor, 0.25);
    let weighted = |view_weights: Vec<f32>| Work::Global(GlobalSpec { view_weights });
    task.work = weighted(vec![0.5, 2.0, 1.0]);
    assert_eq!(task.views(0).unwrap().weights(), Some(&[0.5, 2.0, 1.0][..]));
    task.work = weighted(vec![0.5]);
    assert!(task.views(0).is_err(), "a weight for one of three views");
}

#[test]
fn views_have_clear_ranges_if_the_spec_has_them_for_all() {
    let dir = tempfile::tempdir().unwrap();
    let mut task = task(dir.path(), 500);
    let ranges = |task: &TaskInput| -> Vec<f32> {
        task.views(0).unwrap().views().iter().map(|view| view.clear_range).collect()
    };
    assert_eq!(ranges(&task), [0.0; 3]);
    task.common.clear_ranges = vec![1.5, 0.0, 2.5];
    assert_eq!(ranges(&task), [1.5, 0.0, 2.5]);
    for wrong in [vec![1.5], vec![1.5, -1.0, 2.5], vec![1.5, f32::NAN, 2.5], vec![f32::INFINITY; 3]] {
        task.common.clear_ranges = wrong;
        let Err(TaskError::Failed { class: FailClass::Input, message }) = task.views(0) else {
            panic!("{:?} was taken", task.common.clear_ranges);
        };
        assert!(message.contains("clear ranges"), "{message}");
    }
}
