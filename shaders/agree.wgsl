//@ import frame, counters, dispatch
// Makes three frames of one iteration agree: if the lists of one were too short, none of them takes a step,
// now or later (count_visible.wgsl).
//
// One thread.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> args: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters_b: array<u32>;
@group(0) @binding(4) var<storage, read_write> args_b: array<u32>;
@group(0) @binding(5) var<storage, read_write> counters_c: array<u32>;
@group(0) @binding(6) var<storage, read_write> args_c: array<u32>;

@compute @workgroup_size(1)
fn main() {
    let a = counters[OVERFLOW];
    let b = counters_b[OVERFLOW];
    let c = counters_c[OVERFLOW];
    if (a | b | c) == 0u {
        return;
    }
    if a == 0u {
        counters[OVERFLOW] = 4u;
        counters[FAILED_AT] = frame.iteration;
    }
    if b == 0u {
        counters_b[OVERFLOW] = 4u;
        counters_b[FAILED_AT] = frame.iteration;
    }
    if c == 0u {
        counters_c[OVERFLOW] = 4u;
        counters_c[FAILED_AT] = frame.iteration;
    }
    counters[VISIBLE] = 0u;
    counters_b[VISIBLE] = 0u;
    counters_c[VISIBLE] = 0u;
    // x, y and z of an indirect dispatch.
    for (var k = 3u * ARGS_BLOCK; k < arrayLength(&args); k++) {
        args[k] = 0u;
        args_b[k] = 0u;
        args_c[k] = 0u;
    }
}
