//@ import frame, counters, film, film_unit
// One step of Adam on the weights of the view embeddings, and on the embedding of one view
// (film.wgsl; eq. 10).
//
//   means      [cells]    vec4: mean rgb, and 1 / the number of pixels
//   v_cells    [cells*2]  vec4: w.r.t. o, and a row that only film_backward reads
//   weights    [32*3]     vec4: rows 2 j and 2 j + 1 of unit j; first moments 32 rows later,
//                         second moments 64 rows later
//   embeddings [views*16] vec2: gamma_j, delta_j
//   moments    [views*32] vec2: first moments of an embedding, then its second moments
// A brighter model under darker embeddings gives the same images, so the loss does not determine the
// brightness of the model. Held-out views have no embedding. Therefore the mean embedding of the training
// views is kept at 0: the step of one view is subtracted, in equal parts, from all views, as in expose_step.
// A gradient that is not finite takes no step. One workgroup per hidden unit, whose parameters no other
// workgroup writes; every sum has a fixed order. After an overflow this and all later kernels do nothing.
// Twin: core/twins/src/film.rs

@group(0) @binding(0) var<uniform> film: Film;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> v_cells: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> weights: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> embeddings: array<vec2<f32>>;
@group(0) @binding(6) var<storage, read_write> moments: array<vec2<f32>>;

// The usual decay rates for the weights, which have a gradient in every iteration; smaller ones for the
// embedding of one view, as for exposures.
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const VIEW_BETA1: f32 = 0.8;
const VIEW_BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;
// Number of rows of the weights.
const ROWS: u32 = 32u;

var<workgroup> sh_first: array<vec4<f32>, 64>;
var<workgroup> sh_second: array<vec4<f32>, 64>;
var<workgroup> sh_view: array<vec2<f32>, 64>;
var<workgroup> sh_step: vec2<f32>;

fn all_finite(v: vec4<f32>) -> bool {
    return is_finite(v.x) && is_finite(v.y) && is_finite(v.z) && is_finite(v.w);
}

fn step_row(row: u32, v: vec4<f32>) {
    if !all_finite(v) {
        return;
    }
    let first = BETA1 * weights[ROWS + row] + (1.0 - BETA1) * v;
    let second = BETA2 * weights[2u * ROWS + row] + (1.0 - BETA2) * v * v;
    weights[ROWS + row] = first;
    weights[2u * ROWS + row] = second;
    weights[row] -= (film.rate * film.unbias1) * first / (sqrt(film.unbias2 * second) + EPSILON);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let j = group.x;
    let short = counters[OVERFLOW] != 0u;
    let second_layer = weights[2u * j + 1u].xyz;
    var by_first = vec4<f32>(0.0);
    var by_second = vec4<f32>(0.0);
    var by_view = vec2<f32>(0.0);
    let cells = veiled(film.cells.x * film.cells.y, arrayLength(&means));
    for (var cell = lane; cell < cells; cell += 64u) {
        let mean = means[cell].xyz;
        let v_o = v_cells[2u * cell].xyz;
        let unit = unit_of(j, mean);
        let v_added = dot(second_layer, v_o);
        let v_modulated = select(0.0, v_added, unit.modulated > 0.0);
        let v_plain = v_modulated * unit.gain - select(0.0, v_added, unit.plain > 0.0);
        by_first += v_plain * vec4<f32>(mean, 1.0);
        by_second += vec4<f32>(added(unit) * v_o, 0.0);
        by_view += v_modulated * vec2<f32>(unit.plain, 1.0);
    }
    sh_first[lane] = by_first;
    sh_second[lane] = by_second;
    sh_view[lane] = by_view;
    workgroupBarrier();
    if lane == 0u {
        by_first = vec4<f32>(0.0);
        by_second = vec4<f32>(0.0);
        by_view = vec2<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            by_first += sh_first[k];
            by_second += sh_second[k];
            by_view += sh_view[k];
        }
        var step = vec2<f32>(0.0);
        if !short {
            step_row(2u * j, by_first);
            step_row(2u * j + 1u, by_second);
            if is_finite(by_view.x) && is_finite(by_view.y) {
                let at = 2u * HIDDEN * film.view + j;
                let first = VIEW_BETA1 * moments[at] + (1.0 - VIEW_BETA1) * by_view;
                let second = VIEW_BETA2 * moments[at + HIDDEN] + (1.0 - VIEW_BETA2) * by_view * by_view;
                moments[at] = first;
                moments[at + HIDDEN] = second;
                step = (film.view_rate * film.view_unbias1) * first / (sqrt(film.view_unbias2 * second) + EPSILON);
            }
        }
        sh_step = step;
    }
    workgroupBarrier();
    let step = sh_step;
    let share = 1.0 / f32(film.views);
    let views = veiled(film.views, arrayLength(&embeddings) / HIDDEN);
    for (var view = lane; view < views; view += 64u) {
        let own = select(0.0, 1.0, view == film.view);
        // After an overflow the step is 0.
        embeddings[HIDDEN * view + j] += (share - own) * step;
    }
}
