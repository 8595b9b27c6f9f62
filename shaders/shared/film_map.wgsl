// The factors of a view embedding at a pixel: bilinear between the centres of cells. Needs film and the names
// film, maps.

fn factor_at(x: u32, y: u32) -> vec3<f32> {
    let across = between(x, film.cells.x, film.size.x);
    let down = between(y, film.cells.y, film.size.y);
    let next = vec2<u32>(min(across.part + 1u, film.cells.x - 1u), min(down.part + 1u, film.cells.y - 1u));
    let above = film.cells.x * down.part;
    let below = film.cells.x * next.y;
    let a = maps[above + across.part].xyz;
    let b = maps[above + next.x].xyz;
    let c = maps[below + across.part].xyz;
    let d = maps[below + next.x].xyz;
    // Interpolated by differences, so that factors of 1 give exactly 1.
    let top = a + across.share * (b - a);
    let bottom = c + across.share * (d - c);
    return top + down.share * (bottom - top);
}
