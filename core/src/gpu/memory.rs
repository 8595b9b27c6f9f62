//! What is allocated on the device, what may be, and what happens when there is no more.
//!
//! The ledger is wgpu's own: its allocator knows every buffer from its creation until the last clone is
//! dropped and the device is done with it, staging buffers of writes included. So nothing needs to be told
//! when a buffer ends, and what is counted is what the driver was asked for. Metal's allocator does not
//! report: there nothing is counted.
//!
//! A buffer that is refused is tried again after everything that nobody holds any more has been given back,
//! and once more without what is there for speed alone ([`Spare`]).

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use super::Gpu;
use crate::error::Size;
use crate::memory::STAGED_BYTES;
use crate::{CoreError, Result};

/// Smaller writes do not count towards the peak and the limit: a look at the allocator takes some 15
/// microseconds.
const SMALLEST_COUNTED_WRITE: u64 = 1 << 20;

/// Memory of a device as wgpu's allocator has it, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceMemory {
    /// In buffers that live: made by [`Gpu`], staging of writes, and half a MiB of wgpu's own. Each size is
    /// what was asked for, rounded up to the driver's alignment.
    pub allocated_bytes: u64,
    /// Largest `allocated_bytes` since the device was opened or [`Gpu::reset_peak`]; looked at whenever
    /// something of size is allocated.
    pub peak_bytes: u64,
    /// In the driver's blocks from which buffers are cut, free parts included: what other programs see.
    pub reserved_bytes: u64,
    /// [`GpuOptions::memory_limit`](super::GpuOptions::memory_limit).
    pub limit_bytes: Option<u64>,
}

/// Buffers that are kept because they may be needed again, and can be made again.
pub trait Spare: Send + Sync {
    /// Drops them. Called from within an allocation, so no lock may be held around one that is taken here.
    fn drop_all(&self);
}

/// The part of the ledger that wgpu does not keep.
#[derive(Default)]
pub(super) struct Ledger {
    limit: Option<u64>,
    peak: AtomicU64,
    /// Bytes written since the device was last waited for.
    staged: AtomicU64,
    spares: Mutex<Vec<Weak<dyn Spare>>>,
}

impl Ledger {
    pub(super) fn new(limit: Option<u64>) -> Self {
        Self { limit, ..Self::default() }
    }

    /// Everything that was written is where it belongs.
    pub(super) fn nothing_is_staged(&self) {
        self.staged.store(0, Ordering::Relaxed);
    }
}

/// Who refused, where it was not the driver.
#[derive(Debug, thiserror::Error)]
#[error("beyond the limit that was set")]
struct BeyondLimit;

impl Gpu {
    /// What is allocated now; `None` where the backend does not say (Metal).
    pub fn memory(&self) -> Option<DeviceMemory> {
        // What the device is done with is given back in a poll. A loss shows in the next call that can return
        // it.
        let _ = self.poll(wgpu::PollType::Poll);
        let report = self.device.generate_allocator_report()?;
        let allocated_bytes = report.total_allocated_bytes;
        let before = self.ledger.peak.fetch_max(allocated_bytes, Ordering::Relaxed);
        Some(DeviceMemory {
            allocated_bytes,
            peak_bytes: before.max(allocated_bytes),
            reserved_bytes: report.total_reserved_bytes,
            limit_bytes: self.ledger.limit,
        })
    }

    /// [`DeviceMemory::allocated_bytes`] by the label of the buffers.
    pub fn memory_by_label(&self) -> Option<BTreeMap<String, u64>> {
        let mut bytes = BTreeMap::new();
        for allocation in self.device.generate_allocator_report()?.allocations {
            *bytes.entry(allocation.name).or_insert(0) += allocation.size;
        }
        Some(bytes)
    }

    /// Begins to look for the peak anew.
    pub fn reset_peak(&self) {
        self.ledger.peak.store(self.allocated().unwrap_or(0), Ordering::Relaxed);
    }

    /// Forgets what is kept for speed alone and waits, so that buffers that nobody else holds are given back.
    ///
    /// # Errors
    /// When the device failed.
    pub fn release_unused(&self) -> Result<()> {
        self.kernels().forget_bind_groups();
        self.wait()
    }

    /// Has `spare` dropped whenever memory is short, for as long as somebody holds it.
    pub fn give_way(&self, spare: &Arc<impl Spare + 'static>) {
        let spare: Weak<dyn Spare> = Arc::downgrade(&(Arc::clone(spare) as Arc<dyn Spare>));
        let mut spares = self.ledger.spares.lock().unwrap_or_else(PoisonError::into_inner);
        spares.retain(|known| known.strong_count() > 0);
        spares.push(spare);
    }

