//! WaterParamPredict in a run (SMP-UWGS section 3.2). In the first part of a run, the water parameters are
//! the network's prediction from the ranges of a view (eq. 8). After that they are its mean prediction over
//! the training views.
//!
//! ```text
//! iteration     b-E ............... b ............... b+E ............... b+2E
//! device        |                   | view of b-1     | under the water     |
//!               |                   | is read back    | of that view:       |
//!               |                   |                 | gradients gathered  |
//! thread                            | predict -----> enters                 | learn
//! ```
//!
//! Every E = `water.network.every` iterations the host reads the ranges and alpha of the last view. It also
//! reads the sum of the gradients with respect to the unconstrained water parameters over the iterations
//! under the current water. While the device continues, a thread takes a learning step with the current
//! weights, for the view that the current water was predicted from. It then predicts for the new view. The
//! prediction takes effect E iterations later, no matter when it was ready. So the bytes of a run do not
//! depend on which of the two is faster. With E = 0 the prediction is made from the view of the iteration
//! itself, between blending and water, and the device waits.
//!
//! `in_run` holds the trainer's side.
//!
//! Invariant: the weights and the pending prediction are functions of the iterations done, and a checkpoint
//! contains both.

mod in_run;

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::MediumRun;
use crate::config::NetworkConfig;
use crate::nets::{DepthMap, RangeImage, WaterParamNet, WaterParamPredictor};
use crate::water::{Water, four_digits};
use crate::{CoreError, Result};

/// Number of joint standard errors beyond which network and sparse points disagree.
const DISAGREES: f64 = 3.0;
/// The water parameters, in the order of eq. 8.
const NAMES: [&str; 9] = [
    "beta_d red",
    "beta_d green",
    "beta_d blue",
    "beta_b red",
    "beta_b green",
    "beta_b blue",
    "b_inf red",
    "b_inf green",
    "b_inf blue",
];

/// The network of a run, and its state.
pub(super) struct Predictor {
    config: NetworkConfig,
    /// Scene scale, scene units: the unit of the unconstrained parameters.
    unit: f64,
    sparse: Option<([f64; 9], [f64; 9])>,
    /// First iteration whose water it does not determine.
    end: u32,
    network: Arc<Mutex<Box<dyn WaterParamPredictor>>>,
    /// The depth map that the current water was predicted from; `None` for the initial water.
    used: Option<DepthMap>,
    work: Work,
    left_out: LeftOut,
    /// Standard errors of the water parameters, once it has determined the water of the run.
    standard_error: Option<[f64; 9]>,
}

/// The work of the thread.
enum Work {
    None,
    Running(JoinHandle<Result<Prediction>>),
    Done(Prediction),
}

/// The network's prediction for a view; `raw` is `None` if it was not finite.
struct Prediction {
    depth: DepthMap,
    raw: Option<[f32; 9]>,
    /// Whether the learning step before it was skipped.
    left_out: bool,
}

/// Counts of results that were not finite.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct LeftOut {
    gradients: u32,
    predictions: u32,
}

/// Rendered ranges and alpha of a view, row-major.
struct Seen {
    size: [u32; 2],
    /// Blended ranges, scene units.
    ranges: Vec<f32>,
    alphas: Vec<f32>,
}

impl Seen {
    fn image(&self) -> RangeImage<'_> {
        let [width, height] = self.size;
        RangeImage { width, height, ranges: &self.ranges, alphas: &self.alphas }
    }
}

impl Predictor {
    /// The network of a new run, which determines the water up to iteration `end`; `None` if the run has no
    /// network.
    ///
    /// # Errors
    /// When the configuration of the network is invalid.
    pub fn new(run: &MediumRun, end: u32, seed: u32) -> Result<Option<Self>> {
        let Some(network) = run.network.filter(|_| run.is_free) else { return Ok(None) };
        let config = run.config.network.clone();
        // The same call as later, so that an invalid size is refused now.
        DepthMap::new(config.width, config.height, vec![0.0; (config.width * config.height) as usize])?;
        let net = WaterParamNet::new(config.channels, run.water.to_raw(run.unit), seed)?;
        Ok(Some(Self {
            config,
            unit: run.unit,
            sparse: network.sparse,
            end,
            network: Arc::new(Mutex::new(Box::new(net))),
            used: None,
            work: Work::None,
            left_out: LeftOut::default(),
            standard_error: None,
        }))
    }

    /// First iteration after `iteration` at whose start the network has work to do.
    pub fn next_due(&self, iteration: u32) -> u32 {
        if iteration >= self.end {
            return u32::MAX;
        }
        let every = self.config.every;
        let next = iteration.checked_div(every).map_or(self.end, |n| (n + 1).saturating_mul(every));
        next.min(self.end)
    }

