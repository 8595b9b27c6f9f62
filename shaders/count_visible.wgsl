//@ import frame, counters, dispatch
// After the scan of the flags: the number of visible Gaussians, and the sizes of the dispatches that follow.
//
// One thread. A list that would overflow sets the sticky bit. Then this and all later iterations do nothing
// until the host has grown the list and cleared the bit. So the steps do not depend on capacities.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> sums: array<u32>;
@group(0) @binding(2) var<storage, read> flags: array<u32>;
@group(0) @binding(3) var<storage, read> block_bases: array<u32>;
@group(0) @binding(4) var<storage, read_write> counters: array<u32>;
@group(0) @binding(5) var<storage, read_write> args: array<u32>;

@compute @workgroup_size(1)
fn main() {
    let needed = sums[groups_for(frame.gaussians, SCAN_CHUNK)];
    if counters[OVERFLOW] == 0u && needed > frame.visible_capacity {
        counters[OVERFLOW] = 1u;
        counters[FAILED_AT] = frame.iteration;
        counters[NEEDED_VISIBLE] = needed;
    }
    let visible = select(needed, 0u, counters[OVERFLOW] != 0u);
    counters[VISIBLE] = visible;
    let chunks = groups_for(visible, SORT_CHUNK);
    counters[DEPTH_HISTOGRAM] = chunks * SORT_BINS;
    put(ARGS_VISIBLE, groups_for(visible, GROUP));
    put(ARGS_VISIBLE_SCAN, groups_for(visible, SCAN_CHUNK));
    put(ARGS_DEPTH_SORT, chunks);
    put(ARGS_DEPTH_SCAN, groups_for(chunks * SORT_BINS, SCAN_CHUNK));
    // Visible Gaussians are numbered block by block. Blocks at the end may be empty: there are no flags after
    // the last Gaussian.
    for (var b = 0u; b < veiled(frame.blocks, arrayLength(&args)); b++) {
        var start = visible;
        if block_bases[b] < frame.gaussians {
            start = flags[block_bases[b]];
        }
        var end = visible;
        if b + 1u < frame.blocks && block_bases[b + 1u] < frame.gaussians {
            end = flags[block_bases[b + 1u]];
        }
        put(ARGS_BLOCK + b, select(groups_for(end - start, GROUP), 0u, visible == 0u));
    }
}
