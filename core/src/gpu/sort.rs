//! Prefix sums and stable radix sorts of lists on the device. The length of a list is in a counter on the
//! device, so no count is read back to the host.

use super::layout::{SCAN_CHUNK, SORT_BINS, SORT_BITS, SORT_CHUNK};
use super::{Gpu, Recorder, Size};
use crate::Result;

/// An exclusive prefix sum in place.
pub struct Scan {
    which: wgpu::Buffer,
    sums: wgpu::Buffer,
}

impl Scan {
    /// For lists of at most `capacity` counts, whose length will be in counter `slot`.
    ///
    /// # Errors
    /// When the device cannot hold the sums.
    pub fn new(gpu: &Gpu, slot: u32, capacity: u32) -> Result<Self> {
        Ok(Self {
            which: gpu.uniform("scan", &[slot, 0, 0, 0]),
            sums: gpu.buffer("scan sums", (u64::from(Self::groups(capacity)) + 1) * 4)?,
        })
    }

    /// Workgroups for a list of `n` counts.
    pub fn groups(n: u32) -> u32 {
        n.div_ceil(SCAN_CHUNK)
    }

    /// Sums of the chunks. After a scan: the sum before each chunk, and the total after the last.
    pub fn sums(&self) -> &wgpu::Buffer {
        &self.sums
    }

    /// Records the prefix sum of `values`; `groups` as given by [`Scan::groups`].
    ///
    /// # Errors
    /// When a kernel does not compile.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        counters: &wgpu::Buffer,
        values: &wgpu::Buffer,
        groups: Size<'_>,
    ) -> Result<()> {
        let (which, counters) = (("which", &self.which), ("counters", counters));
        let (values, sums) = (("values", values), ("sums", &self.sums));
        recorder.dispatch("scan_chunks", groups, &[which, counters, values, sums])?;
        recorder.dispatch("scan_spine", Size::Groups(1), &[which, counters, sums])?;
        recorder.dispatch("scan_apply", groups, &[which, counters, values, sums])
    }
}

/// A stable sort of keys, each with a value.
pub struct Sort {
    /// The keys to sort go into the first; see [`Sort::result`].
    pub keys: [wgpu::Buffer; 2],
    /// Their values.
    pub values: [wgpu::Buffer; 2],
    histogram: wgpu::Buffer,
    passes: Vec<wgpu::Buffer>,
    scan: Scan,
}

impl Sort {
    /// Bits of the keys per pass.
    pub const PASS_BITS: u32 = SORT_BITS;

    /// For lists of at most `capacity` keys of at most `bits` bits. Counter `slot` will hold the number of
    /// keys, and counter `histogram_slot` the number of entries of the histogram
    /// ([`Sort::histogram_entries`]).
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn new(gpu: &Gpu, slot: u32, histogram_slot: u32, capacity: u32, bits: u32) -> Result<Self> {
        let words = |label, count: u32| gpu.buffer(label, u64::from(count) * 4);
        let entries = Self::histogram_entries(capacity);
        Ok(Self {
            keys: [words("sort keys", capacity)?, words("sort keys", capacity)?],
            values: [words("sort values", capacity)?, words("sort values", capacity)?],
            histogram: words("sort histogram", entries)?,
            passes: (0..bits.div_ceil(SORT_BITS))
                .map(|pass| gpu.uniform("sort pass", &[slot, pass * SORT_BITS, 0, 0]))
                .collect(),
            scan: Scan::new(gpu, histogram_slot, entries)?,
        })
    }

    /// Workgroups for `n` keys.
    pub fn groups(n: u32) -> u32 {
        n.div_ceil(SORT_CHUNK)
    }

    /// Entries of the histogram for `n` keys.
    pub fn histogram_entries(n: u32) -> u32 {
        Self::groups(n) * SORT_BINS
    }

    /// Which of the key and value buffers holds the result after a sort by `bits`.
    pub fn result(bits: u32) -> usize {
        (bits.div_ceil(SORT_BITS) % 2) as usize
    }

    /// Bytes of its lists.
    pub fn bytes(&self) -> u64 {
        self.scratch().map(wgpu::Buffer::size).sum::<u64>() - self.scan.sums.size()
    }

    /// All buffers that it writes.
    pub fn scratch(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        self.keys.iter().chain(&self.values).chain([&self.histogram, &self.scan.sums])
    }

    /// Records a sort by the lower `bits` of the keys. `groups` are for the keys and for the scan of the
    /// histogram, as given by [`Sort::groups`] and [`Scan::groups`].
    ///
    /// # Errors
    /// When a kernel does not compile.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        counters: &wgpu::Buffer,
        bits: u32,
        [groups, scan_groups]: [Size<'_>; 2],
    ) -> Result<()> {
        let histogram = ("histogram", &self.histogram);
        for (pass, which) in self.passes.iter().take(bits.div_ceil(SORT_BITS) as usize).enumerate() {
            let (from, to) = (pass % 2, (pass + 1) % 2);
            let common = [("which", which), ("counters", counters), histogram, ("keys", &self.keys[from])];
            recorder.dispatch("sort_count", groups, &common)?;
            self.scan.record(recorder, counters, &self.histogram, scan_groups)?;
            let moved = [
                ("values_in", &self.values[from]),
                ("keys_out", &self.keys[to]),
                ("values_out", &self.values[to]),
            ];
            recorder.dispatch("sort_scatter", groups, &[&common[..], &moved[..]].concat())?;
        }
        Ok(())
    }
}
