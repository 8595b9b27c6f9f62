//! Measures the sort and the scan alone, recorded as in a frame.

use std::error::Error;

use fathom_core::gpu::{Gpu, Recorder, Scan, Size, Sort, counter};
use fathom_core::rng::{Stream, random_bits};

/// Bits of the keys, as many as a depth has.
pub const KEY_BITS: u32 = 30;
/// Buffers for one sort or scan of `n` entries; `check` verifies the last result.
pub struct Primitives<'g> {
    gpu: &'g Gpu,
    n: u32,
    input: Vec<u32>,
    counters: wgpu::Buffer,
    sort: Sort,
    scan: Scan,
}

/// The primitive to measure.
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
            Self::Sort => KEY_BITS.div_ceil(Sort::PASS_BITS) * 20,
            // One read for the sums of the chunks; one read and one write for the result.
            Self::Scan => 12,
        };
        u64::from(each) * u64::from(n)
    }
}

impl<'g> Primitives<'g> {
    pub fn new(gpu: &'g Gpu, n: u32) -> fathom_core::Result<Self> {
        let mut counts = [0_u32; counter::COUNT as usize];
        counts[counter::INTERSECTIONS as usize] = n;
        counts[counter::TILE_HISTOGRAM as usize] = Sort::histogram_entries(n);
        let counters = gpu.buffer("primitive", u64::from(counter::COUNT) * 4)?;
        gpu.write(&counters, 0, &counts);
        Ok(Self {
            gpu,
            n,
            input: (0..n).map(|i| random_bits(2, Stream::Test, i, 0)[0] >> (32 - KEY_BITS)).collect(),
            counters,
            sort: Sort::new(gpu, counter::INTERSECTIONS, counter::TILE_HISTOGRAM, n, KEY_BITS)?,
            scan: Scan::new(gpu, counter::INTERSECTIONS, n)?,
        })
    }

    /// Restores the input: random keys, small counts.
    pub fn refill(&self, primitive: Primitive) -> fathom_core::Result<()> {
        let ids: Vec<u32> = (0..self.n).collect();
        match primitive {
            Primitive::Sort => self.gpu.write(&self.sort.keys[0], 0, &self.input),
            Primitive::Scan => self.gpu.write(&self.sort.values[0], 0, &self.counts()),
        }
        if primitive == Primitive::Sort {
            self.gpu.write(&self.sort.values[0], 0, &ids);
        }
        self.gpu.wait()
    }

    fn counts(&self) -> Vec<u32> {
        self.input.iter().map(|key| key % 16).collect()
    }

    pub fn record(&self, recorder: &mut Recorder<'_>, primitive: Primitive) -> fathom_core::Result<()> {
        match primitive {
            Primitive::Sort => {
                let scan = Size::Groups(Scan::groups(Sort::histogram_entries(self.n)));
                let groups = [Size::Groups(Sort::groups(self.n)), scan];
                self.sort.record(recorder, &self.counters, KEY_BITS, groups)
            }
            Primitive::Scan => {
                let groups = Size::Groups(Scan::groups(self.n));
                self.scan.record(recorder, &self.counters, &self.sort.values[0], groups)
            }
        }
    }

    /// Fails if the result is wrong.
    pub fn check(&self, primitive: Primitive) -> Result<(), Box<dyn Error>> {
        let read = |buffer: &wgpu::Buffer| self.gpu.read::<u32>(buffer, 0, self.n as usize);
        let right = match primitive {
            Primitive::Sort => {
                let at = Sort::result(KEY_BITS);
                let (keys, values) = (read(&self.sort.keys[at])?, read(&self.sort.values[at])?);
                let key_of = |id: &u32| self.input.get(*id as usize);
                keys.is_sorted() && keys.iter().zip(&values).all(|(key, id)| key_of(id) == Some(key))
            }
            Primitive::Scan => {
                let mut sum = 0;
                self.counts().iter().zip(read(&self.sort.values[0])?).all(|(count, before)| {
                    let right = before == sum;
                    sum += count;
                    right
                })
            }
        };
        right.then_some(()).ok_or_else(|| format!("the {} of {} is wrong", primitive.name(), self.n).into())
    }
}
