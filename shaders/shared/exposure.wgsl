// The exposure of a training view: an affine map of colour, rows r, g, b of [A | b]. Mirror:
// core/src/gpu/layout.rs.

struct Exposure {
    // Pixels of the image.
    pixels: u32,
    // Index of the view, and number of views.
    view: u32,
    views: u32,
    pad0: u32,
    // Adam: rate, 1/(1-b1^t), 1/(1-b2^t); t counts the steps of this view, including this one.
    rate: f32,
    unbias1: f32,
    unbias2: f32,
    pad1: f32,
}

// Pixels that a workgroup of expose_backward sums.
const EXPOSE_CHUNK: u32 = 1024u;
