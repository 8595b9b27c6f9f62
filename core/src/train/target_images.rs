//! Photographs on the device: packed, the most recently used ones kept, the next ones fetched while the
//! device works.
//!
//! The photograph of an iteration is a function of seed and iteration. So prefetching, its threads and its
//! timing change only the duration of a run.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::Result;
use crate::gpu::{DevicePhotograph, Gpu, Spare};
use crate::memory::RESIDENT_BYTES;
use crate::picture::half;
use crate::rng::{Stream, permutation, uniform_at};
use crate::views::{PackedImage, TrainView, ViewSource};

/// Number of photographs to fetch ahead.
const AHEAD: u32 = 8;

/// A view, and how often its photograph is halved in linear light.
pub(super) type Key = (usize, u32);

/// The photographs of a run.
pub(super) struct TargetImages {
    views: Arc<dyn ViewSource>,
    seed: u32,
    /// View orders of the most recently used epochs.
    orders: VecDeque<(u32, Vec<u32>)>,
    resident: Arc<Mutex<Resident>>,
    ahead: Option<Ahead>,
    /// Time that the run has waited for photographs.
    waited: Duration,
}

impl TargetImages {
    /// With 0 threads, nothing is fetched ahead.
    pub(super) fn new(views: Arc<dyn ViewSource>, seed: u32, threads: u32) -> Self {
        let ahead = Ahead::new(&views, threads);
        Self { views, seed, orders: VecDeque::new(), resident: Arc::default(), ahead, waited: Duration::ZERO }
    }

    /// Lets the photographs kept on a device be dropped when its memory runs short.
    pub(super) fn evictable_on(self, gpu: &Gpu) -> Self {
        gpu.give_way(&self.resident);
        self
    }

    pub(super) fn waited(&self) -> Duration {
        self.waited
    }

    pub(super) fn views(&self) -> &[TrainView] {
        self.views.views()
    }

    /// The view of an iteration. Every view appears once per epoch, in an order that depends on seed and
    /// epoch. If views have weights, each appears in proportion to its share of them, rounded up or down per
    /// epoch.
    pub(super) fn view_at(&mut self, iteration: u32) -> usize {
        let count = self.views().len();
        let (epoch, at) = ((iteration as usize / count) as u32, iteration as usize % count);
        if let Some((_, order)) = self.orders.iter().find(|(known, _)| *known == epoch) {
            return order[at] as usize;
        }
        let mut order = permutation(self.seed, Stream::ViewOrder, epoch, count);
        if let Some(weights) = self.views.weights() {
            let offset = uniform_at(self.seed, Stream::ViewSample, epoch, 0);
            let sample = systematic_sample(weights, f64::from(offset));
            order.iter_mut().for_each(|at| *at = sample[*at as usize]);
        }
        let view = order[at] as usize;
        self.orders.push_back((epoch, order));
        if self.orders.len() > 2 {
            self.orders.pop_front();
        }
        view
    }

    /// Number of iterations ahead for which [`TargetImages::expect`] is useful.
    pub(super) fn ahead(&self) -> u32 {
        if self.ahead.is_some() { AHEAD } else { 0 }
    }

    /// Announces that a photograph will be loaded soon.
    pub(super) fn expect(&mut self, key: Key) {
        if let Some(ahead) = &self.ahead
            && !lock(&self.resident).photographs.contains_key(&key)
        {
            ahead.expect(key);
        }
    }

    /// Loads a photograph onto the device.
    pub(super) fn load(&mut self, gpu: &Gpu, key: Key) -> Result<DevicePhotograph> {
        let resident = lock(&self.resident).take(key);
        if let Some(photograph) = resident {
            return Ok(photograph);
        }
        let begin = Instant::now();
        let fetched = self.ahead.as_ref().and_then(|ahead| ahead.wait(key));
        let image = fetched.unwrap_or_else(|| fetch(&*self.views, key));
        self.waited += begin.elapsed();
        let image = image?;
        let photograph = DevicePhotograph::new(gpu, &image)?.with_map(gpu, self.views.map(key.0))?;
        lock(&self.resident).insert(key, photograph.clone());
        Ok(photograph)
    }
}