    /// Whether the water of an iteration is predicted from the view that it renders.
    pub fn is_at_once(&self, iteration: u32) -> bool {
        self.config.every == 0 && iteration < self.end
    }

    /// Skipped learning steps.
    pub fn steps_left_out(&self) -> u32 {
        self.left_out.gradients
    }

    /// Waits for the prediction of the thread; `None` if none was started.
    fn take_prediction(&mut self) -> Result<Option<Prediction>> {
        let prediction = match std::mem::replace(&mut self.work, Work::None) {
            Work::None => return Ok(None),
            Work::Done(prediction) => prediction,
            Work::Running(thread) => {
                let prediction =
                    thread.join().map_err(|_| CoreError::Network("its thread panicked".into()))??;
                self.left_out.gradients += u32::from(prediction.left_out);
                self.left_out.predictions += u32::from(prediction.raw.is_none());
                prediction
            }
        };
        Ok(Some(prediction))
    }

    /// Starts a thread that first learns from `learned`: the depth map that the current water was predicted
    /// from, and the gradients under it. Then it predicts for `seen`.
    fn start(&mut self, learned: Option<(DepthMap, [f32; 9])>, seen: Seen) -> Result<()> {
        let (network, config, unit) = (Arc::clone(&self.network), self.config.clone(), self.unit as f32);
        // The thread gets a clone, so that the task remains if the system cannot start a thread.
        let task = Arc::new((learned, seen));
        let work = {
            let task = Arc::clone(&task);
            let network = Arc::clone(&network);
            let config = config.clone();
            move || learn_and_predict(&network, &config, unit, &task.0, &task.1)
        };
        self.work = match std::thread::Builder::new().name("water network".into()).spawn(work) {
            Ok(thread) => Work::Running(thread),
            Err(error) => {
                tracing::debug!(%error, "cannot start a thread for the network of the water; training waits for it");
                let prediction = learn_and_predict(&network, &config, unit, &task.0, &task.1)?;
                self.left_out.gradients += u32::from(prediction.left_out);
                self.left_out.predictions += u32::from(prediction.raw.is_none());
                Work::Done(prediction)
            }
        };
        Ok(())
    }

    /// Takes a learning step for `depth`. Returns the gradient with respect to its values if `wants_depth` is
    /// set and the step was taken.
    fn learn(&mut self, depth: &DepthMap, v_raw: [f32; 9], wants_depth: bool) -> Option<Vec<f32>> {
        let rate = self.config.learning_rate;
        match lock(&self.network).learn(depth, v_raw, rate, wants_depth) {
            Ok(learned) if learned.stepped => learned.v_depth,
            _ => {
                self.left_out.gradients += 1;
                None
            }
        }
    }

    /// Predicts for a view; counts predictions that are not finite.
    fn predict(&mut self, depth: &DepthMap) -> Option<[f32; 9]> {
        let prediction = lock(&self.network).predict(depth).ok();
        self.left_out.predictions += u32::from(prediction.is_none());
        prediction
    }

    fn depth_map(&self, seen: &Seen) -> Result<DepthMap> {
        DepthMap::from_render(&seen.image(), self.config.width, self.config.height, self.unit as f32)
    }

    /// Its state for a checkpoint; waits for the thread.
    ///
    /// Layout, little-endian:
    ///
    /// 1. counts of skipped steps and predictions, and whether it has determined the water
    /// 2. the standard errors
    /// 3. each after a flag: the depth map of the current water, and the depth map and values of the next
    ///    prediction
    /// 4. the network, if it has not yet determined the water
    ///
    /// # Errors
    /// When the thread panicked.
    pub fn save(&mut self) -> Result<Vec<u8>> {
        if let Some(prediction) = self.take_prediction()? {
            self.work = Work::Done(prediction);
        }
        let mut bytes = Vec::new();
        for word in
            [self.left_out.gradients, self.left_out.predictions, u32::from(self.standard_error.is_some())]
        {
            bytes.extend(word.to_le_bytes());
        }
        self.standard_error.unwrap_or_default().iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        let mut put = |values: Option<&[f32]>| {
            bytes.extend(u32::from(values.is_some()).to_le_bytes());
            values.unwrap_or_default().iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        };
        let next = match &self.work {
            Work::Done(prediction) => Some(prediction),
            _ => None,
        };
        put(self.used.as_ref().map(DepthMap::values));
        put(next.map(|prediction| prediction.depth.values()));
        put(next.and_then(|prediction| prediction.raw.as_ref()).map(<[f32; 9]>::as_slice));
        if self.standard_error.is_none() {
            bytes.extend(lock(&self.network).to_bytes());
        }
        Ok(bytes)
    }

