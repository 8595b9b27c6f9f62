// The outline of a disk on the image. Needs frame and projection.
//
// The points m + r (cos h_u + sin h_v), with h = scale * axis, project to an ellipse as long as all of them
// lie in front of the camera. Its dual conic is H diag(r^2, r^2, -1) H^T with H = (h_u, h_v, m). A shear that
// moves m onto the optical axis keeps the image up to a shift and leaves no difference of large numbers.
// Twin: core/twins/src/disks.rs, `outline`

struct Bound {
    // From the projected centre, pixels.
    offset: vec2<f32>,
    // One standard deviation, pixel^2: xx, xy, yy. r of them are the outline.
    cov: vec3<f32>,
}

// Share of the squared depth that the nearest point of a disk must keep for its outline to be an ellipse of
// moderate size.
const LEAST_IN_FRONT: f32 = 0.01;
// Standard deviation of the low-pass of disks, pixels.
const LOW_PASS: f32 = sqrt(DISK_BLUR);

// Share of its distance that the scale of a disk may have for all of it to be bent nearly as its centre is.
const SMALL: f32 = 0.03;

// Factor on the ellipse of the centre that holds the outline of such a disk of `size` times its distance,
// which is that along the bent ray. Outlines of 3,500 random disks reached at most 0.97 of it.
fn wider(size: f32) -> f32 {
    return 1.0 + 6.0 * size;
}

// A direction in camera axes.
fn turned(frame: Frame, axis: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(dot(frame.view_x.xyz, axis), dot(frame.view_y.xyz, axis), dot(frame.view_z.xyz, axis));
}

// Square of the depth that is left to a disk of radius sqrt(squared) standard deviations.
fn depth_left(m: vec3<f32>, h_u: vec3<f32>, h_v: vec3<f32>, squared: f32) -> f32 {
    return m.z * m.z - squared * (h_u.z * h_u.z + h_v.z * h_v.z);
}

// `reach` standard deviations of it hold the image.
fn whole_image(frame: Frame, centre2d: vec2<f32>, reach: f32) -> Bound {
    let half = 0.5 * vec2<f32>(frame.size);
    let wide = (length(half) + 1.0) / reach;
    return Bound(half - centre2d, vec3<f32>(wide * wide, 0.0, wide * wide));
}

// Whether the disk of radius `reach` standard deviations lies behind the plane through the eye with the
// normal `n`. Slack for rounding.
fn is_behind(n: vec3<f32>, m: vec3<f32>, h_u: vec3<f32>, h_v: vec3<f32>, reach: f32) -> bool {
    return 1.001 * reach * length(vec2<f32>(dot(n, h_u), dot(n, h_v))) + 1e-5 * length(m) < -dot(n, m);
}

// Whether all of it lies beside the image.
fn is_beside(frame: Frame, m: vec3<f32>, h_u: vec3<f32>, h_v: vec3<f32>, reach: f32) -> bool {
    let least = -frame.principal / frame.focal;
    let most = least + vec2<f32>(frame.size) / frame.focal;
    return is_behind(vec3<f32>(1.0, 0.0, -least.x), m, h_u, h_v, reach)
        || is_behind(vec3<f32>(-1.0, 0.0, most.x), m, h_u, h_v, reach)
        || is_behind(vec3<f32>(0.0, 1.0, -least.y), m, h_u, h_v, reach)
        || is_behind(vec3<f32>(0.0, -1.0, most.y), m, h_u, h_v, reach);
}

// Holds the disk of radius sqrt(squared) standard deviations, and the circle of the low-pass. `centre2d` is
// its projected centre. The bound of a disk that reaches behind the camera is the whole image, or the circle
// if the disk lies beside the image.
fn bound_of(frame: Frame, m: vec3<f32>, centre2d: vec2<f32>, h_u: vec3<f32>, h_v: vec3<f32>, squared: f32) -> Bound {
    let left = depth_left(m, h_u, h_v, squared);
    let reach = max(sqrt(squared), 1e-3);
    if !(left > LEAST_IN_FRONT * m.z * m.z) {
        if is_beside(frame, m, h_u, h_v, reach) {
            return Bound(vec2<f32>(0.0), vec3<f32>(LOW_PASS * LOW_PASS, 0.0, LOW_PASS * LOW_PASS));
        }
        return whole_image(frame, centre2d, reach);
    }
    let inv_z = 1.0 / m.z;
    let p = frame.focal * (h_u.xy - (h_u.z * inv_z) * m.xy);
    let q = frame.focal * (h_v.xy - (h_v.z * inv_z) * m.xy);
    let offset = -(squared / left) * (p * h_u.z + q * h_v.z);
    let shift = offset / reach;
    let pad = LOW_PASS + length(offset) / reach;
    return Bound(offset, vec3<f32>(
        (p.x * p.x + q.x * q.x) / left + shift.x * shift.x + pad * pad,
        (p.x * p.y + q.x * q.y) / left + shift.x * shift.y,
        (p.y * p.y + q.y * q.y) / left + shift.y * shift.y + pad * pad,
    ));
}
