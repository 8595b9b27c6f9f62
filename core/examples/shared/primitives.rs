//! The sort and the scan alone, as a frame records them.

use std::error::Error;

use fathom_core::gpu::{Gpu, Recorder, Size, counter};
use fathom_core::rng::{Stream, random_bits};

/// Bits of the keys: as many as a depth has.
pub const KEY_BITS: u32 = 30;
/// Bits that a pass of the sort looks at, keys of a workgroup of it, digits; counts of a workgroup of the scan.
const PASS_BITS: u32 = 6;
const SORT_CHUNK: u32 = 2048;
const BINS: u32 = 64;
const SCAN_CHUNK: u32 = 1024;

/// Buffers for one sort or scan of `n` entries; `check` says whether what was last recorded did what it should.
pub struct Primitives<'g> {
    gpu: &'g Gpu,
    n: u32,
    input: Vec<u32>,
    counters: wgpu::Buffer,
    keys: [wgpu::Buffer; 2],
    values: [wgpu::Buffer; 2],
    histogram: wgpu::Buffer,
    sums: wgpu::Buffer,
    scan_of_histogram: wgpu::Buffer,
    scan_of_values: wgpu::Buffer,
    passes: Vec<wgpu::Buffer>,
}

/// What is measured alone.
#[derive(Clone, Copy, PartialEq)]
pub enum Primitive {
    /// Keys of [`KEY_BITS`] bits with a value each.
    Sort,
    /// An exclusive prefix sum.
    Scan,
}

impl Primitive {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sort => "sort",
            Self::Scan => "scan",
        }
    }

    /// Bytes of the lists of `n` entries that its passes read and write, without histograms and sums.
    pub fn bytes(self, n: u32) -> u64 {
        let each = match self {
            // Counting reads the keys; scattering reads and writes keys and values.
            Self::Sort => KEY_BITS.div_ceil(PASS_BITS) * 20,
            // One reading for the sums of the chunks; one and a writing for the result.
            Self::Scan => 12,
        };
        u64::from(each) * u64::from(n)
    }
}

impl<'g> Primitives<'g> {
    pub fn new(gpu: &'g Gpu, n: u32) -> fathom_core::Result<Self> {
        let words = |count: u32| gpu.buffer("primitive", u64::from(count) * 4);
        let bins = n.div_ceil(SORT_CHUNK) * BINS;
        let mut counts = [0_u32; counter::COUNT as usize];
        counts[counter::INTERSECTIONS as usize] = n;
        counts[counter::TILE_HISTOGRAM as usize] = bins;
        let counters = words(counter::COUNT)?;
        gpu.write(&counters, 0, &counts);
        let slot = |slot: u32, shift: u32| gpu.uniform("which", &[slot, shift, 0, 0]);
        Ok(Self {
            gpu,
            n,
            input: (0..n).map(|i| random_bits(2, Stream::Test, i, 0)[0] >> (32 - KEY_BITS)).collect(),
            counters,
            keys: [words(n)?, words(n)?],
            values: [words(n)?, words(n)?],
            histogram: words(bins)?,
            sums: words(n.max(bins).div_ceil(SCAN_CHUNK) + 1)?,
            scan_of_histogram: slot(counter::TILE_HISTOGRAM, 0),
            scan_of_values: slot(counter::INTERSECTIONS, 0),
            passes: (0..KEY_BITS.div_ceil(PASS_BITS))
                .map(|pass| slot(counter::INTERSECTIONS, PASS_BITS * pass))
                .collect(),
        })
    }

    /// Puts the input back: random keys, small counts.
    pub fn refill(&self, primitive: Primitive) -> fathom_core::Result<()> {
        let ids: Vec<u32> = (0..self.n).collect();
        match primitive {
            Primitive::Sort => self.gpu.write(&self.keys[0], 0, &self.input),
            Primitive::Scan => self.gpu.write(&self.values[0], 0, &self.counts()),
        }
        if primitive == Primitive::Sort {
            self.gpu.write(&self.values[0], 0, &ids);
        }
        self.gpu.wait()
    }

    fn counts(&self) -> Vec<u32> {
        self.input.iter().map(|key| key % 16).collect()
    }

    pub fn record(&self, recorder: &mut Recorder<'_>, primitive: Primitive) -> fathom_core::Result<()> {
        match primitive {
            Primitive::Sort => self.record_sort(recorder),
            Primitive::Scan => self.record_scan(recorder, &self.scan_of_values, &self.values[0], self.n),
        }
    }

    fn record_scan(
        &self,
        recorder: &mut Recorder<'_>,
        which: &wgpu::Buffer,
        values: &wgpu::Buffer,
        n: u32,
    ) -> fathom_core::Result<()> {
        let chunks = Size::Groups(n.div_ceil(SCAN_CHUNK));
        let (which, counters) = (("which", which), ("counters", &self.counters));
        let (values, sums) = (("values", values), ("sums", &self.sums));
        recorder.dispatch("scan_chunks", chunks, &[which, counters, values, sums])?;
        recorder.dispatch("scan_spine", Size::Groups(1), &[which, counters, sums])?;
        recorder.dispatch("scan_apply", chunks, &[which, counters, values, sums])
    }

    fn record_sort(&self, recorder: &mut Recorder<'_>) -> fathom_core::Result<()> {
        let chunks = Size::Groups(self.n.div_ceil(SORT_CHUNK));
        let bins = self.n.div_ceil(SORT_CHUNK) * BINS;
        let (counters, histogram) = (("counters", &self.counters), ("histogram", &self.histogram));
        for (pass, which) in self.passes.iter().enumerate() {
            let (which, from, to) = (("which", which), pass % 2, (pass + 1) % 2);
            recorder.dispatch(
                "sort_count",
                chunks,
                &[which, counters, ("keys", &self.keys[from]), histogram],
            )?;
            self.record_scan(recorder, &self.scan_of_histogram, &self.histogram, bins)?;
            recorder.dispatch(
                "sort_scatter",
                chunks,
                &[
                    which,
                    counters,
                    histogram,
                    ("keys_in", &self.keys[from]),
                    ("values_in", &self.values[from]),
                    ("keys_out", &self.keys[to]),
                    ("values_out", &self.values[to]),
                ],
            )?;
        }
        Ok(())
    }

    /// So that nothing is measured that does not do its work.
    pub fn check(&self, primitive: Primitive) -> Result<(), Box<dyn Error>> {
        let read = |buffer: &wgpu::Buffer| self.gpu.read::<u32>(buffer, 0, self.n as usize);
        let right = match primitive {
            Primitive::Sort => {
                let at = self.passes.len() % 2;
                let (keys, values) = (read(&self.keys[at])?, read(&self.values[at])?);
                let key_of = |id: &u32| self.input.get(*id as usize);
                keys.is_sorted() && keys.iter().zip(&values).all(|(key, id)| key_of(id) == Some(key))
            }
            Primitive::Scan => {
                let mut sum = 0;
                self.counts().iter().zip(read(&self.values[0])?).all(|(count, before)| {
                    let right = before == sum;
                    sum += count;
                    right
                })
            }
        };
        right.then_some(()).ok_or_else(|| format!("the {} of {} is wrong", primitive.name(), self.n).into())
    }
}
