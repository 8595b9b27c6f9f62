//! Trains by hashing, in simulated time: the state after an iteration is the hash of the state before it and
//! its number. The result of a task therefore depends only on its input and every iteration. A wrong or
//! outdated checkpoint would change the model.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::ply;
use fathom_proto::v1::{Progress, Stage};
use fathom_proto::worker::v1::{Artifact, Capabilities, Evaluation, FailClass, ViewMetrics};
use fathom_worker::blobs::to_proto;
use fathom_worker::execute::{Control, Executor, Stop, TaskError, TaskInput, TaskOutput};
use futures::future::BoxFuture;
use prost::Message;

use crate::random::Random;
use crate::results::{self, State};
use crate::world::World;

/// Iterations between two checks for a stop.
const AT_ONCE: u32 = 8;

/// A trainer on one worker.
pub struct Trainer {
    world: Arc<World>,
    random: Mutex<Random>,
    /// Its GPU memory, bytes; 0: not reported.
    memory_bytes: u64,
}

impl Trainer {
    /// The trainer of one worker process.
    pub fn new(world: &Arc<World>, random: Random, memory_bytes: u64) -> Self {
        Self { world: Arc::clone(world), random: Mutex::new(random), memory_bytes }
    }

    fn draw<T>(&self, what: impl FnOnce(&mut Random) -> T) -> T {
        what(&mut self.random.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Fails sometimes while faults are active.
    fn fault(&self) -> Result<(), TaskError> {
        let said = |message: &str| message.to_owned();
        match self.draw(|random| random.within(0, 1000)) {
            _ if !self.world.has_faults() => Ok(()),
            0..6 => Err(TaskError::Failed { class: FailClass::Training, message: said("a simulated error") }),
            6..9 => Err(TaskError::Failed { class: FailClass::Device, message: said("a simulated loss") }),
            9..12 => {
                let (needed_bytes, available_bytes) = (Some(3 << 30), Some(2 << 30));
                let message = said("a simulated driver refused");
                Err(CoreError::OutOfMemory { needed_bytes, available_bytes, message }.into())
            }
            // Without the panic hook, which would print a trace.
            12..15 => std::panic::resume_unwind(Box::new("a simulated panic")),
            _ => Ok(()),
        }
    }

    async fn train(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let total = task.common.own_iterations();
        let (resumed_from, mut state) = match (&task.checkpoint, &task.state) {
            (Some(path), _) => (task.checkpoint_iteration, read_state(path)?),
            (None, Some(first_part)) => (0, read_state(first_part)?),
            (None, None) => (0, *blake3::hash(&task.spec().encode_to_vec()).as_bytes()),
        };
        let mut iteration = resumed_from;
        while iteration < total {
            match control.stop_reason() {
                Some(Stop::Abandon) => return Err(TaskError::Stopped { checkpoint: None }),
                Some(Stop::Leave | Stop::GiveBack) => {
                    let checkpoint = Some((Bytes::copy_from_slice(&state), iteration));
                    return Err(TaskError::Stopped { checkpoint });
                }
                None => {}
            }
            self.fault()?;
            for _ in 0..AT_ONCE.min(total - iteration) {
                iteration += 1;
                state = *blake3::keyed_hash(&state, &iteration.to_le_bytes()).as_bytes();
            }
            tokio::time::sleep(self.draw(|random| random.ms(100, 900))).await;
            control.report(Progress { iteration, iterations: total, gaussians: 1, ..Default::default() });
            if iteration < total && self.draw(|random| random.permille(300)) {
                control.checkpoint(Bytes::copy_from_slice(&state), iteration);
            }
        }
        if task.stage == Stage::FirstPart {
            let state = control.uploading(Bytes::copy_from_slice(&state)).await?;
            return Ok(output((results::first_part_result(task, &state), 1), resumed_from));
        }
        if task.stage == Stage::Borders {
            return Ok(output(results::with_borders(task, &state)?, resumed_from));
        }
        Ok(output(results::model(task, &state)?, resumed_from))
    }

    async fn evaluate(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let Some(merged) = task.input(Artifact::Model) else {
            let message = "an evaluation without a model".to_owned();
            return Err(TaskError::Failed { class: FailClass::Input, message });
        };
        let gaussians = ply::read_model(merged)?.len() as u32;
        let mut views = Vec::new();
        for &index in &task.common.views {
            if control.stop_reason().is_some() {
                return Err(TaskError::Stopped { checkpoint: None });
            }
            self.fault()?;
            tokio::time::sleep(self.draw(|random| random.ms(100, 900))).await;
            let name = task.manifest.views[index as usize].name.clone();
            let picture = control.uploading(Bytes::from(format!("the render of {name}"))).await?;
            let side_by_side = Some(to_proto(&picture));
            views.push(ViewMetrics { name, psnr_db: 20.0, ssim: 0.9, side_by_side, ..Default::default() });
        }
        let adapter = "simulated".into();
        let evaluation = Evaluation { format: 1, views, gaussians, adapter, ..Evaluation::default() };
        Ok(output((evaluation.encode_to_vec().into(), gaussians), 0))
    }
}

fn output((result, gaussians): (Bytes, u32), resumed_from: u32) -> TaskOutput {
    TaskOutput { result, gaussians, resumed_from, ..TaskOutput::default() }
}

/// A file of a task.
pub fn read(path: &Path) -> Result<Vec<u8>, TaskError> {
    let failed = |error: std::io::Error| TaskError::Failed {
        class: FailClass::Environment,
        message: format!("{}: {error}", path.display()),
    };
    std::fs::read(path).map_err(failed)
}

fn read_state(path: &Path) -> Result<State, TaskError> {
    read(path)?.try_into().map_err(|_| TaskError::Failed {
        class: FailClass::Input,
        message: format!("{}: no state of the simulated trainer", path.display()),
    })
}

impl Executor for Trainer {
    fn capabilities(&self) -> Capabilities {
        use Stage::{Borders, Evaluate, FirstPart, Global, Partition};
        let stages = [Global, FirstPart, Partition, Borders, Evaluate].map(Into::into).to_vec();
        let memory_bytes = self.memory_bytes;
        Capabilities { stages, adapter: "simulated".into(), memory_bytes, ..Default::default() }
    }

    fn execute(&self, _: &TaskInput, _: &dyn Control) -> Result<TaskOutput, TaskError> {
        unreachable!("threads are simulated")
    }

    fn simulate<'a>(
        &'a self,
        task: &'a TaskInput,
        control: &'a dyn Control,
    ) -> BoxFuture<'a, Result<TaskOutput, TaskError>> {
        Box::pin(async move {
            match task.stage {
                Stage::Evaluate => self.evaluate(task, control).await,
                _ => self.train(task, control).await,
            }
        })
    }
}
