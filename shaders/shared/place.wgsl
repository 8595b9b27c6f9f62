// Where a Gaussian may be seen on the image.

struct Place {
    // Pixels: the centre, and how far the Gaussian reaches from it.
    at: vec2<f32>,
    reach: vec2<f32>,
    // False where the view cannot see it.
    is_ahead: bool,
}
