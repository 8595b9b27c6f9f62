// As ray_gradients.wgsl, for rays that do not move: those from the eye, and those at a water surface that is
// not trained. Needs disk, met and rays.

alias Noted = f32;

fn note(noted: ptr<private, Noted>, disk: Splat, plane: Plane, met: Met, rays: Rays, v_u: vec4<f32>,
        v_v: vec4<f32>, turn: vec4<f32>) {}

fn store_noted(column: u32, row: u32, noted: Noted) {}