/// Draws `weights.len()` indices by systematic sampling, ascending. Each appears the floor or the ceiling of
/// its expected number of times.
/// A comb of even spacing is laid over the cumulative weights, starting at `offset` (0 to 1) of one spacing.
/// Over all offsets, the mean count of each index equals its share. Equal weights give every index once.
fn systematic_sample(weights: &[f32], offset: f64) -> Vec<u32> {
    let spacing = weights.iter().map(|&weight| f64::from(weight)).sum::<f64>() / weights.len().max(1) as f64;
    let (mut index, mut reached) = (0, weights.first().map_or(0.0, |&first| f64::from(first)));
    let drawn = (0..weights.len()).map(|draw| {
        let at = (draw as f64 + offset) * spacing;
        while at >= reached && index + 1 < weights.len() {
            index += 1;
            reached += f64::from(weights[index]);
        }
        index as u32
    });
    drawn.collect()
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn fetch(views: &dyn ViewSource, (index, level): Key) -> Result<Arc<PackedImage>> {
    let mut image = views.load(index)?;
    for _ in 0..level {
        image = Arc::new(half(&image));
    }
    Ok(image)
}

/// The most recently used photographs.
#[derive(Default)]
struct Resident {
    photographs: HashMap<Key, DevicePhotograph>,
    /// In the order of their last use, the latest last.
    order: VecDeque<Key>,
    bytes: u64,
}

impl Resident {
    fn take(&mut self, key: Key) -> Option<DevicePhotograph> {
        let photograph = self.photographs.get(&key)?;
        self.order.retain(|known| *known != key);
        self.order.push_back(key);
        Some(photograph.clone())
    }

    fn insert(&mut self, key: Key, photograph: DevicePhotograph) {
        self.bytes += photograph.pixels.size();
        self.photographs.insert(key, photograph);
        self.order.push_back(key);
        while self.bytes > RESIDENT_BYTES && self.order.len() > 1 {
            let oldest = self.order.pop_front().and_then(|oldest| self.photographs.remove(&oldest));
            self.bytes -= oldest.map_or(0, |photograph| photograph.pixels.size());
        }
    }
}

impl Spare for Mutex<Resident> {
    fn drop_all(&self) {
        let dropped = std::mem::take(&mut *lock(self));
        tracing::debug!(bytes = dropped.bytes, "photographs on the device are dropped to free memory");
    }
}

/// Threads that read, decode and downscale photographs before they are needed.
struct Ahead {
    shared: Arc<SharedQueue>,
    threads: Vec<JoinHandle<()>>,
}

struct SharedQueue {
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Key>,
    /// The announced photographs; `None` until fetched.
    fetched: HashMap<Key, Option<Result<Arc<PackedImage>>>>,
    stopped: bool,
}

impl SharedQueue {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        lock(&self.queue)
    }

    fn wait<'a>(&self, queue: MutexGuard<'a, Queue>) -> MutexGuard<'a, Queue> {
        self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner)
    }
}

impl Ahead {
    /// Starts as many of the threads as the system allows; `None` if there are none.
    fn new(views: &Arc<dyn ViewSource>, threads: u32) -> Option<Self> {
        let shared = Arc::new(SharedQueue { queue: Mutex::default(), changed: Condvar::new() });
        let mut ahead = Self { shared, threads: Vec::new() };
        for _ in 0..threads {
            let (shared, views) = (Arc::clone(&ahead.shared), Arc::clone(views));
            let thread =
                std::thread::Builder::new().name("photographs".into()).spawn(move || work(&shared, &*views));
            match thread {
                Ok(thread) => ahead.threads.push(thread),
                Err(error) => {
                    tracing::warn!(%error, "cannot start another thread to prefetch photographs; training may wait for them");
                    break;
                }
            }
        }
        (!ahead.threads.is_empty()).then_some(ahead)
    }

