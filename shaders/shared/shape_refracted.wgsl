// A 2D Gaussian below the water surface: its disk in the camera's frame, and an ellipse on the image that
// holds it where the camera sees it. Needs frame, gaussian, projection, surface, sight_refracted, outline and
// the name frame.

//   disks [visible*3] vec4: as in shape_disk.wgsl, but the projected centre is where the centre appears
@group(0) @binding(10) var<storage, read_write> disks: array<vec4<f32>>;

struct Shape {
    mean2d: vec2<f32>,
    conic: vec3<f32>,
    // Of the path under water, scene units.
    range: f32,
    depth: f32,
    opacity: f32,
    mask: f32,
    is_sound: bool,
}

// Points of the outline of a disk that is not small.
const OUTLINE: u32 = 16u;
// For what lies between them.
const SLACK: f32 = 1.2;
// Share of the depth of the centre on the image at which a point counts as behind the camera.
const LEAST_AHEAD: f32 = 0.2;
// Share of the depth of the centre under water at which a point counts as at the surface.
const LEAST_WET: f32 = 1e-3;

// The end of the part under water of a line from `m`, which lies `depth` below the surface, to `m + out`.
fn wet_end(m: vec3<f32>, depth: f32, out: vec3<f32>) -> vec3<f32> {
    let rise = dot(level_of(frame, surface).normal, out);
    let least = (1.0 - LEAST_WET) * depth;
    return m + select(1.0, least / rise, rise > least) * out;
}

// Holds a disk of radius `reach` standard deviations around the crossing `c` of its centre. Its outline is
// not an ellipse. That of a small disk lies in the ellipse of its centre, somewhat widened. For others the
// ellipse grows until it holds points of the outline.
fn bent_bound(c: Crossing, m: vec3<f32>, centre2d: vec2<f32>, h_u: vec3<f32>, h_v: vec3<f32>, reach: f32) -> Bound {
    let q = c.at;
    let to_u = moved_crossing(c, h_u);
    let to_v = moved_crossing(c, h_v);
    let along_u = (frame.focal / q.z) * (to_u.xy - (to_u.z / q.z) * q.xy);
    let along_v = (frame.focal / q.z) * (to_v.xy - (to_v.z / q.z) * q.xy);
    let pad = LOW_PASS + 0.5 / reach;
    let cov = vec3<f32>(
        along_u.x * along_u.x + along_v.x * along_v.x + pad * pad,
        along_u.x * along_u.y + along_v.x * along_v.y,
        along_u.y * along_u.y + along_v.y * along_v.y + pad * pad,
    );
    let det = cov.x * cov.z - cov.y * cov.y;
    let size = max(length(h_u), length(h_v)) / (length(q) + length(m - q));
    var wide = wider(size);
    if size > SMALL {
        for (var k = 0u; k < OUTLINE; k++) {
            let turn = 6.2831853 * f32(k) / f32(OUTLINE);
            let seen = crossing_at(wet_end(m, c.depth, reach * (cos(turn) * h_u + sin(turn) * h_v))).at;
            if !(seen.z > LEAST_AHEAD * q.z) {
                return whole_image(frame, centre2d, reach);
            }
            let e = frame.focal * (seen.xy / seen.z - q.xy / q.z);
            let squared = (cov.z * e.x * e.x - 2.0 * cov.y * e.x * e.y + cov.x * e.y * e.y) / det;
            wide = max(wide, SLACK * sqrt(squared) / reach);
        }
    }
    return Bound(vec2<f32>(0.0), wide * wide * cov);
}

fn shape_of(i: u32, visible_id: u32, mean: vec3<f32>, opacity: f32, quat: vec4<f32>, log_scale: vec3<f32>) -> Shape {
    let rot = rotation(quat);
    let scales = exp(log_scale.xy);
    let m = to_camera(frame, mean);
    let u = turned(frame, rot[0]);
    let v = turned(frame, rot[1]);
    let a_u = u / scales.x;
    let a_v = v / scales.y;
    let c = crossing_at(m);
    let q = c.at;
    let under = length(m - q);
    let centre2d = frame.focal * q.xy / q.z + frame.principal;
    let reach = max(sqrt(2.0 * max(log(255.0 * opacity), 0.0)), 1e-3);
    let bound = bent_bound(c, m, centre2d, u * scales.x, v * scales.y, reach);
    let mean2d = centre2d + bound.offset;
    let det = bound.cov.x * bound.cov.z - bound.cov.y * bound.cov.y;
    let conic = vec3<f32>(bound.cov.z, -bound.cov.y, bound.cov.x) / det;
    let facing = dot(cross(u, v), m - q);
    let area = scales.x * scales.y;
    disks[3u * visible_id] = vec4<f32>(m, centre2d.x);
    disks[3u * visible_id + 1u] = vec4<f32>(a_u, centre2d.y);
    disks[3u * visible_id + 2u] = vec4<f32>(a_v, select(area, -area, facing > 0.0));
    let is_sound = c.depth > 0.0 && q.z > NEAR && det > 0.0 && is_finite(det) && is_finite(conic.x)
        && is_finite(conic.y) && is_finite(conic.z) && is_finite(mean2d.x) && is_finite(mean2d.y)
        && is_finite(1.0 / area) && is_finite(dot(a_u, a_u)) && is_finite(dot(a_v, a_v));
    // Sorted by the path under water, which is above NEAR for the key.
    return Shape(mean2d, conic, under, max(under, 1.001 * NEAR), opacity, sigmoid(log_scale.z), is_sound);
}
