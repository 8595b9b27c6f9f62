// The part of a tile's list that the backward pass needs: Gaussians with a weight at any pixel of the tile,
// and those that end a ray. On a pool nearly half of a list are neither: they are hidden, or their bound is
// wider than they are. Needs votes, exchange and the name slots.
//
//   slots     those that are needed come first in the list of the tile, in order; the others follow
//   tile_ends [tiles]  their number

// Where the next one goes.
var<private> front: u32;

// Takes a batch that begins at `first`. `bits` has a bit for each Gaussian of it that this thread needs.
fn keep_needed(lane: u32, first: u32, last: u32, bits: u32) {
    let is_listed = lane < BATCH && first + lane < last;
    // Before `first`, all from `front` on are not needed. They make room.
    let room = first - front;
    before_reads();
    var slot = 0u;
    if is_listed {
        slot = slots[first + lane];
    }
    var moved = 0u;
    if lane < min(room, BATCH) {
        moved = slots[front + lane];
    }
    let needed = union_of(lane, bits);
    let count = countOneBits(needed);
    // Behind those that are needed.
    let rest = max(first, front + count);
    let making_room = min(count, room);
    if lane < making_room {
        slots[rest + lane] = moved;
    }
    if is_listed {
        let before = countOneBits(needed & ((1u << lane) - 1u));
        let is_needed = ((needed >> lane) & 1u) == 1u;
        slots[select(rest + making_room + lane - before, front + before, is_needed)] = slot;
    }
    front += count;
}
