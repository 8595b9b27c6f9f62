//! A trainer that needs no GPU: it submits small models after pauses, and fails or hangs on a test's request.

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::config::{Composition, WaterPartitions};
use fathom_core::exchange::Exchange;
use fathom_core::gaussians::Gaussians;
use fathom_core::ply;
use fathom_core::scene::{BlobRef, Points};
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use fathom_worker::blobs::to_proto;
use fathom_worker::execute::{Control, Executor, Picture, Stop, TaskError, TaskInput, TaskOutput};
use glam::{DQuat, DVec3};
use prost::Message as _;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use fathom_proto::worker::v1::Artifact;
use fathom_proto::worker::v1::task_spec::Work;

use super::*;

/// Trains by hashing: the state after an iteration is the hash of the state before it and its number.
pub struct FakeTrainer {
    pause: Duration,
    /// Pause between two checks for a stop while it hangs after its first checkpoint.
    hangs: Option<Duration>,
    /// The only stage in whose tasks it hangs.
    hangs_only_in: Option<v1::Stage>,
    failures_left: AtomicU32,
    /// Number of `prepare` calls that still fail.
    pub unready: AtomicU32,
    /// Whether every task runs out of memory.
    too_small: bool,
    pub started: AtomicBool,
    /// Number of `train` calls so far, running now, and the maximum at a time.
    pub calls: AtomicU32,
    pub running: AtomicU32,
    pub most_at_once: AtomicU32,
}

impl FakeTrainer {
    fn new(pause_ms: u64, hangs_ms: Option<u64>, failures: u32) -> Arc<Self> {
        Arc::new(Self::with(pause_ms, hangs_ms, failures))
    }

    fn with(pause_ms: u64, hangs_ms: Option<u64>, failures: u32) -> Self {
        Self {
            pause: Duration::from_millis(pause_ms),
            hangs: hangs_ms.map(Duration::from_millis),
            hangs_only_in: None,
            failures_left: AtomicU32::new(failures),
            started: AtomicBool::new(false),
            calls: AtomicU32::new(0),
            running: AtomicU32::new(0),
            most_at_once: AtomicU32::new(0),
            unready: AtomicU32::new(0),
            too_small: false,
        }
    }

    pub fn quick() -> Arc<Self> {
        Self::new(0, None, 0)
    }

    /// Runs longer than a lease, so that it must be renewed.
    pub fn slow() -> Arc<Self> {
        Self::new(150, None, 0)
    }

    /// Hangs after its first checkpoint until it is asked to stop.
    pub fn hangs_after_checkpoint() -> Arc<Self> {
        Self::new(0, Some(10), 0)
    }

    /// The same, but only in tasks of one stage.
    pub fn hangs_in(stage: v1::Stage) -> Arc<Self> {
        Arc::new(Self { hangs_only_in: Some(stage), ..Self::with(0, Some(10), 0) })
    }

    /// The same, but it checks for a stop only twice a second, like training.
    pub fn hangs_and_looks_rarely() -> Arc<Self> {
        Self::new(0, Some(500), 0)
    }

    pub fn fails_once() -> Arc<Self> {
        Self::new(0, None, 1)
    }

    /// Not ready for a task until it was asked this many times.
    pub fn ready_after(times: u32) -> Arc<Self> {
        Arc::new(Self { unready: AtomicU32::new(times), ..Self::with(0, None, 0) })
    }

    /// Has no memory for any task.
    pub fn too_small() -> Arc<Self> {
        Arc::new(Self { too_small: true, ..Self::with(0, None, 0) })
    }

