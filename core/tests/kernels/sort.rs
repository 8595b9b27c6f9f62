//! The stable radix sort.

use fathom_core::gpu::{Gpu, Recorder, Size, counter};
use fathom_core::rng::{Stream, random_bits};

use crate::device::{layouts, poison, storage};

/// Sorts by the lower `bits` of the keys, six bits per pass, as a frame does.
fn sort(gpu: &Gpu, keys: &[u32], values: &[u32], bits: u32) -> (Vec<u32>, Vec<u32>) {
    let n = keys.len() as u32;
    let chunks = n.div_ceil(2048);
    let mut counts = [0_u32; counter::COUNT as usize];
    counts[counter::INTERSECTIONS as usize] = n;
    counts[counter::TILE_HISTOGRAM as usize] = chunks * 64;
    let counters = storage(gpu, &counts);
    let words = |count: u32| {
        let buffer = gpu.buffer("test", u64::from(count) * 4).unwrap();
        poison(gpu, &buffer);
        buffer
    };
    let (keys, values) = ([storage(gpu, keys), words(n)], [storage(gpu, values), words(n)]);
    let (histogram, sums) = (words(chunks * 64), words((chunks * 64).div_ceil(1024) + 1));
    let scan = gpu.uniform("which", &[counter::TILE_HISTOGRAM, 0, 0, 0]);
    let mut recorder = Recorder::new(gpu);
    let passes = bits.div_ceil(6) as usize;
    for pass in 0..passes {
        let (from, to) = (pass % 2, (pass + 1) % 2);
        let which = gpu.uniform("which", &[counter::INTERSECTIONS, 6 * pass as u32, 0, 0]);
        let (which, counters) = (("which", &which), ("counters", &counters));
        let hist = ("histogram", &histogram);
        let size = Size::Groups(chunks);
        recorder.dispatch("sort_count", size, &[which, counters, ("keys", &keys[from]), hist]).unwrap();
        let scan_size = Size::Groups((chunks * 64).div_ceil(1024));
        let scan = [("which", &scan), counters, ("values", &histogram), ("sums", &sums)];
        recorder.dispatch("scan_chunks", scan_size, &scan).unwrap();
        recorder.dispatch("scan_spine", Size::Groups(1), &[scan[0], scan[1], scan[3]]).unwrap();
        recorder.dispatch("scan_apply", scan_size, &scan).unwrap();
        let scatter = [
            which,
            counters,
            hist,
            ("keys", &keys[from]),
            ("values_in", &values[from]),
            ("keys_out", &keys[to]),
            ("values_out", &values[to]),
        ];
        recorder.dispatch("sort_scatter", size, &scatter).unwrap();
    }
    recorder.submit();
    let read = |buffer| gpu.read::<u32>(buffer, 0, n as usize).unwrap();
    (read(&keys[passes % 2]), read(&values[passes % 2]))
}

#[track_caller]
fn check(gpu: &Gpu, what: &str, keys: &[u32], bits: u32) {
    let values: Vec<u32> = (0..keys.len() as u32).map(|i| i ^ 0x5555_0000).collect();
    let (sorted, carried) = sort(gpu, keys, &values, bits);
    // `sort_by_key` is stable: equal keys keep the order of their values.
    let mut pairs: Vec<(u32, u32)> = keys.iter().copied().zip(values).collect();
    pairs.sort_by_key(|pair| pair.0);
    for (at, &(key, value)) in pairs.iter().enumerate() {
        let found = (sorted[at], carried[at]);
        assert_eq!(found, (key, value), "{what}, {} keys of {bits} bits, place {at}", keys.len());
    }
}

#[test]
fn a_sort_of_any_length_is_the_stable_sort() {
    for gpu in layouts() {
        // Sizes around the 64 keys of a thread, the 2048 of a workgroup, and the size where the histogram (32
        // keys per count) needs a second scan chunk.
        for n in [0, 1, 2, 63, 64, 65, 1023, 1024, 1025, 2047, 2048, 2049, 32_767, 32_768, 32_769, 200_001] {
            let keys: Vec<u32> = (0..n).map(|i| random_bits(2, Stream::Test, i, n)[0] >> 2).collect();
            check(&gpu, "random", &keys, 30);
        }
    }
}

#[test]
fn equal_keys_keep_their_order() {
    for gpu in layouts() {
        let n = 10_000;
        let few: Vec<u32> = (0..n).map(|i| random_bits(3, Stream::Test, i, 0)[1] % 5).collect();
        check(&gpu, "five different keys", &few, 3);
        check(&gpu, "one key", &vec![77; n as usize], 7);
        check(&gpu, "descending", &(0..n).rev().collect::<Vec<u32>>(), 14);
        check(&gpu, "ascending", &(0..n).collect::<Vec<u32>>(), 14);
        let random: Vec<u32> = (0..n).map(|i| random_bits(4, Stream::Test, i, 0)[0]).collect();
        check(&gpu, "all bits", &random, 32);
    }
}
