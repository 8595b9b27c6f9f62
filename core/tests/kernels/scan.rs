//! The prefix sum, and the fold of counts into two dimensions.

use fathom_core::gpu::{FrameUniform, Gpu, Recorder, Size, counter};
use fathom_core::rng::{Stream, random_bits};

use crate::device::{device, layouts, poison, storage};

/// Runs the three steps on `values`; returns the sum before each value, and the total.
fn scan(gpu: &Gpu, values: &[u32]) -> (Vec<u32>, u32) {
    let n = values.len() as u32;
    let chunks = n.div_ceil(1024);
    // Any counter works; a slot other than 0 shows that the slot is respected.
    let which = gpu.uniform("which", &[counter::VISIBLE, 0, 0, 0]);
    let mut counts = [0xDEAD_u32; counter::COUNT as usize];
    counts[counter::VISIBLE as usize] = n;
    let counters = storage(gpu, &counts);
    let buffer = storage(gpu, &[values, &[0xDEAD_BEEF][..]].concat());
    let sums = gpu.buffer("sums", u64::from(chunks + 1) * 4).unwrap();
    poison(gpu, &sums);
    let mut recorder = Recorder::new(gpu);
    let size = Size::Groups(chunks);
    let (which, counters) = (("which", &which), ("counters", &counters));
    let (values_at, sums_at) = (("values", &buffer), ("sums", &sums));
    recorder.dispatch("scan_chunks", size, &[which, counters, values_at, sums_at]).unwrap();
    recorder.dispatch("scan_spine", Size::Groups(1), &[which, counters, sums_at]).unwrap();
    recorder.dispatch("scan_apply", size, &[which, counters, values_at, sums_at]).unwrap();
    recorder.submit();
    let mut scanned: Vec<u32> = gpu.read(&buffer, 0, values.len() + 1).unwrap();
    assert_eq!(scanned.pop(), Some(0xDEAD_BEEF), "{n} values: the word behind the last must not be touched");
    let total = gpu.read::<u32>(&sums, u64::from(chunks) * 4, 1).unwrap()[0];
    (scanned, total)
}

#[test]
fn a_scan_of_any_length_is_the_running_sum() {
    for gpu in layouts() {
        // Sizes around the 16 values of a thread, the 1024 of a chunk, the 64 chunks of the spine, and a
        // spine of many rounds.
        for n in [0, 1, 15, 16, 17, 63, 1023, 1024, 1025, 65_535, 65_536, 65_537, 1_000_003] {
            let values: Vec<u32> = (0..n).map(|i| random_bits(1, Stream::Test, i, n)[0] % 1000).collect();
            let mut total = 0;
            let expected: Vec<u32> = values
                .iter()
                .map(|value| {
                    total += value;
                    total - value
                })
                .collect();
            let (scanned, sum) = scan(&gpu, &values);
            assert_eq!(sum, total, "total of {n} values");
            if let Some(at) = (0..expected.len()).find(|&i| scanned[i] != expected[i]) {
                panic!("{n} values, number {at}: {} is not {}", scanned[at], expected[at]);
            }
        }
    }
}

/// A sum that wraps looks small again, so lists that are much too short would be taken for long enough.
#[test]
fn totals_beyond_31_and_32_bits_never_look_small() {
    for gpu in layouts() {
        // The most that one Gaussian can have: each of 32,768 tiles.
        const TILES: u32 = 32_768;
        for (n, total) in [
            (65_535, 65_535 * u64::from(TILES)),
            (65_536, 1 << 31),
            (65_537, (1 << 31) + u64::from(TILES)),
            (131_071, (1 << 32) - u64::from(TILES)),
            (131_072, 1 << 32),
            (131_073, (1 << 32) + u64::from(TILES)),
            (300_000, 300_000 * u64::from(TILES)),
        ] {
            let (_, sum) = scan(&gpu, &vec![TILES; n]);
            assert_eq!(u64::from(sum), total.min(u32::MAX.into()), "{n} Gaussians in every tile");
        }
    }
}

#[test]
fn intersections_beyond_31_bits_are_an_overflow_and_no_work() {
    let Some(gpu) = device() else { return };
    for needed in [1000, 1001, 1 << 31, (1 << 31) + 1, u32::MAX - 1, u32::MAX] {
        let view =
            FrameUniform { intersect_capacity: 1000, gaussians: 1, blocks: 1, ..FrameUniform::default() };
        let frame = gpu.uniform("frame", &view);
        let sums = storage(&gpu, &[0, needed]);
        let mut counts = [0_u32; counter::COUNT as usize];
        counts[counter::VISIBLE as usize] = 1;
        let counters = storage(&gpu, &counts);
        let args = gpu.buffer("args", 3 * 4 * 16).unwrap();
        poison(&gpu, &args);
        let mut recorder = Recorder::new(&gpu);
        let buffers = [("frame", &frame), ("sums", &sums), ("counters", &counters), ("args", &args)];
        recorder.dispatch("count_intersections", Size::Groups(1), &buffers).unwrap();
        recorder.submit();
        let counts: Vec<u32> = gpu.read(&counters, 0, counter::COUNT as usize).unwrap();
        let at = |slot: u32| counts[slot as usize];
        let args: Vec<[u32; 3]> = gpu.read(&args, 0, 16).unwrap();
        let groups = |slot: u32| args[slot as usize].iter().map(|&n| u64::from(n)).product::<u64>();
        let slots = [counter::ARGS_INTERSECT, counter::ARGS_TILE_SORT, counter::ARGS_TILE_SCAN];
        if needed <= 1000 {
            assert_eq!((at(counter::INTERSECTIONS), at(counter::OVERFLOW)), (needed, 0));
            assert!(slots.map(groups).iter().all(|&groups| groups > 0));
        } else {
            assert_eq!((at(counter::INTERSECTIONS), at(counter::OVERFLOW)), (0, 2), "{needed} are needed");
            assert_eq!(at(counter::NEEDED_INTERSECTIONS), needed);
            assert_eq!(slots.map(groups), [0; 3], "{needed} are needed, and kernels still run");
        }
    }
}