    fn train(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let total = task.common.own_iterations();
        assert!(total > 20, "{total} iterations are too few for these tests");
        let (mut iteration, mut state) = match (&task.checkpoint, &task.state) {
            (Some(path), _) => (task.checkpoint_iteration, read_state(path)),
            (None, Some(first)) => (0, read_state(first)),
            (None, None) => (0, *blake3::hash(&task.spec().encode_to_vec()).as_bytes()),
        };
        let hangs = self.hangs.filter(|_| self.hangs_only_in.is_none_or(|stage| stage == task.stage));
        let resumed_from = iteration;
        let mut submitted = false;
        while iteration < total {
            match control.stop_reason() {
                Some(Stop::Abandon) => return Err(TaskError::Stopped { checkpoint: None }),
                Some(Stop::Leave | Stop::GiveBack) => {
                    let checkpoint = Some((Bytes::copy_from_slice(&state), iteration));
                    return Err(TaskError::Stopped { checkpoint });
                }
                None => {}
            }
            if let (Some(pause), true) = (hangs, submitted) {
                std::thread::sleep(pause);
                continue;
            }
            for _ in 0..10.min(total - iteration) {
                iteration += 1;
                state = *blake3::keyed_hash(&state, &iteration.to_le_bytes()).as_bytes();
            }
            std::thread::sleep(self.pause);
            let progress =
                v1::Progress { iteration, iterations: total, gaussians: POINTS as u32, ..Default::default() };
            control.report(progress);
            if !submitted && iteration * 10 >= total && iteration < total {
                control.preview(iteration, vec![picture(task, &state)]);
                control.checkpoint(Bytes::copy_from_slice(&state), iteration);
                submitted = true;
            }
        }
        if task.stage == v1::Stage::FirstPart {
            let result = first_part_result(task, control.upload(Bytes::copy_from_slice(&state))?);
            return Ok(TaskOutput {
                result,
                gaussians: POINTS as u32,
                resumed_from,
                ..TaskOutput::default()
            });
        }
        if task.stage == v1::Stage::Borders {
            let result = with_other_rows_in_the_band(task, &state)?;
            return Ok(TaskOutput {
                result,
                gaussians: POINTS as u32,
                resumed_from,
                ..TaskOutput::default()
            });
        }
        let points = match task.input(Artifact::CoarseModel) {
            Some(model) => ply::read_model(model)?.means,
            None => Points::from_bytes(&std::fs::read(task.file(&task.manifest.points)?).unwrap())?.positions,
        };
        let n = points.len();
        let model = Gaussians {
            sh_degree: 0,
            means: points,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            log_scales: vec![[-2.0; 3]; n],
            opacity_logits: (0..n).map(|i| f32::from(state[i % 32]) / 64.0).collect(),
            sh_coeffs: vec![[0.1, 0.2, 0.3]; n],
        };
        Ok(TaskOutput {
            result: ply::to_bytes(&model, &comments(task))?.into(),
            gaussians: n as u32,
            resumed_from,
            held_out: Vec::new(),
            further: Vec::new(),
        })
    }

    fn evaluate(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let model = ply::read_model(task.input(Artifact::Model).unwrap())?;
        let Work::Evaluate(spec) = &task.work else { panic!("{:?} is no evaluation", task.work) };
        let mut views = Vec::new();
        for &index in &task.common.views {
            let name = task.manifest.views[index as usize].name.clone();
            let png = control.upload(Bytes::from(format!("the render of {name}")))?;
            let border = control.upload(Bytes::from(format!("the borders of {name}")))?;
            views.push(worker_v1::ViewMetrics {
                name,
                psnr_db: 20.0 + f64::from(index),
                ssim: 0.9,
                side_by_side: Some(to_proto(&png)),
                border: spec.seams.is_some().then(|| to_proto(&border)),
            });
        }
        let seams_json = spec.seams.as_ref().map_or_else(String::new, |lines| seams_of(lines, views.len()));
        let gaussians = model.len() as u32;
        let cover_json = cover_of(views.len());
        let adapter = "fake".into();
        let evaluation = worker_v1::Evaluation {
            format: 1,
            views,
            gaussians,
            adapter,
            seams_json,
            cover_json,
            ..Default::default()
        };
        Ok(TaskOutput {
            result: evaluation.encode_to_vec().into(),
            gaussians,
            resumed_from: 0,
            held_out: Vec::new(),
            further: Vec::new(),
        })
    }
}

/// Border measurements of the fake evaluation: a band with as many pixels as there are lines.
fn seams_of(lines: &worker_v1::SeamLines, views: usize) -> String {
    let band = |psnr: f64, lines: &[worker_v1::SeamLine]| json!({ "views": views, "psnr": psnr, "interior_psnr": 30.0, "pixels": lines.len() });
    let steps = json!({ "pairs": 0, "beside_pairs": 0 });
    let of_view = |index: usize| json!({ "border_pixels": index, "border_psnr": 20.0 + index as f64 });
    json!({
        "band": lines.band,
        "border": band(27.0, &lines.borders),
        "control": band(28.0, &lines.controls),
        "interior": { "pixels": 0 },
        "seam_db": 1.0,
        "range_step": { "border": steps, "control": steps },
        "views": (0..views).map(of_view).collect::<Vec<_>>(),
    })
    .to_string()
}

/// Cover measurements of the fake evaluation: the first view has no holes, each later one a tenth more.
fn cover_of(views: usize) -> String {
    let of_view = |index: usize| json!({ "holes": 0.1 * index as f64, "open_water": null, "unseen": 0.25 });
    let views: Vec<Value> = (0..views).map(of_view).collect();
    json!({ "holes": 0.15, "open_water": null, "unseen": 0.25, "views": views }).to_string()
}

/// The water of the fake coarse model.
pub fn coarse_water() -> WaterRecord {
    let acts = Composition::GaussiansSrgb;
    WaterRecord::new(&Water::COASTAL, acts, StandardErrors::from_array([1e-3; 9]), "descended", 0.0)
}

/// The water of a fake partition: the higher its number, the murkier the water and the stronger the evidence.
pub fn found_water(partition: u32) -> Water {
    let murkier = 1.0 + 0.1 * f64::from(partition + 1);
    Water { beta_d: Water::COASTAL.beta_d.map(|beta| murkier * beta), ..Water::COASTAL }
}

