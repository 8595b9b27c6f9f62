//! Seeded randomness for the simulation, and for the programs' requests to the system.
//!
//! Ids (`uuid`), the order of `HashMap`s and the choices of `tokio` all use the system's `getrandom`. On
//! Linux this package replaces libc's function: on a simulating thread it continues from the seed, on others
//! it reads the kernel's. On other systems seeds give the same faults, but ids and orders vary between runs.

use std::cell::RefCell;
#[cfg(target_os = "linux")]
use std::io::Read;
use std::time::Duration;

thread_local! {
    static OF_THREAD: RefCell<Option<Random>> = const { RefCell::new(None) };
}

/// Seeds all further random numbers of this thread. Call it first on a new thread: earlier numbers stay.
pub fn seed_thread(seed: u64) {
    OF_THREAD.with_borrow_mut(|random| *random = Some(Random::new(seed, "system")));
    fastrand::seed(seed);
}

/// SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// The generator of `whom` in the run of `seed`, independent of all others.
    pub fn new(seed: u64, whom: &str) -> Self {
        let digest = blake3::keyed_hash(blake3::hash(whom.as_bytes()).as_bytes(), &seed.to_le_bytes());
        let mut first = [0; 8];
        first.copy_from_slice(&digest.as_bytes()[..8]);
        Self(u64::from_le_bytes(first))
    }

    /// Any number.
    pub fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number from `least` to below `end`.
    pub fn within(&mut self, least: u64, end: u64) -> u64 {
        least + self.draw() % (end - least).max(1)
    }

    /// A time from `least` to below `end`, milliseconds.
    pub fn ms(&mut self, least: u64, end: u64) -> Duration {
        Duration::from_millis(self.within(least, end))
    }

    /// True with this probability, per thousand.
    pub fn permille(&mut self, share: u64) -> bool {
        self.within(0, 1000) < share
    }

    /// One of these.
    pub fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.within(0, choices.len() as u64) as usize]
    }
}

/// The system's random source, in place of libc's.
///
/// # Safety
/// As of getrandom(2): `buffer` has room for `length` bytes.
#[cfg(target_os = "linux")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn getrandom(
    buffer: *mut std::ffi::c_void,
    length: usize,
    _flags: std::ffi::c_uint,
) -> isize {
    // SAFETY: the caller promises the room. Bytes of any value are valid.
    let buffer = unsafe { std::slice::from_raw_parts_mut(buffer.cast::<u8>(), length) };
    let seeded = OF_THREAD.try_with(|random| match random.try_borrow_mut() {
        Ok(mut random) => random.as_mut().map(|random| buffer.fill_with(|| random.draw() as u8)),
        Err(_) => None,
    });
    if let Ok(Some(())) = seeded {
        return length.cast_signed();
    }
    // Not through libc, which this replaces; after boot the file gives the same.
    let read = std::fs::File::open("/dev/urandom").and_then(|mut file| file.read_exact(buffer));
    if read.is_ok() { length.cast_signed() } else { -1 }
}