/// Arguments (groups in x, y, z) that `count_visible` writes to `slot` for a total.
fn arguments(gpu: &Gpu, visible: u32, slot: u32) -> [u32; 3] {
    // With one Gaussian, the scan has one chunk, so the total is in sums[1].
    let view =
        FrameUniform { visible_capacity: u32::MAX, gaussians: 1, blocks: 1, ..FrameUniform::default() };
    let frame = gpu.uniform("frame", &view);
    let sums = storage(gpu, &[0, visible]);
    let zero = storage(gpu, &[0_u32; 4]);
    let counters = storage(gpu, &[0_u32; counter::COUNT as usize]);
    let args = gpu.buffer("args", 3 * 4 * 16).unwrap();
    poison(gpu, &args);
    let mut recorder = Recorder::new(gpu);
    let buffers = [
        ("frame", &frame),
        ("sums", &sums),
        ("flags", &zero),
        ("block_bases", &zero),
        ("counters", &counters),
        ("args", &args),
    ];
    recorder.dispatch("count_visible", Size::Groups(1), &buffers).unwrap();
    recorder.submit();
    let found = gpu.read::<[u32; 3]>(&args, u64::from(slot) * 12, 1).unwrap()[0];
    let block = gpu.read::<[u32; 3]>(&args, u64::from(counter::ARGS_BLOCK) * 12, 1).unwrap()[0];
    if slot == counter::ARGS_VISIBLE {
        assert_eq!(found, block, "the only block must hold every visible Gaussian");
    }
    found
}

#[test]
fn indirect_sizes_cover_every_count_within_dispatch_limits() {
    let Some(gpu) = device() else { return };
    let edge = 64 * 65_535;
    for visible in [0, 1, 64, 65, 64 * 32_768, 64 * 32_768 + 1, edge, edge + 1, 128 << 20] {
        for (slot, per_group) in [(counter::ARGS_VISIBLE, 64), (counter::ARGS_DEPTH_SORT, 2048)] {
            let [x, y, z] = arguments(&gpu, visible, slot);
            let needed = u64::from(visible.div_ceil(per_group));
            let groups = u64::from(x) * u64::from(y) * u64::from(z);
            assert!(x <= 65_535 && y <= 65_535, "{visible} visible: {x} x {y} groups");
            assert!(groups >= needed, "{visible} visible: {groups} groups for {needed}");
            // Less than one extra row of groups.
            assert!(groups < needed + 32_768, "{visible} visible: {groups} groups for {needed}");
            assert_eq!(groups == 0, visible == 0, "{visible} visible");
        }
    }
}

#[test]
fn a_dispatch_beyond_65535_groups_reaches_every_item() {
    let Some(gpu) = device() else { return };
    // 64 items per group make 78,126 groups, folded by the host and by the device.
    let n = 5_000_001_u32;
    let tile = |i: u32| i / 1_000_000;
    let keys: Vec<u32> = (0..n).map(tile).collect();
    let keys = storage(&gpu, &keys);
    let mut counts = [0_u32; counter::COUNT as usize];
    counts[counter::INTERSECTIONS as usize] = n;
    let counters = storage(&gpu, &counts);
    let args = storage(&gpu, &[32_768_u32, n.div_ceil(64).div_ceil(32_768), 1]);
    for size in [Size::Items(n, 64), Size::Indirect(&args, 0)] {
        let ranges = storage(&gpu, &[[0_u32; 2]; 7]);
        let mut recorder = Recorder::new(&gpu);
        let buffers = [("counters", &counters), ("tile_keys", &keys), ("ranges", &ranges)];
        recorder.dispatch("tile_ranges", size, &buffers).unwrap();
        recorder.submit();
        let ranges: Vec<[u32; 2]> = gpu.read(&ranges, 0, 7).unwrap();
        let expected: Vec<[u32; 2]> =
            (0..6).map(|t| [t * 1_000_000, ((t + 1) * 1_000_000).min(n)]).chain([[0, 0]]).collect();
        assert_eq!(ranges, expected);
    }
}
