//! Seeded mutations of a corpus.
//!
//! An input depends only on (target, seed, number). The first numbers are the corpus itself; every other is
//! one of its entries after one to eight changes. Changes know formats a little: numbers in text become edge
//! cases, and words of a binary become wrong counts.

use crate::Target;

/// Longest input, bytes, unless an entry of the corpus is longer.
const MOST_BYTES: usize = 8192;

/// Replacements for a number in text.
const NUMBERS: [&str; 22] = [
    "NaN",
    "nan",
    "-nan(ind)",
    "inf",
    "-Infinity",
    "null",
    "0",
    "-0",
    "-1",
    "1e308",
    "-1e308",
    "1e999",
    "1e-320",
    "1e13",
    "255",
    "256",
    "65536",
    "2147483648",
    "4294967295",
    "4294967296",
    "1000000000000",
    "18446744073709551616",
];

/// Replacements for counts, sizes and offsets.
const COUNTS: [u64; 16] = [
    0,
    1,
    2,
    127,
    128,
    255,
    256,
    65_535,
    65_536,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1_000_000_000_000,
    0x0fff_ffff_ffff_ffff,
    0x7fff_ffff_ffff_ffff,
    u64::MAX,
];

/// Replacements for poses, points and intrinsics.
const FLOATS: [f64; 12] = [
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    0.0,
    -0.0,
    -1.0,
    1e-320,
    1e-30,
    1e13,
    3.5e38,
    f64::MAX,
    f64::MIN,
];

/// Makes the inputs of a target.
pub struct Mutator<'a> {
    corpus: &'a [Vec<u8>],
    words: &'a [&'a str],
    mend: Option<fn(&mut [u8])>,
    name: &'a str,
    seed: u64,
}

impl<'a> Mutator<'a> {
    /// Creates the inputs of a target from one seed.
    ///
    /// # Panics
    /// When the target has no corpus.
    pub fn new(target: &'a Target<'_>, seed: u64) -> Self {
        assert!(!target.corpus.is_empty(), "{} has no corpus", target.name);
        Self { corpus: &target.corpus, words: target.words, mend: target.mend, name: target.name, seed }
    }

    /// The seed.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The input with a number.
    pub fn input(&self, number: u64) -> Vec<u8> {
        if let Some(entry) = self.corpus.get(number as usize) {
            return entry.clone();
        }
        let name = self
            .name
            .bytes()
            .fold(self.seed, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3));
        let mut random = Random(name ^ number.wrapping_mul(0xd134_2543_de82_ef95));
        let mut bytes = random.of(self.corpus).clone();
        let most = MOST_BYTES.max(bytes.len());
        // Half of the inputs have one change, a quarter two, and so on: with many changes, readers mostly
        // stop at the first.
        for _ in 0..=random.next().trailing_ones().min(7) {
            self.change(&mut bytes, &mut random);
            bytes.truncate(most);
        }
        if let Some(mend) = self.mend.filter(|_| random.below(4) > 0) {
            mend(&mut bytes);
        }
        bytes
    }

    fn change(&self, bytes: &mut Vec<u8>, random: &mut Random) {
        let at = random.below(bytes.len() + 1);
        match random.below(16) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 if at < bytes.len() => bytes[at] = *random.of(&[0, 1, 9, 10, 32, 34, 47, 92, 127, 128, 255]),
            2 => bytes.truncate(at),
            3 => {
                let more: Vec<u8> = (0..=random.below(8)).map(|_| random.next() as u8).collect();
                bytes.splice(at..at, more);
            }
            4 => drop(bytes.drain(random.span(bytes.len(), at))),
            5 => {
                let copy = bytes[random.span(bytes.len(), at)].to_vec();
                bytes.splice(at..at, copy);
            }
            6 => {
                // Depth and length: a thousand brackets, or a line repeated many times.
                let end = (at + 1 + random.below(40)).min(bytes.len());
                let again = bytes[at..end].repeat(1 << random.below(11));
                bytes.splice(at..at, again.into_iter().take(MOST_BYTES));
            }
            7 => {
                let other = random.of(self.corpus);
                let from = random.below(other.len() + 1);
                // Either at the same position, where such fields belong, or anywhere.
                let from = if random.below(2) == 0 { at.min(other.len()) } else { from };
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
            8 => {
                let (a, b) = (random.span(bytes.len(), at), random.below(bytes.len() + 1));
                let moved: Vec<u8> = bytes.drain(a).collect();
                let b = b.min(bytes.len());
                bytes.splice(b..b, moved);
            }
            9 | 10 => {
                let value = *random.of(&COUNTS);
                let word = match random.below(4) {
                    0 => (value as u16).to_le_bytes().to_vec(),
                    1 => (value as u32).to_le_bytes().to_vec(),
                    2 => (value as u32).to_be_bytes().to_vec(),
                    _ => value.to_le_bytes().to_vec(),
                };
                write_over(bytes, random, at, &word);
            }
            11 => {
                let value = *random.of(&FLOATS);
                let half = random.below(2) == 0;
                let word =
                    if half { (value as f32).to_le_bytes().to_vec() } else { value.to_le_bytes().to_vec() };
                write_over(bytes, random, at, &word);
            }
            12 if !self.words.is_empty() => {
                let word = random.of(self.words).bytes();
                bytes.splice(at..at, word);
            }
            _ => {
                let number = number_behind(bytes, at);
                let value = random.of(&NUMBERS).bytes();
                match number {
                    Some(span) => drop(bytes.splice(span, value)),
                    None => drop(bytes.splice(at..at, value)),
                }
            }
        }
    }
}