    fn release_spares(&self) -> Result<()> {
        let spares = self.ledger.spares.lock().unwrap_or_else(PoisonError::into_inner).clone();
        for spare in spares.iter().filter_map(Weak::upgrade) {
            spare.drop_all();
        }
        self.release_unused()
    }

    /// A buffer.
    ///
    /// # Errors
    /// [`CoreError::OutOfMemory`] when the device or the limit has no room for it.
    pub(super) fn allocate(&self, descriptor: &wgpu::BufferDescriptor<'_>) -> Result<wgpu::Buffer> {
        if let Ok(buffer) = self.try_allocate(descriptor) {
            return Ok(buffer);
        }
        self.release_unused()?;
        if let Ok(buffer) = self.try_allocate(descriptor) {
            return Ok(buffer);
        }
        self.release_spares()?;
        self.try_allocate(descriptor).map_err(|refusal| {
            let label = descriptor.label.unwrap_or("a buffer");
            self.out_of_memory(label, descriptor.size, &refusal)
        })
    }

    /// A buffer, or the refusal: the limit speaks as wgpu does for the driver.
    fn try_allocate(&self, descriptor: &wgpu::BufferDescriptor<'_>) -> Result<wgpu::Buffer, wgpu::Error> {
        if self.is_beyond_limit(descriptor.size) {
            return Err(wgpu::Error::OutOfMemory { source: Box::new(BeyondLimit) });
        }
        let (buffer, refusal) = self.create(descriptor);
        refusal.map_or(Ok(buffer), Err)
    }

    /// A buffer whatever the limit says; an invalid one where there is a refusal, whose use is an error but
    /// no panic.
    pub(super) fn create(
        &self,
        descriptor: &wgpu::BufferDescriptor<'_>,
    ) -> (wgpu::Buffer, Option<wgpu::Error>) {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = self.device.create_buffer(descriptor);
        let refusal = pollster::block_on(scope.pop());
        self.note_peak();
        (buffer, refusal)
    }

    /// Whether `bytes` may be written: waits for earlier writes where too many wait. Where the limit has no
    /// room for their staging buffer, [`Gpu::check`] will say so.
    pub(super) fn may_stage(&self, bytes: u64) -> bool {
        self.room_to_stage(bytes).map_err(|error| self.faults.report(error)).is_ok()
    }

    fn room_to_stage(&self, bytes: u64) -> Result<()> {
        let staged = self.ledger.staged.load(Ordering::Relaxed);
        if staged > 0 && staged + bytes > STAGED_BYTES {
            self.wait()?;
        }
        self.ledger.staged.fetch_add(bytes, Ordering::Relaxed);
        let counts = bytes >= SMALLEST_COUNTED_WRITE;
        if counts && self.is_beyond_limit(bytes) {
            self.release_unused()?;
            if self.is_beyond_limit(bytes) {
                self.release_spares()?;
            }
            if self.is_beyond_limit(bytes) {
                let refusal = wgpu::Error::OutOfMemory { source: Box::new(BeyondLimit) };
                return Err(self.out_of_memory("the staging buffer of a write", bytes, &refusal));
            }
        }
        Ok(())
    }

    /// Looks at the peak after a write of `bytes`.
    pub(super) fn staged(&self, bytes: u64) {
        if bytes >= SMALLEST_COUNTED_WRITE {
            self.note_peak();
        }
    }

    fn allocated(&self) -> Option<u64> {
        Some(self.device.generate_allocator_report()?.total_allocated_bytes)
    }

    fn note_peak(&self) {
        if let Some(allocated) = self.allocated() {
            self.ledger.peak.fetch_max(allocated, Ordering::Relaxed);
        }
    }

    fn is_beyond_limit(&self, bytes: u64) -> bool {
        let Some(limit) = self.ledger.limit else { return false };
        self.allocated().is_some_and(|allocated| allocated.saturating_add(bytes) > limit)
    }

    fn out_of_memory(&self, what: &str, bytes: u64, refusal: &wgpu::Error) -> CoreError {
        let allocated = self.allocated();
        tracing::debug!(labels = ?self.memory_by_label(), "what is allocated on the device");
        let source = std::error::Error::source(refusal);
        let by_limit = source.is_some_and(|source| source.is::<BeyondLimit>());
        let by = if by_limit { "the limit" } else { "the driver" };
        CoreError::OutOfMemory {
            needed_bytes: allocated.map(|allocated| allocated + bytes),
            available_bytes: if by_limit { self.ledger.limit } else { allocated },
            message: format!("{by} refused {} for {what}", Size(bytes)),
        }
    }
}