/// Evidence for `beta_d` alone.
fn first_part_result(task: &TaskInput, state: BlobRef) -> Bytes {
    let partition = task.partition().unwrap().index;
    let Water { beta_d, beta_b, b_inf } = found_water(partition);
    let weight = f64::from(partition + 1);
    let result = worker_v1::FirstPartResult {
        format: 1,
        partition,
        state: Some(to_proto(&state)),
        beta_d: beta_d.to_vec(),
        beta_b: beta_b.to_vec(),
        b_inf: b_inf.to_vec(),
        evidence: [[weight; 3], [0.0; 3], [0.0; 3]].concat(),
        unit: 1.0,
        rows: None,
    };
    result.encode_to_vec().into()
}

/// The merged model, whose Gaussians in the band have opacities that follow from `state`.
fn with_other_rows_in_the_band(task: &TaskInput, state: &[u8; 32]) -> Result<Bytes, TaskError> {
    let Work::Borders(spec) = &task.work else { panic!("{:?} trains no borders", task.work) };
    let mut model = std::fs::read(task.input(Artifact::Model).unwrap()).unwrap();
    let merged = ply::from_bytes(&model, "merged")?;
    // The scene's frame is the aligned one except for a rotation about y, which the plan's test covers.
    let is_near = |row: &usize| {
        spec.band.iter().any(|band| {
            let [w, x, y, z] = band.align_quat_wxyz[..] else { panic!("no quaternion") };
            let at = DQuat::from_xyzw(x, y, z, w) * DVec3::from(merged.means[*row].map(f64::from));
            at.x > band.min_x && at.x <= band.max_x && at.z > band.min_z && at.z <= band.max_z
        })
    };
    let rows: Vec<usize> = (0..merged.len()).filter(is_near).collect();
    let (mut band, _) = merged.split_where(|index| rows.contains(&index));
    for (index, logit) in band.opacity_logits.iter_mut().enumerate() {
        *logit = -1.0 - f32::from(state[index % 32]) / 64.0;
    }
    ply::replace_rows(&mut model, "merged", &rows, &band)?;
    Ok(model.into())
}

/// The header of a model: it has a water only if partitions train one, because the fake has none.
fn comments(task: &TaskInput) -> Vec<String> {
    let water = match (task.input(Artifact::Exchange), task.config.water.partitions) {
        (Some(path), _) => {
            Exchange::from_json(&std::fs::read(path).unwrap()).unwrap().water.expect("no consensus").water
        }
        (None, WaterPartitions::Joint) => coarse_water(),
        (None, WaterPartitions::Frozen) => return Vec::new(),
    };
    vec![water.to_comment().unwrap()]
}

/// A preview whose pictures are no others'.
fn picture(task: &TaskInput, state: &[u8; 32]) -> Picture {
    let bytes = |what: &[u8]| Bytes::from([what, state].concat());
    Picture {
        view: task.manifest.views[0].name.clone(),
        render: bytes(b"a render"),
        clear: Some(bytes(b"without the water")),
        psnr_db: Some(20.0),
    }
}

fn read_state(path: &Path) -> [u8; 32] {
    std::fs::read(path).unwrap().try_into().unwrap()
}

impl Executor for FakeTrainer {
    fn capabilities(&self) -> worker_v1::Capabilities {
        use v1::Stage::{Borders, Evaluate, FirstPart, Global, Partition};
        let stages = [Global, FirstPart, Partition, Borders, Evaluate].map(Into::into).to_vec();
        worker_v1::Capabilities { stages, adapter: "fake".into(), ..Default::default() }
    }

    fn prepare(&self) -> Result<(), TaskError> {
        match self.unready.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1)) {
            Ok(_) => Err(CoreError::NoAdapter("no virtual adapter".into()).into()),
            Err(_) => Ok(()),
        }
    }

    fn execute(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        self.started.store(true, Ordering::SeqCst);
        tracing::info!(target: "fathom_test", stage = ?task.stage, token = "t0p-secret", "a virtual trainer begins");
        assert_eq!(self.unready.load(Ordering::SeqCst), 0, "a worker that was not ready took a task");
        if self.too_small {
            let message = "the driver refused 1.0 GiB for all".to_owned();
            let (needed_bytes, available_bytes) = (Some(3 << 30), Some(2 << 30));
            return Err(CoreError::OutOfMemory { needed_bytes, available_bytes, message }.into());
        }
        let spend = |left: u32| left.checked_sub(1);
        if self.failures_left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, spend).is_ok() {
            let class = worker_v1::FailClass::Training;
            return Err(TaskError::Failed { class, message: "virtual fault".into() });
        }
        match task.stage {
            v1::Stage::Evaluate => self.evaluate(task, control),
            _ => {
                self.calls.fetch_add(1, Ordering::SeqCst);
                let running = self.running.fetch_add(1, Ordering::SeqCst) + 1;
                self.most_at_once.fetch_max(running, Ordering::SeqCst);
                let result = self.train(task, control);
                self.running.fetch_sub(1, Ordering::SeqCst);
                result
            }
        }
    }
}