    fn expect(&self, key: Key) {
        let mut queue = self.shared.lock();
        if queue.fetched.len() < AHEAD as usize && !queue.fetched.contains_key(&key) {
            queue.fetched.insert(key, None);
            queue.waiting.push_back(key);
            self.shared.changed.notify_all();
        }
    }

    /// Waits for an announced photograph; `None` if it was not announced or no thread has started on it.
    fn wait(&self, key: Key) -> Option<Result<Arc<PackedImage>>> {
        let mut queue = self.shared.lock();
        if queue.waiting.contains(&key) {
            queue.waiting.retain(|waiting| *waiting != key);
            queue.fetched.remove(&key);
            return None;
        }
        loop {
            match queue.fetched.get_mut(&key)? {
                Some(_) => return queue.fetched.remove(&key)?,
                None => queue = self.shared.wait(queue),
            }
        }
    }
}

impl Drop for Ahead {
    fn drop(&mut self) {
        self.shared.lock().stopped = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has no result.
            let _ = thread.join();
        }
    }
}

fn work(shared: &SharedQueue, views: &dyn ViewSource) {
    /// Removes the photograph of a thread that panics, so that no caller waits for it.
    struct Begun<'a>(&'a SharedQueue, Key);
    impl Drop for Begun<'_> {
        fn drop(&mut self) {
            let mut queue = self.0.lock();
            if let Some(None) = queue.fetched.get(&self.1) {
                queue.fetched.remove(&self.1);
            }
            self.0.changed.notify_all();
        }
    }
    let mut queue = shared.lock();
    while !queue.stopped {
        let Some(key) = queue.waiting.pop_front() else {
            queue = shared.wait(queue);
            continue;
        };
        drop(queue);
        let begun = Begun(shared, key);
        let image = fetch(views, key);
        if let Some(place) = shared.lock().fetched.get_mut(&key) {
            *place = Some(image);
        }
        drop(begun);
        queue = shared.lock();
    }
}

#[cfg(test)]
mod tests {

    use std::sync::atomic::{AtomicUsize, Ordering};

    use glam::DVec3;

    use super::*;
    use crate::CoreError;
    use crate::scene::{PinholeCamera, Pose};
    use crate::views::Weighted;

    /// Images of one pixel that holds their index; every seventh cannot be read.
    #[derive(Default)]
    struct Numbers {
        loads: AtomicUsize,
    }

    impl ViewSource for Numbers {
        fn views(&self) -> &[TrainView] {
            &[]
        }

        fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
            self.loads.fetch_add(1, Ordering::Relaxed);
            assert_ne!(index, 99, "as if a decoder panicked");
            if index % 7 == 3 {
                return Err(CoreError::Scene(format!("{index} is damaged")));
            }
            Ok(Arc::new(PackedImage { width: 1, height: 1, pixels: vec![index as u32] }))
        }
    }

    #[test]
    fn photographs_are_read_once_and_errors_stay_with_theirs() {
        for threads in [1, 2, 5] {
            let numbers = Arc::new(Numbers::default());
            let views: Arc<dyn ViewSource> = Arc::clone(&numbers) as Arc<dyn ViewSource>;
            let ahead = Ahead::new(&views, threads).unwrap();
            for index in 0..40_usize {
                (index..index + AHEAD as usize).for_each(|next| ahead.expect((next, 0)));
                let image = ahead.wait((index, 0)).unwrap_or_else(|| fetch(&*views, (index, 0)));
                match image {
                    Ok(image) => assert_eq!(image.pixels, [index as u32]),
                    Err(error) => assert_eq!(error.to_string(), format!("{index} is damaged")),
                }
            }
            drop(ahead);
            let loads = numbers.loads.load(Ordering::Relaxed);
            assert!((40..40 + AHEAD as usize).contains(&loads), "{loads} loads");
        }
    }

    #[test]
    fn a_thread_that_panics_blocks_no_caller() {
        let views: Arc<dyn ViewSource> = Arc::new(Numbers::default());
        let ahead = Ahead::new(&views, 1).unwrap();
        ahead.expect((99, 0));
        // Either the thread has started, or the request is withdrawn: both end without an image.
        assert!(ahead.wait((99, 0)).is_none());
        // The thread may be gone; then the caller reads the next photograph.
        ahead.expect((5, 0));
        assert!(ahead.wait((5, 0)).is_none_or(|image| image.is_ok()));
    }

    /// Views without pixels.
    struct Many(Vec<TrainView>);

    impl ViewSource for Many {
        fn views(&self) -> &[TrainView] {
            &self.0
        }

        fn load(&self, _: usize) -> Result<Arc<PackedImage>> {
            Err(CoreError::Scene("there are no pixels".into()))
        }
    }

    fn many(count: usize) -> Arc<dyn ViewSource> {
        let camera = PinholeCamera { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 };
        let pose = Pose::looking_at(-DVec3::Z, DVec3::ZERO, DVec3::Y);
        Arc::new(Many(vec![TrainView { name: String::new(), camera, pose, clear_range: 0.0 }; count]))
    }

    fn weighted(weights: &[f32]) -> TargetImages {
        let views = Weighted::new(many(weights.len()), weights.to_vec()).unwrap();
        TargetImages::new(Arc::new(views), 3, 0)
    }

    #[test]
    fn views_appear_in_proportion_to_their_weights() {
        let weights = [0.5, 1.0, 1.0, 2.0, 0.25, 0.3, 0.7];
        let mut truth = weighted(&weights);
        let (epochs, sum) = (400, weights.iter().sum::<f32>());
        let mut seen = [0_u32; 7];
        for epoch in 0..epochs {
            let mut now = [0_u32; 7];
            (0..7).for_each(|at| now[truth.view_at(epoch * 7 + at)] += 1);
            for (view, weight) in weights.iter().enumerate() {
                let share = 7.0 * weight / sum;
                let even = [share.floor() as u32, share.ceil() as u32];
                assert!(
                    even.contains(&now[view]),
                    "view {view} appeared {} times in epoch {epoch}",
                    now[view]
                );
                seen[view] += now[view];
            }
        }
        for (view, weight) in weights.iter().enumerate() {
            // Each epoch rounds up with the right probability: five standard deviations of the mean of a
            // coin.
            let (share, found) = (7.0 * weight / sum, seen[view] as f32 / epochs as f32);
            let tolerance = 5.0 * 0.5 / (epochs as f32).sqrt();
            assert!((found - share).abs() < tolerance, "view {view}: {found} per epoch, not {share}");
        }
        let [mut once, mut again] = [(); 2].map(|()| weighted(&weights));
        assert!(
            (0..70).all(|at| once.view_at(at) == again.view_at(at)),
            "the order differs between two runs"
        );
    }

    #[test]
    fn equal_weights_change_nothing() {
        for weight in [1.0, 0.3, 7e-5] {
            let mut alike = weighted(&[weight; 11]);
            let mut plain = TargetImages::new(many(11), 3, 0);
            assert!((0..220).all(|at| alike.view_at(at) == plain.view_at(at)), "weight {weight}");
        }
    }

    #[test]
    fn invalid_weights_are_refused() {
        for weights in [vec![1.0; 2], vec![1.0, 0.0, 1.0], vec![1.0, f32::NAN, 1.0]] {
            assert!(Weighted::new(many(3), weights.clone()).is_err(), "{weights:?}");
        }
    }

    #[test]
    fn every_view_appears_once_per_epoch() {
        let mut truth = TargetImages::new(many(10), 3, 0);
        let epoch = |truth: &mut TargetImages, first: u32| -> Vec<usize> {
            (first..first + 10).map(|iteration| truth.view_at(iteration)).collect()
        };
        let orders: Vec<Vec<usize>> = [0, 10, 20, 0].map(|first| epoch(&mut truth, first)).into();
        for order in &orders {
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..10));
        }
        assert_ne!(orders[0], orders[1]);
        assert_eq!(orders[0], orders[3], "the order does not depend on the epochs in between");
    }
}