    /// Restores the state from `save`.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when the bytes are torn or belong to another network.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<()> {
        let mut rest = bytes;
        let mut take = |count: usize| -> Result<&[u8]> {
            let (taken, after) = rest.split_at_checked(count).ok_or_else(torn)?;
            rest = after;
            Ok(taken)
        };
        let counts: Vec<u32> = words(take(12)?).map(u32::from_le_bytes).collect();
        let errors: Vec<f64> =
            take(72)?.as_chunks().0.iter().map(|eight| f64::from_le_bytes(*eight)).collect();
        let cells = (self.config.width * self.config.height) as usize;
        let mut array = |count: usize| -> Result<Option<Vec<f32>>> {
            if take(4)? == [0; 4] {
                return Ok(None);
            }
            Ok(Some(words(take(4 * count)?).map(f32::from_le_bytes).collect()))
        };
        let (used, next, raw) = (array(cells)?, array(cells)?, array(9)?);
        let map = |values| DepthMap::new(self.config.width, self.config.height, values);
        let (used, next) = (used.map(map).transpose()?, next.map(map).transpose()?);
        let &[gradients, predictions, has_decided] = counts.as_slice() else { return Err(torn()) };
        if has_decided == 0 {
            lock(&self.network).restore(rest)?;
        } else if !rest.is_empty() {
            return Err(torn());
        }
        self.left_out = LeftOut { gradients, predictions };
        self.standard_error = (has_decided != 0).then(|| std::array::from_fn(|i| errors[i]));
        self.used = used;
        self.work = match next {
            None => Work::None,
            Some(depth) => {
                let raw = raw.map(|raw| std::array::from_fn(|i| raw[i]));
                Work::Done(Prediction { depth, raw, left_out: false })
            }
        };
        Ok(())
    }

    /// Standard errors of the water parameters, once the network has determined the water.
    pub fn standard_error(&self) -> Option<[f64; 9]> {
        self.standard_error
    }

    /// Standard errors of the parameters of `water`: the spread over the views combined with the distance
    /// from the sparse points. Infinite where the sparse points cannot determine a parameter. The network
    /// sees only ranges and has learnt a single water for all of them. So agreement between views says little
    /// about how accurate it is.
    fn errors_of(&self, water: &Water, spread: [f64; 9]) -> [f64; 9] {
        let Some((sparse, errors)) = self.sparse else { return [f64::INFINITY; 9] };
        let values = water.to_array();
        std::array::from_fn(|i| {
            let is_known = errors[i].is_finite();
            if is_known { spread[i].hypot(values[i] - sparse[i]) } else { f64::INFINITY }
        })
    }

    /// Logs the final water, and how far each parameter agrees with the sparse points.
    fn report(&self, water: &Water, spread: &[f64; 9], views: usize) {
        let LeftOut { gradients, predictions } = self.left_out;
        if gradients + predictions > 0 {
            tracing::warn!(
                gradients,
                predictions,
                "skipped steps or predictions of the water network that were not finite; lower water.network.learning_rate"
            );
        }
        tracing::info!(
            views,
            water = ?water.in_short(),
            spread = ?spread.map(four_digits),
            "WaterParamPredict determined the water: mean and standard deviation over views"
        );
        let Some((sparse, errors)) = self.sparse else { return };
        for i in 0..9 {
            let (found, points) = (water.to_array()[i], sparse[i]);
            // A parameter that the points cannot determine contradicts nothing.
            let distance = joint_distance(found - points, spread[i], errors[i]);
            let name = NAMES[i];
            if distance > DISAGREES {
                tracing::warn!(name, found, points, distance, "network and sparse points disagree");
            } else {
                tracing::info!(name, found, points, distance, "network and sparse points agree");
            }
        }
    }
}

/// A difference of two values over their joint standard error; an unknown error is infinite.
fn joint_distance(difference: f64, one: f64, other: f64) -> f64 {
    let joint = one.hypot(other);
    if joint.is_finite() { difference.abs() / joint.max(1e-12) } else { 0.0 }
}

