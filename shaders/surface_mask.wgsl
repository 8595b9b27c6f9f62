//@ import frame
// Adds the gradient of the mean squared difference between the blended mask and a pseudo-mask (WSGS, eq. 15).
//
//   normal_image [H*W] vec4: the blended mask is the last number
//   bits         pseudo-masks of all views, a bit for each cell, 1 for water; a view has `words` words
//   v_mask_image [H*W]
// One thread per pixel. Twin: core/twins/src/surface.rs

struct MaskLoss {
    // Cells of the pseudo-mask: columns, rows.
    cells: vec2<u32>,
    // First word of the view.
    first: u32,
    // Twice the weight, over the pixels.
    weight: f32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> mask_loss: MaskLoss;
@group(0) @binding(2) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> bits: array<u32>;
@group(0) @binding(4) var<storage, read_write> v_mask_image: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let columns = max(frame.size.x, 1u);
    let cell = vec2<u32>(i % columns, i / columns) * mask_loss.cells / max(frame.size, vec2<u32>(1u));
    let at = cell.y * mask_loss.cells.x + cell.x;
    let is_water = (bits[mask_loss.first + at / 32u] >> (at % 32u)) & 1u;
    v_mask_image[i] += mask_loss.weight * (normal_image[i].w - (1.0 - f32(is_water)));
}
