// One view of one iteration: camera, sizes and capacities. Mirror: core/src/gpu/layout.rs, `Frame`.

struct Frame {
    // Rows of world to camera: rotation in xyz, translation in w; scene units, x right, y down, z forward.
    view_x: vec4<f32>,
    view_y: vec4<f32>,
    view_z: vec4<f32>,
    // Camera centre, world axes.
    eye: vec3<f32>,
    sh_degree: u32,
    // Focal lengths and principal point, pixels; pixel centres at +0.5.
    focal: vec2<f32>,
    principal: vec2<f32>,
    // Bounds of x/z and y/z inside the Jacobian (as in gsplat): the image plus 15 % of its size on each side.
    ratio_min: vec2<f32>,
    ratio_max: vec2<f32>,
    background: vec3<f32>,
    iteration: u32,
    // Pixels and tiles.
    size: vec2<u32>,
    tiles: vec2<u32>,
    // Capacities of the per-visible and per-intersection lists.
    visible_capacity: u32,
    intersect_capacity: u32,
    // Gaussians in all blocks, and number of blocks.
    gaussians: u32,
    blocks: u32,
    // The band of tiles that is processed, in reading order, and its rectangle in pixels; otherwise the whole
    // image.
    rect_min: vec2<f32>,
    rect_max: vec2<f32>,
    first_tile: u32,
    end_tile: u32,
    // 1 with the filters of Mip-Splatting (projection.wgsl, gaussian.wgsl).
    mip_filter: u32,
    // What lies between camera and scene: MEDIUM_* of water.wgsl.
    medium: u32,
}

// Unit direction, scene axes, from the camera through pixel `i` (row-major).
fn direction_of(frame: Frame, i: u32) -> vec3<f32> {
    let columns = max(frame.size.x, 1u);
    let at = vec2<f32>(f32(i % columns), f32(i / columns)) + 0.5;
    let ray = normalize(vec3<f32>((at - frame.principal) / frame.focal, 1.0));
    return ray.x * frame.view_x.xyz + ray.y * frame.view_y.xyz + ray.z * frame.view_z.xyz;
}

// The host prepends TILE, the side of a tile in pixels (8 on a CPU adapter, else 16), and LANES = TILE * TILE
// / 8. NEAR is in scene units; nearer Gaussians are culled.
const NEAR: f32 = 0.01;
// Low-pass of the projection, pixel^2 (3DGS): a Gaussian is never thinner than about a pixel.
const BLUR: f32 = 0.3;
// That of disks. 2DGS has 0.5, which blurs disks of about a pixel (bench/history.jsonl).
const DISK_BLUR: f32 = 0.2;
// Alpha below one step of 8-bit colour is not blended.
const MIN_ALPHA: f32 = 1.0 / 255.0;
// No single Gaussian is fully opaque, so that division by 1 - alpha is safe.
const MAX_ALPHA: f32 = 0.99;
// (1 - MAX_ALPHA)^2: two opaque Gaussians end a ray.
const MIN_TRANSMITTANCE: f32 = 1e-4;

// WGSL has no isFinite and compilers may fold x == x; comparing the exponent bits is safe.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// Index of a workgroup in a dispatch that was folded into two dimensions.
fn folded(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}

// Clamps a value of a uniform to the length of an array. It is used wherever a branch or a loop depends on a
// uniform alone. For such a stage Mesa's lavapipe (22.3) compiles a copy at every dispatch and keeps it, so
// memory grew by half a megabyte per iteration. A bound that is unknown at compile time prevents that.
fn veiled(value: u32, bound: u32) -> u32 {
    return min(value, bound);
}
