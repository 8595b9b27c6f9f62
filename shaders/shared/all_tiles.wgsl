// Whether a tile has a list: all do.

fn has_list(tile: u32) -> bool {
    return true;
}