/// Overwrites bytes with `word`, half of the time at a multiple of four bytes.
fn write_over(bytes: &mut [u8], random: &mut Random, at: usize, word: &[u8]) {
    let at = if random.below(2) == 0 { at / 4 * 4 } else { at };
    for (to, from) in bytes.iter_mut().skip(at).zip(word) {
        *to = *from;
    }
}

/// The next number of a text from `at`, within a line or so.
fn number_behind(bytes: &[u8], at: usize) -> Option<std::ops::Range<usize>> {
    const NEAR: usize = 80;
    let is_part = |byte: &u8| byte.is_ascii_digit() || b"+-.eE".contains(byte);
    let start = at + bytes[at..].iter().take(NEAR).position(u8::is_ascii_digit)?;
    let start = start - bytes[..start].iter().rev().take_while(|byte| is_part(byte)).count();
    let length = bytes[start..].iter().take_while(|byte| is_part(byte)).count();
    Some(start..start + length)
}

/// SplitMix64 (Steele, Lea and Flood 2014).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Below `bound`; 0 for a bound of 0.
    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound.max(1) as u64) as usize
    }

    fn of<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        &all[self.below(all.len())]
    }

    /// A piece from `at` of any length, mostly short.
    fn span(&mut self, length: usize, at: usize) -> std::ops::Range<usize> {
        let most = if self.below(2) == 0 { 16 } else { length };
        at..(at + 1 + self.below(most)).min(length).max(at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn target<'a>(read: &'a dyn Fn(&[u8]) -> bool) -> Target<'a> {
        let corpus = vec![b"1 PINHOLE 640 480 500.5 -7e2".to_vec(), vec![0; 64]];
        Target { words: &["image"], ..Target::new("a target", corpus, read) }
    }

    #[test]
    fn a_number_gives_the_same_input_every_time_and_others_differ() {
        let read = |_: &[u8]| true;
        let target = target(&read);
        let (one, again, other) =
            (Mutator::new(&target, 1), Mutator::new(&target, 1), Mutator::new(&target, 2));
        let inputs = |mutator: &Mutator<'_>| (0..500).map(|n| mutator.input(n)).collect::<Vec<_>>();
        assert_eq!(inputs(&one), inputs(&again));
        assert_ne!(inputs(&one), inputs(&other));
        let mut distinct = inputs(&one);
        distinct.sort();
        distinct.dedup();
        assert!(distinct.len() > 400, "{} of 500 differ", distinct.len());
        assert!(distinct.iter().all(|input| input.len() <= MOST_BYTES));
    }

    #[test]
    fn numbers_in_text_become_edge_cases() {
        assert_eq!(number_behind(b"a -7e2 b", 0), Some(2..6));
        assert_eq!(number_behind(b"a -7e2 b", 4), Some(2..6));
        assert_eq!(number_behind(b"none", 0), None);
        let read = |_: &[u8]| true;
        let target = target(&read);
        let mutator = Mutator::new(&target, 1);
        for wanted in ["PINHOLE NaN", "1e308", "image", "18446744073709551616"] {
            let found = (0..20_000)
                .any(|n| mutator.input(n).windows(wanted.len()).any(|window| window == wanted.as_bytes()));
            assert!(found, "no input holds {wanted}");
        }
    }
}
