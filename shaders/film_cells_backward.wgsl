//@ import frame, film, film_unit
// Backpropagates through the view embedding to each cell (film.wgsl; eq. 10).
//
//   image   [H*W]      vec4: rgb of I_u, alpha
//   v_image [H*W]      vec4: w.r.t. I_d; 0 where a pixel does not count
//   means   [cells]    vec4: mean rgb, and 1 / the number of pixels
//   maps    [cells]    vec4: F
//   v_cells [cells*2]  vec4: w.r.t. o; and w.r.t. I_u of each pixel of the cell through its mean
// One workgroup per cell. It sums the pixels whose factors depend on the cell: up to the centres of its
// neighbours. A thread takes every 64th of them. The sums of the threads are added in their order, so runs
// are identical. Twin: core/twins/src/film.rs

@group(0) @binding(0) var<uniform> film: Film;
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> embeddings: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> v_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> maps: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> v_cells: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec3<f32>, 64>;
var<workgroup> sh_v: vec3<f32>;

// First pixel, and one past the last, whose factors may depend on part `i`.
fn reach(i: u32, count: u32, side: u32) -> vec2<u32> {
    let first = (2u * max(i, 1u) - 1u) * side / (2u * count);
    let end = min((2u * i + 3u) * side / (2u * count) + 1u, side);
    return vec2<u32>(select(first, 0u, i == 0u), select(end, side, i + 1u >= count));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let column = id % film.cells.x;
    let row = id / film.cells.x;
    // Groups that only fill up the last row of a folded dispatch have no cell.
    let is_cell = row < film.cells.y && id < arrayLength(&maps);
    let columns = reach(column, film.cells.x, film.size.x);
    let rows = reach(row, film.cells.y, film.size.y);
    let width = columns.y - columns.x;
    let pixels = select(0u, veiled(width * (rows.y - rows.x), arrayLength(&image)), is_cell);
    var sum = vec3<f32>(0.0);
    for (var k = lane; k < pixels; k += 64u) {
        let x = columns.x + k % width;
        let y = rows.x + k / width;
        let i = y * film.size.x + x;
        let share = share_of(between(x, film.cells.x, film.size.x), column)
            * share_of(between(y, film.cells.y, film.size.y), row);
        sum += share * image[i].rgb * v_image[i].rgb;
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    let cell = min(id, arrayLength(&maps) - 1u);
    if lane == 0u {
        var v_map = vec3<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            v_map += sh_sums[k];
        }
        let map = maps[cell].xyz;
        let bent = log(map) / BOUND;
        sh_v = v_map * map * (1.0 - bent * bent);
    }
    workgroupBarrier();
    let v_o = sh_v;
    let mean = means[cell];
    if lane < HIDDEN {
        let unit = unit_of(lane, mean.xyz);
        let v_added = dot(weights[2u * lane + 1u].xyz, v_o);
        let v_plain = v_added * (select(0.0, unit.gain, unit.modulated > 0.0) - select(0.0, 1.0, unit.plain > 0.0));
        sh_sums[lane] = v_plain * weights[2u * lane].xyz;
    }
    workgroupBarrier();
    if lane == 0u && is_cell {
        var v_mean = vec3<f32>(0.0);
        for (var j = 0u; j < HIDDEN; j++) {
            v_mean += sh_sums[j];
        }
        v_cells[2u * cell] = vec4<f32>(v_o, 0.0);
        v_cells[2u * cell + 1u] = vec4<f32>(mean.w * v_mean, 0.0);
    }
}
