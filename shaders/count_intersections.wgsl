//@ import frame, counters, dispatch
// After the scan of the counts: the number of intersections, and the sizes of the dispatches that follow. One
// thread. See count_visible for the sticky overflow bit.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> sums: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: array<u32>;
@group(0) @binding(3) var<storage, read_write> args: array<u32>;

@compute @workgroup_size(1)
fn main() {
    var needed = 0u;
    if counters[VISIBLE] > 0u {
        needed = sums[groups_for(counters[VISIBLE], SCAN_CHUNK)];
    }
    if counters[OVERFLOW] == 0u && needed > frame.intersect_capacity {
        counters[OVERFLOW] = 2u;
        counters[FAILED_AT] = frame.iteration;
        counters[NEEDED_INTERSECTIONS] = needed;
        // No work already recorded for this view may end in a step.
        counters[VISIBLE] = 0u;
        put(ARGS_VISIBLE, 0u);
        for (var b = 0u; b < veiled(frame.blocks, arrayLength(&args)); b++) {
            put(ARGS_BLOCK + b, 0u);
        }
    }
    let intersections = select(needed, 0u, counters[OVERFLOW] != 0u);
    counters[INTERSECTIONS] = intersections;
    let chunks = groups_for(intersections, SORT_CHUNK);
    counters[TILE_HISTOGRAM] = chunks * SORT_BINS;
    put(ARGS_INTERSECT, groups_for(intersections, GROUP));
    put(ARGS_TILE_SORT, chunks);
    put(ARGS_TILE_SCAN, groups_for(chunks * SORT_BINS, SCAN_CHUNK));
}
