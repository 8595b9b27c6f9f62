//@ import frame, film, film_unit
// The factors of the view embedding for each cell of an image, from the mean colour of the cell (film.wgsl;
// eq. 10).
//
//   image [H*W]    vec4: rgb, alpha; the mean includes masked pixels, because they are rendered like all
//                  others
//   means [cells]  vec4: mean rgb, and 1 / the number of pixels
//   maps  [cells]  vec4: factors on rgb, 0
// One workgroup per cell. A thread takes every 64th pixel. The sums of the threads are added in their order,
// so runs are identical. Twin: core/twins/src/film.rs

@group(0) @binding(0) var<uniform> film: Film;
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> embeddings: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> means: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> maps: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec3<f32>, 64>;
var<workgroup> sh_mean: vec3<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let column = id % film.cells.x;
    let row = id / film.cells.x;
    let left = part_begin(column, film.cells.x, film.size.x);
    let top = part_begin(row, film.cells.y, film.size.y);
    let width = part_begin(column + 1u, film.cells.x, film.size.x) - left;
    let height = part_begin(row + 1u, film.cells.y, film.size.y) - top;
    // Groups that only fill up the last row of a folded dispatch have no cell.
    let is_cell = row < film.cells.y && id < arrayLength(&maps);
    let pixels = select(0u, veiled(width * height, arrayLength(&image)), is_cell);
    var sum = vec3<f32>(0.0);
    for (var k = lane; k < pixels; k += 64u) {
        sum += image[(top + k / width) * film.size.x + left + k % width].rgb;
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u {
        var total = vec3<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[k];
        }
        sh_mean = total / f32(max(pixels, 1u));
    }
    workgroupBarrier();
    let mean = sh_mean;
    if lane < HIDDEN {
        sh_sums[lane] = added(unit_of(lane, mean)) * weights[2u * lane + 1u].xyz;
    }
    workgroupBarrier();
    if lane == 0u && is_cell {
        var o = vec3<f32>(0.0);
        for (var j = 0u; j < HIDDEN; j++) {
            o += sh_sums[j];
        }
        means[id] = vec4<f32>(mean, 1.0 / f32(max(pixels, 1u)));
        maps[id] = vec4<f32>(exp(BOUND * tanh(o / BOUND)), 0.0);
    }
}
