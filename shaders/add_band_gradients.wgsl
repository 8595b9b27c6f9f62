//@ import frame, counters, gaussian, rows, gather_slots, sums_of_bands
//@ variant add_band_gradients rows=splat+splat_rows sums_of_bands=splat_sums+keep_splat_sums
//@ variant add_disk_band_gradients rows=disk+disk_rows sums_of_bands=disk_sums+keep_disk_sums
// Adds the slot gradients of one band of tiles to the sums of the bands before it.
//
//   band_gradients [N*3]  vec4, as in splat.wgsl: per Gaussian of the block; [N*5] of disks, as in disk.wgsl
// Tiles are emitted in reading order and bands follow it, so the sum equals that of a single band to the bit.
// One thread per Gaussian of the block that the band sees.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(3) var<storage, read> counters: array<u32>;
@group(0) @binding(4) var<storage, read> flags: array<u32>;
@group(0) @binding(8) var<storage, read_write> band_gradients: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let visible_id = visible_of_thread(folded(group, groups) * 64u + lane);
    if visible_id == NONE {
        return;
    }
    let i = gaussian_from_visible[visible_id];
    keep_sum(i, add_slots(segments[visible_id], sum_of(i)));
}
