//! Device memory: what is allocated, the limit, and what happens when memory runs out.
//!
//! The ledger is that of wgpu. Its allocator knows every buffer, including the staging buffers of writes,
//! from its creation until its last clone is dropped and the device has finished with it. So nothing has to
//! report the end of a buffer, and the counts are what the driver was asked for. Metal's allocator has no
//! report: nothing is counted there.
//!
//! If an allocation is refused, it is retried after unused buffers have been released. The last attempt is
//! made after dropping everything that is kept only for speed ([`Spare`]).

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use super::Gpu;
use crate::error::Size;
use crate::memory::STAGED_BYTES;
use crate::{CoreError, Result};

/// Smaller writes count towards neither the peak nor the limit: a query of the allocator takes some 15
/// microseconds.
const SMALLEST_COUNTED_WRITE: u64 = 1 << 20;

/// Memory of a device according to wgpu's allocator, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceMemory {
    /// In live buffers: made by [`Gpu`], staging of writes, and half a MiB of wgpu's own. Each size is the
    /// requested one, rounded up to the driver's alignment.
    pub allocated_bytes: u64,
    /// Largest `allocated_bytes` since the device was opened or [`Gpu::reset_peak`], sampled at every large
    /// allocation.
    pub peak_bytes: u64,
    /// In the driver's blocks that buffers are allocated from, free parts included: what other programs see.
    pub reserved_bytes: u64,
    /// [`GpuOptions::memory_limit`](super::GpuOptions::memory_limit).
    pub limit_bytes: Option<u64>,
}

/// Buffers that are kept for reuse and can be recreated.
pub trait Spare: Send + Sync {
    /// Drops them. Called during an allocation, so callers must not hold a lock that this takes while they
    /// allocate.
    fn drop_all(&self);
}

/// The part of the ledger that wgpu does not keep.
#[derive(Default)]
pub(super) struct Ledger {
    limit: Option<u64>,
    peak: AtomicU64,
    /// Bytes written since the last wait for the device.
    staged: AtomicU64,
    spares: Mutex<Vec<Weak<dyn Spare>>>,
}

impl Ledger {
    pub(super) fn new(limit: Option<u64>) -> Self {
        Self { limit, ..Self::default() }
    }

    /// Records that all writes have reached the device.
    pub(super) fn nothing_is_staged(&self) {
        self.staged.store(0, Ordering::Relaxed);
    }
}

/// The refusal of an allocation by the limit, not by the driver.
#[derive(Debug, thiserror::Error)]
#[error("beyond the memory limit")]
struct BeyondLimit;

impl Gpu {
    /// Memory in use; `None` if the backend does not report it (Metal).
    pub fn memory(&self) -> Option<DeviceMemory> {
        // A poll releases what the device has finished with. The next call that can return an error reports a
        // loss.
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

    /// [`DeviceMemory::allocated_bytes`] by buffer label.
    pub fn memory_by_label(&self) -> Option<BTreeMap<String, u64>> {
        let mut bytes = BTreeMap::new();
        for allocation in self.device.generate_allocator_report()?.allocations {
            *bytes.entry(allocation.name).or_insert(0) += allocation.size;
        }
        Some(bytes)
    }

    /// Restarts the peak at the current allocation.
    pub fn reset_peak(&self) {
        self.ledger.peak.store(self.allocated().unwrap_or(0), Ordering::Relaxed);
    }

    /// Drops cached bind groups and waits, so that buffers without other owners are released.
    ///
    /// # Errors
    /// When the device failed.
    pub fn release_unused(&self) -> Result<()> {
        self.kernels().forget_bind_groups();
        self.wait()
    }

    /// Registers `spare` to be dropped when memory runs short, for as long as its owner keeps it.
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

    /// A buffer, or the refusal. The limit refuses with the same error as wgpu does for the driver.
    fn try_allocate(&self, descriptor: &wgpu::BufferDescriptor<'_>) -> Result<wgpu::Buffer, wgpu::Error> {
        if self.is_beyond_limit(descriptor.size) {
            return Err(wgpu::Error::OutOfMemory { source: Box::new(BeyondLimit) });
        }
        let (buffer, refusal) = self.create(descriptor);
        refusal.map_or(Ok(buffer), Err)
    }

    /// A buffer, ignoring the limit. After a refusal the buffer is invalid; using it is an error but does not
    /// panic.
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

    /// Whether `bytes` may be written; waits first if too many staged bytes are pending. If the limit has no
    /// room for the staging buffer, [`Gpu::check`] reports it.
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

    /// Updates the peak after a write of `bytes`.
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
        tracing::debug!(labels = ?self.memory_by_label(), "memory allocated on the device");
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
