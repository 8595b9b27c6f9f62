// Eight neighbouring windows of a row or a column at once, each with `radius` pixels on either side of its
// centre. Every entry is loaded once for all windows. Needs priors.
//
// Entry k of a thread's run lies k - radius pixels from the first centre; `entries` gives their number.

// Windows per thread.
const WINDOWS: u32 = 8u;
const FIRST: vec4<u32> = vec4<u32>(0u, 1u, 2u, 3u);
const SECOND: vec4<u32> = vec4<u32>(4u, 5u, 6u, 7u);

fn entries(radius: u32) -> u32 {
    return 2u * radius + WINDOWS;
}

// Smallest entry of each window, and its position.
struct Least {
    first: vec4<f32>,
    second: vec4<f32>,
    first_at: vec4<u32>,
    second_at: vec4<u32>,
}

fn no_least() -> Least {
    return Least(vec4<f32>(NO_SIGNAL), vec4<f32>(NO_SIGNAL), vec4<u32>(NOWHERE), vec4<u32>(NOWHERE));
}

// `before` updated with entry k at position `at`. Of equal entries, the first stays.
fn with_entry(before: Least, radius: u32, k: u32, value: f32, at: u32) -> Least {
    var least = before;
    let last = vec4<u32>(2u * radius);
    let first = (vec4<u32>(k) >= FIRST) & (vec4<u32>(k) <= FIRST + last) & (vec4<f32>(value) < least.first);
    let second = (vec4<u32>(k) >= SECOND) & (vec4<u32>(k) <= SECOND + last) & (vec4<f32>(value) < least.second);
    least.first = select(least.first, vec4<f32>(value), first);
    least.first_at = select(least.first_at, vec4<u32>(at), first);
    least.second = select(least.second, vec4<f32>(value), second);
    least.second_at = select(least.second_at, vec4<u32>(at), second);
    return least;
}
