// Input of project_backward when the whole image is one band: one thread per visible Gaussian. Needs
// gather_slots.

struct Gathered {
    // Index inside the block; NONE if there is nothing to do.
    i: u32,
    sum: Splat,
}

fn gather(thread: u32) -> Gathered {
    let visible_id = visible_of_thread(thread);
    if visible_id == NONE {
        return Gathered(NONE, NOTHING);
    }
    let segment = segments[visible_id];
    if segment.y == 0u {
        return Gathered(NONE, NOTHING);
    }
    return Gathered(gaussian_from_visible[visible_id], add_slots(segment, NOTHING));
}
