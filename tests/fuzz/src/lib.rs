//! Fuzzes every reader of foreign input; only tests use it.
//!
//! A [`Target`] is a function from bytes to whether they were accepted, with a corpus of valid inputs.
//! [`run`] passes it the corpus, then seeded mutations of it (`mutate.rs`). It panics when an input makes the
//! target panic, use excessive memory ([`Counting`] counts it), or run for seconds. It needs no fuzzer,
//! nightly compiler or sanitizer, and runs wherever the tests run. The same seed and number give the same
//! input, so two numbers replay a finding:
//!
//! | variable | meaning |
//! |---|---|
//! | `FATHOM_FUZZ_INPUTS` | inputs per target; by default, about a second's worth |
//! | `FATHOM_FUZZ_SEED` | seed; default 1 |
//! | `FATHOM_FUZZ_INPUT` | only the input of this number |
//! | `FATHOM_FUZZ_WRITE` | a file to write this input to |

mod allocations;
mod mutate;
mod watch;

use std::time::{Duration, Instant};

pub use allocations::Counting;
pub use mutate::Mutator;

/// Memory that a reader may use for any input, bytes: buffers, tables, a decoder's fixed state.
const FREE_BYTES: u64 = 8 << 20;
/// Memory that a reader may use per byte of input: text becomes trees of small allocations.
const BYTES_A_BYTE: u64 = 512;
/// Time limit for an input of a few KiB, even on a busy machine.
const TOO_LONG: Duration = Duration::from_secs(2);
/// Number of retries of a slow input: the machine may have been suspended.
const TRIES: u32 = 3;

/// A reader of foreign input.
pub struct Target<'a> {
    /// Its name in messages.
    pub name: &'a str,
    /// Small valid inputs.
    pub corpus: Vec<Vec<u8>>,
    /// Tokens to insert into an input: words of a text, values of a field.
    pub words: &'a [&'a str],
    /// Repairs checksums, which nearly every mutation breaks; applied to three of four inputs.
    pub mend: Option<fn(&mut [u8])>,
    /// Extra memory that it may use for any input, bytes; give a reason where it is set.
    pub extra_bytes: u64,
    /// Inputs of a short run.
    pub inputs: u64,
    /// Reads the bytes; returns whether they were accepted.
    pub read: &'a dyn Fn(&[u8]) -> bool,
}

impl<'a> Target<'a> {
    /// A target without words, checksums or extra memory; a short run has 2000 inputs.
    pub fn new(name: &'a str, corpus: Vec<Vec<u8>>, read: &'a dyn Fn(&[u8]) -> bool) -> Self {
        Self { name, corpus, words: &[], mend: None, extra_bytes: 0, inputs: 2000, read }
    }
}

/// Runs a target with the settings of the environment.
///
/// # Panics
/// With the number of the input and the replay command, when a target panics or uses too much memory or time.
/// Also when it refuses its own corpus, or accepts everything, which no reader may.
pub fn run(target: &Target<'_>) {
    let mutator = Mutator::new(target, variable("FATHOM_FUZZ_SEED").unwrap_or(1));
    if let Some(number) = variable("FATHOM_FUZZ_INPUT") {
        let input = mutator.input(number);
        if let Some(path) = std::env::var_os("FATHOM_FUZZ_WRITE")
            && let Err(error) = std::fs::write(&path, &input)
        {
            panic!("cannot write {}: {error}", path.display());
        }
        eprintln!("{}: input {number} is {:?}", target.name, input.escape_ascii().to_string());
        let taken = attempt(target, &mutator, number, &input).taken;
        watch::ended();
        eprintln!("{}: input {number} was {}", target.name, if taken { "taken" } else { "refused" });
        return;
    }
    let inputs = variable("FATHOM_FUZZ_INPUTS").unwrap_or(target.inputs).max(target.corpus.len() as u64);
    let (start, mut taken, mut most_bytes) = (Instant::now(), 0, 0);
    for number in 0..inputs {
        let input = mutator.input(number);
        let seen = attempt(target, &mutator, number, &input);
        assert!(
            seen.taken || number >= target.corpus.len() as u64,
            "{}: entry {number} of its own corpus is refused",
            target.name
        );
        taken += u64::from(seen.taken);
        most_bytes = most_bytes.max(seen.bytes);
    }
    watch::ended();
    assert!(taken < inputs || inputs < 1000, "{}: all of {inputs} inputs are taken", target.name);
    eprintln!(
        "| {} | {inputs} | {:.0} % | {:.1} | {:.1} |",
        target.name,
        100.0 * taken as f64 / inputs as f64,
        most_bytes as f64 / f64::from(1 << 20),
        start.elapsed().as_secs_f64()
    );
}

/// Outcome of one input.
struct Seen {
    taken: bool,
    bytes: u64,
}

fn attempt(target: &Target<'_>, mutator: &Mutator<'_>, number: u64, input: &[u8]) -> Seen {
    let allowed = FREE_BYTES + target.extra_bytes + BYTES_A_BYTE * input.len() as u64;
    let found = |what: String| -> ! {
        panic!(
            "{}: input {number} of seed {} ({} bytes) {what}; replay it with FATHOM_FUZZ_SEED={} \
             FATHOM_FUZZ_INPUT={number}, and FATHOM_FUZZ_WRITE=FILE keeps it",
            target.name,
            mutator.seed(),
            input.len(),
            mutator.seed()
        )
    };
    for retry in 1.. {
        let start = Instant::now();
        let (result, bytes) = watch::watched(target.name, mutator.seed(), number, || (target.read)(input));
        let taken = result.unwrap_or_else(|message| found(format!("panics: {message}")));
        if bytes > allowed {
            found(format!("takes {bytes} bytes of memory, where {allowed} are plenty"));
        }
        if start.elapsed() < TOO_LONG {
            return Seen { taken, bytes };
        }
        if retry == TRIES {
            found(format!("takes {:.1} s", start.elapsed().as_secs_f64()));
        }
    }
    Seen { taken: false, bytes: 0 }
}

/// A temporary folder, in memory if possible: file readers are given a million files.
#[derive(Debug)]
pub struct Folder(std::path::PathBuf);

impl Folder {
    /// A new one.
    ///
    /// # Panics
    /// When it cannot be created.
    pub fn new(name: &str) -> Self {
        let memory = std::path::Path::new("/dev/shm");
        let parent = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let path = parent.join(format!("fathom-fuzz-{}-{name}", std::process::id()));
        match std::fs::create_dir_all(&path) {
            Ok(()) => Self(path),
            Err(error) => panic!("cannot create {}: {error}", path.display()),
        }
    }

    /// Its path.
    pub fn path(&self) -> &std::path::Path {
        &self.0
    }

    /// Writes a file into it.
    ///
    /// # Panics
    /// When it cannot be written.
    pub fn put(&self, name: &str, bytes: &[u8]) -> std::path::PathBuf {
        let path = self.0.join(name);
        if let Err(error) =
            path.parent().map_or(Ok(()), std::fs::create_dir_all).and_then(|()| std::fs::write(&path, bytes))
        {
            panic!("cannot write {}: {error}", path.display());
        }
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Leftovers in memory end with the machine; a failing test must not fail twice.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn variable(name: &str) -> Option<u64> {
    let text = std::env::var(name).ok()?;
    match text.parse() {
        Ok(number) => Some(number),
        Err(_) => panic!("{name} is {text:?}; it must be a number"),
    }
}