/// The work of a thread: a learning step with the gradient of an earlier prediction, then the prediction for
/// `seen`.
fn learn_and_predict(
    network: &Mutex<Box<dyn WaterParamPredictor>>,
    config: &NetworkConfig,
    unit: f32,
    learned: &Option<(DepthMap, [f32; 9])>,
    seen: &Seen,
) -> Result<Prediction> {
    let mut network = lock(network);
    let left_out = learned.as_ref().is_some_and(|(depth, v_raw)| {
        // If the network has diverged, the prediction below fails too.
        !network.learn(depth, *v_raw, config.learning_rate, false).is_ok_and(|learned| learned.stepped)
    });
    let depth = DepthMap::from_render(&seen.image(), config.width, config.height, unit)?;
    let raw = network.predict(&depth).ok();
    Ok(Prediction { depth, raw, left_out })
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn torn() -> CoreError {
    CoreError::Checkpoint("the part of the network of the water is torn".into())
}

fn words(bytes: &[u8]) -> impl Iterator<Item = [u8; 4]> {
    bytes.as_chunks().0.iter().copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Composition, WaterConfig};
    use crate::train::NetworkRun;

    fn predictor() -> Predictor {
        let config = WaterConfig {
            network: NetworkConfig { width: 16, height: 16, every: 4, ..NetworkConfig::default() },
            ..WaterConfig::default()
        };
        let network = Some(NetworkRun { sparse: Some(([0.1; 9], [f64::INFINITY; 9])) });
        let run = MediumRun { network, ..MediumRun::fixed(&config, Composition::PixelsLinear, 1.0) };
        match Predictor::new(&run, 10, 1) {
            Ok(Some(predictor)) => predictor,
            _ => panic!("no network"),
        }
    }

    #[test]
    fn predictions_are_due_at_every_interval_and_at_the_end() {
        let mut predictor = predictor();
        assert_eq!([0, 3, 4, 7, 8, 9, 10].map(|at| predictor.next_due(at)), [4, 4, 8, 8, 10, 10, u32::MAX]);
        assert!(!predictor.is_at_once(0));
        predictor.config.every = 0;
        assert_eq!([0, 9, 10].map(|at| predictor.next_due(at)), [10, 10, u32::MAX]);
        assert_eq!([0, 9, 10].map(|at| predictor.is_at_once(at)), [true, true, false]);
        predictor.config.every = u32::MAX;
        assert_eq!(predictor.next_due(9), 10);
    }

    #[test]
    fn the_state_survives_a_checkpoint_and_torn_bytes_are_refused() {
        let mut before = predictor();
        let seen = Seen { size: [32, 32], ranges: vec![1.5; 1024], alphas: vec![0.9; 1024] };
        let Ok(depth) = before.depth_map(&seen) else { panic!("a depth map") };
        assert_eq!(before.learn(&depth, [0.1; 9], true).map(|v| v.len()), Some(256));
        assert_eq!(before.learn(&depth, [f32::NAN; 9], false), None);
        before.used = Some(depth.clone());
        assert!(before.start(Some((depth, [f32::INFINITY; 9])), seen).is_ok());
        let Ok(bytes) = before.save() else { panic!("a state") };
        assert_eq!(before.left_out, LeftOut { gradients: 2, predictions: 0 });
        let mut after = predictor();
        assert!(after.restore(&bytes).is_ok());
        assert_eq!(after.save().ok(), Some(bytes.clone()));
        assert_eq!((after.left_out, &after.used), (before.left_out, &before.used));
        let entering = |predictor: &mut Predictor| {
            predictor.take_prediction().ok().flatten().and_then(|prediction| prediction.raw)
        };
        let raw = entering(&mut before);
        assert!(raw.is_some());
        assert_eq!(entering(&mut after), raw);
        for length in [0, 11, 12, 83, 84, 88, 1000, 3000, bytes.len() - 1] {
            let refused = predictor().restore(&bytes[..length]).err().map(|error| error.to_string());
            assert!(refused.is_some_and(|error| error.contains("torn")), "{length} of {} bytes", bytes.len());
        }
    }

    #[test]
    fn the_distance_from_known_sparse_points_widens_the_error() {
        let mut predictor = predictor();
        let water = Water::from_array([0.5; 9]);
        assert_eq!(
            predictor.errors_of(&water, [0.3; 9]),
            [f64::INFINITY; 9],
            "the sparse points are unknown"
        );
        predictor.sparse = Some(([0.1; 9], [0.01; 9]));
        assert!(predictor.errors_of(&water, [0.3; 9]).iter().all(|error| (error - 0.5).abs() < 1e-12));
        predictor.sparse = None;
        assert_eq!(predictor.errors_of(&water, [0.3; 9]), [f64::INFINITY; 9]);
    }

    #[test]
    fn parameters_disagree_by_joint_error_but_not_with_unknown_ones() {
        assert!((joint_distance(-1.0, 0.3, 0.4) - 2.0).abs() < 1e-12);
        assert_eq!(joint_distance(5.0, 0.1, f64::INFINITY), 0.0);
        assert!(joint_distance(1e-3, 0.0, 0.0) > DISAGREES);
    }
}
