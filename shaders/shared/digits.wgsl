// How both stages of the sort visit the keys of a chunk: 32 threads with 64 consecutive keys each. Needs
// counters.wgsl and the names which, keys.

// [64 digits][32 threads]: how many keys of the digit a thread has.
var<workgroup> sh_digits: array<u32, 2048>;

fn digit_of(key: u32) -> u32 {
    return (key >> which.y) & (SORT_BINS - 1u);
}

// First key of a thread, and the end of its range.
fn keys_of_thread(chunk: u32, lane: u32, n: u32) -> vec2<u32> {
    let first = chunk * SORT_CHUNK + lane * 64u;
    return vec2<u32>(first, min(first + 64u, n));
}

fn count_digits(lane: u32, own: vec2<u32>) {
    for (var bin = 0u; bin < SORT_BINS; bin++) {
        sh_digits[bin * 32u + lane] = 0u;
    }
    for (var i = own.x; i < own.y; i++) {
        sh_digits[digit_of(keys[i]) * 32u + lane] += 1u;
    }
    workgroupBarrier();
}
