// What the threads of a tile find together: through workgroup memory, on any adapter. votes_vector.wgsl has
// the same functions for vector adapters.

var<workgroup> sh_votes: array<u32, LANES>;
var<workgroup> sh_union: atomic<u32>;

// Whether `yes` holds in any thread of the tile.
fn any_thread(lane: u32, yes: bool) -> bool {
    workgroupBarrier();
    sh_votes[lane] = select(0u, 1u, yes);
    workgroupBarrier();
    var votes = 0u;
    for (var i = 0u; i < LANES; i++) {
        votes += sh_votes[i];
    }
    return votes > 0u;
}

// The largest of the threads' numbers.
fn greatest(lane: u32, number: u32) -> u32 {
    workgroupBarrier();
    sh_votes[lane] = number;
    workgroupBarrier();
    var most = 0u;
    for (var i = 0u; i < LANES; i++) {
        most = max(most, sh_votes[i]);
    }
    return most;
}

// The bits that are set in any of the threads' words. Storage that threads have read before may be written
// after.
fn union_of(lane: u32, bits: u32) -> u32 {
    storageBarrier();
    if lane == 0u {
        atomicStore(&sh_union, 0u);
    }
    workgroupBarrier();
    atomicOr(&sh_union, bits);
    workgroupBarrier();
    return atomicLoad(&sh_union);
}

// Makes what other threads have written to storage visible.
fn before_reads() {
    storageBarrier();
}
