// Counts that a frame computes on the device. Mirror: core/src/gpu/layout.rs, `counter`.

const GAUSSIANS: u32 = 0u;
const VISIBLE: u32 = 1u;
const INTERSECTIONS: u32 = 2u;
const DEPTH_HISTOGRAM: u32 = 3u;
const TILE_HISTOGRAM: u32 = 4u;
// Sticky: bit 0 visible, bit 1 intersections, bit 2 another frame of the same view (agree.wgsl). While set,
// every iteration does nothing.
const OVERFLOW: u32 = 5u;
const FAILED_AT: u32 = 6u;
const NEEDED_VISIBLE: u32 = 7u;
const NEEDED_INTERSECTIONS: u32 = 8u;

// Workgroups of the indirect dispatches: three u32 each, from `args[3 * slot]`.
const ARGS_VISIBLE: u32 = 0u;
const ARGS_VISIBLE_SCAN: u32 = 1u;
const ARGS_DEPTH_SORT: u32 = 2u;
const ARGS_DEPTH_SCAN: u32 = 3u;
const ARGS_TILE_SORT: u32 = 4u;
const ARGS_TILE_SCAN: u32 = 5u;
const ARGS_INTERSECT: u32 = 6u;
const ARGS_BLOCK: u32 = 8u;

// Items per workgroup of each kind.
const GROUP: u32 = 64u;
const SCAN_CHUNK: u32 = 1024u;
const SORT_CHUNK: u32 = 2048u;
const SORT_BINS: u32 = 64u;

fn groups_for(items: u32, per_group: u32) -> u32 {
    return (items + per_group - 1u) / per_group;
}
