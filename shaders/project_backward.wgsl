//@ import frame, counters, gaussian, projection, harmonics, water, random, shape, adam, gather, moments
//@ variant project_backward projection=projection+sight_eye
//@ variant project_backward shape=splat+pull_splat
//@ variant project_backward moments=moments_compact
//@ variant project_backward gather=splat_rows+gather_slots+gradient_of_slots
//@ variant project_backward_f32 projection=projection+sight_eye
//@ variant project_backward_f32 shape=splat+pull_splat
//@ variant project_backward_f32 moments=moments_f32
//@ variant project_backward_f32 gather=splat_rows+gather_slots+gradient_of_slots
//@ variant project_backward_bands projection=projection+sight_eye
//@ variant project_backward_bands shape=splat+pull_splat
//@ variant project_backward_bands moments=moments_compact
//@ variant project_backward_bands gather=splat_sums+gradient_of_bands
//@ variant project_backward_bands_f32 projection=projection+sight_eye
//@ variant project_backward_bands_f32 shape=splat+pull_splat
//@ variant project_backward_bands_f32 moments=moments_f32
//@ variant project_backward_bands_f32 gather=splat_sums+gradient_of_bands
//@ variant project_disks_backward projection=projection+sight_eye
//@ variant project_disks_backward shape=disk+outline+centre_straight+pull_disk
//@ variant project_disks_backward moments=moments_compact
//@ variant project_disks_backward gather=disk_rows+gather_slots+gradient_of_slots
//@ variant project_disks_backward_f32 projection=projection+sight_eye
//@ variant project_disks_backward_f32 shape=disk+outline+centre_straight+pull_disk
//@ variant project_disks_backward_f32 moments=moments_f32
//@ variant project_disks_backward_f32 gather=disk_rows+gather_slots+gradient_of_slots
//@ variant project_disks_backward_bands projection=projection+sight_eye
//@ variant project_disks_backward_bands shape=disk+outline+centre_straight+pull_disk
//@ variant project_disks_backward_bands moments=moments_compact
//@ variant project_disks_backward_bands gather=disk_sums+gradient_of_bands
//@ variant project_disks_backward_bands_f32 projection=projection+sight_eye
//@ variant project_disks_backward_bands_f32 shape=disk+outline+centre_straight+pull_disk
//@ variant project_disks_backward_bands_f32 moments=moments_f32
//@ variant project_disks_backward_bands_f32 gather=disk_sums+gradient_of_bands
//@ variant project_refracted_backward projection=projection+surface+sight_refracted
//@ variant project_refracted_backward shape=disk+outline+centre_refracted+pull_disk
//@ variant project_refracted_backward moments=moments_compact gather=disk_rows+gather_slots+gradient_of_slots
//@ variant project_refracted_backward_f32 projection=projection+surface+sight_refracted
//@ variant project_refracted_backward_f32 shape=disk+outline+centre_refracted+pull_disk
//@ variant project_refracted_backward_f32 moments=moments_f32 gather=disk_rows+gather_slots+gradient_of_slots
//@ variant project_refracted_backward_bands projection=projection+surface+sight_refracted
//@ variant project_refracted_backward_bands shape=disk+outline+centre_refracted+pull_disk
//@ variant project_refracted_backward_bands moments=moments_compact gather=disk_sums+gradient_of_bands
//@ variant project_refracted_backward_bands_f32 projection=projection+surface+sight_refracted
//@ variant project_refracted_backward_bands_f32 shape=disk+outline+centre_refracted+pull_disk
//@ variant project_refracted_backward_bands_f32 moments=moments_f32 gather=disk_sums+gradient_of_bands
// From the gradients of the splats to updated Gaussians: backward projection and Adam in one step.
//
// Gradients of parameters are never stored. One thread per visible Gaussian of the block. It sums the
// gradients of its slots in order (gradient_of_*.wgsl). It backpropagates them through the projection: the
// adjoint of project_forward, including the direction of the spherical harmonics and the range. Then it takes
// one step of Adam (adam.wgsl, moments_*.wgsl) with the step count of this Gaussian. Gaussians without any
// gradient in this view are not changed.
//
// Learning rates: 3DGS applies Adam to all Gaussians in every iteration. If a share p of the views sees a
// Gaussian, its second moment there also averages zeros. Its steps are then 1 / sqrt(p) larger for each view
// that sees it. `lr_scale` does the same here, with p the share of the trainable Gaussians that this view
// sees. It does not apply to scales and the higher bands. Under water the constant colour has a factor of its
// own (water.wgsl).
//
// Regularisation, per visit: weights on opacity and scale and noise on the means. 3DGS-MCMC (Kheradmand et
// al. 2024) applies them to every Gaussian in every iteration; here the weights are divided by the number of
// visible Gaussians. Under water there is a further weight on the opacity of Gaussians that float in front of
// the scene.
// Twins: core/twins/src/project_backward.rs, core/twins/src/adam.rs

struct Step {
    // Learning rates of Adam; the rate of the means is in scene units.
    means_lr: f32,
    quats_lr: f32,
    scales_lr: f32,
    opacity_lr: f32,
    // Learning rates of the constant colour and of the higher bands.
    sh_dc_lr: f32,
    sh_rest_lr: f32,
    // Weights on opacity and on scale.
    opacity_reg: f32,
    scale_reg: f32,
    // Factor of the noise on the means, in standard deviations of the Gaussian.
    mean_noise: f32,
    // Under water: weight of colours above white, and weight on the opacity of Gaussians nearer to the camera
    // than clear_range.
    overwhite_weight: f32,
    floater_weight: f32,
    // Of the masks of disks.
    mask_lr: f32,
    seed: u32,
    // 1 writes raw gradients instead of taking steps, if moments are f32 (tests): [v_mean, v_logit],
    // [v_quat], [v_log_scale].
    gradients_only: u32,
    // Trainable Gaussians in all blocks; 0 leaves the rates unscaled (tests).
    trainable: u32,
    // Range up to which this view sees nothing but water, scene units; 0 if unknown.
    clear_range: f32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<uniform> step: Step;
@group(0) @binding(3) var<storage, read> counters: array<u32>;
@group(0) @binding(4) var<storage, read> flags: array<u32>;
@group(0) @binding(8) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> sh_coeffs: array<vec4<f32>>;
@group(0) @binding(13) var<storage, read_write> density_sums: array<vec4<f32>>;
@group(0) @binding(15) var<uniform> water: Water;

// Largest factor on the rates in a view that sees a small part of the model.
const MAX_LR_SCALE: f32 = 8.0;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let gathered = gather(folded(group, groups) * 64u + lane);
    let i = gathered.i;
    if i == NONE {
        return;
    }
    let sum = gathered.sum;
    let gradients_only = keeps_gradients();
    // The Gaussian is hidden, or only visible in pixels that do not count. The weights alone would be a
    // gradient too, and Adam would scale it to full size: Gaussians that other views need would fade and
    // scatter.
    if !gradients_only && is_untouched(sum) {
        return;
    }

    let t0 = transforms[3u * i];
    let t1 = transforms[3u * i + 1u];
    let t2 = transforms[3u * i + 2u];
    let mean = t0.xyz;
    let quat_norm = length(t1);
    let quat = t1 / quat_norm;
    let rot = rotation(quat);
    let bare_scales = exp(t2.xyz);
    // Sums of density control, and smoothing; see the end.
    let seen = density_sums[i];
    let opacity = sigmoid(t0.w);
    let pulled = pull(sum, mean, quat, rot, bare_scales, t2.xyz, seen.z, opacity);
    let v_quat = pulled.v_quat / quat_norm;
    var v_mean = pulled.v_mean;
    var v_logit = pulled.v_logit;
    var v_log_scale = pulled.v_log_scale;

    // Colour = max(0, 0.5 + sum of coefficient * basis(direction)).
    let offset = mean - sight_of(mean);
    let distance = length(offset);
    let direction = offset / distance;
    let degree = veiled(frame.sh_degree, arrayLength(&sh_coeffs));
    let basis_values = basis(degree, direction);
    let at = i * block.sh_stride;
    let coefficient_count = coefficient_groups(degree);
    var rgb = vec3<f32>(0.5);
    for (var g = 0u; g < coefficient_count; g++) {
        let v0 = sh_coeffs[at + 3u * g];
        let v1 = sh_coeffs[at + 3u * g + 1u];
        let v2 = sh_coeffs[at + 3u * g + 2u];
        let k = basis_vec(basis_values, g);
        rgb += k.x * v0.xyz + k.y * vec3<f32>(v0.w, v1.xy) + k.z * vec3<f32>(v1.zw, v2.x) + k.w * v2.yzw;
    }
    var v_blended = colour_gradient(sum);
    // Factor on the rate of the constant colour, so that the seen colour moves as fast as in air. It does not
    // apply to the higher bands: they would fit the noise of a photograph as view dependence, several times
    // over. Their rate differs only in clear water (water.clear_harmonics), through step.sh_rest_lr.
    var colour_lr_scale = vec3<f32>(1.0);
    let medium = veiled(frame.medium, arrayLength(&flags) + 6u);
    if medium != MEDIUM_NONE {
        let clear = max(rgb, vec3<f32>(0.0));
        let through = exp(-water.beta_d * distance);
        colour_lr_scale = lr_scale_under_water(water, clear, distance);
        if medium != MEDIUM_DECODED && medium < MEDIUM_AS_SHOWN {
            v_blended = by_light(medium, water, clear, distance, v_blended);
            let veil_slope = water.b_inf * water.beta_b * exp(-water.beta_b * distance);
            v_mean += dot(v_blended, veil_slope - water.beta_d * through * decoded(clear)) * direction;
            v_blended *= through;
        }
        v_blended *= select(decoded_slope(clear), vec3<f32>(1.0), medium >= MEDIUM_AS_SHOWN);
        // d/ds of y (s - 1)^2 above white, averaged over channels and visible Gaussians.
        let above = max(clear - 1.0, vec3<f32>(0.0));
        v_blended += (step.overwhite_weight * 2.0 / (3.0 * f32(max(counters[VISIBLE], 1u)))) * above;
    }
    let v_rgb = select(vec3<f32>(0.0), v_blended, rgb > vec3<f32>(0.0));

    // Adam's step count of this Gaussian.
    let count = bitcast<u32>(t2.w) + 1u;
    var lr_scale = 1.0;
    let trainable = veiled(step.trainable, arrayLength(&flags));
    if trainable > 0u {
        // Trainable Gaussians come first, so this is the number of them that the view sees.
        var seen_count = counters[VISIBLE];
        if trainable < frame.gaussians {
            seen_count = flags[trainable];
        }
        lr_scale = min(sqrt(f32(trainable) / f32(max(seen_count, 1u))), MAX_LR_SCALE);
    }
    let pace = pace_of(count);
    // Scales and the higher bands are not scaled: their rates are as large as a step may be
    // (core/twins/src/adam.rs).
    let rates = vec4<f32>(lr_scale, lr_scale, 1.0, lr_scale)
        * vec4<f32>(step.means_lr, step.quats_lr, step.scales_lr, step.opacity_lr);
    let third_rates = vec4<f32>(rates.zz, select(step.mask_lr, rates.z, HAS_SCALE.z > 0.0), rates.z);
    let sh_rates = vec2<f32>(lr_scale, 1.0) * vec2<f32>(step.sh_dc_lr, step.sh_rest_lr);
    begin_colour(i, v_rgb, greatest_of(basis_values), pace);
    var weights = Basis(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
    for (var g = 0u; g < coefficient_count; g++) {
        let k = basis_vec(basis_values, g);
        let dc = g == 0u;
        for (var part = 0u; part < 3u; part++) {
            let n = at + 3u * g + part;
            let value = sh_coeffs[n];
            var gradient: vec4<f32>;
            var rate = sh_rates.yyyy;
            // Four coefficients of three channels fill three vectors.
            if part == 0u {
                gradient = vec4<f32>(k.x * v_rgb, k.y * v_rgb.x);
                let own = vec4<f32>(dot(value.xyz, v_rgb), value.w * v_rgb.x, 0.0, 0.0);
                add_weights(&weights, g, own);
                if dc { rate = vec4<f32>(sh_rates.x * colour_lr_scale, sh_rates.y); }
            } else if part == 1u {
                gradient = vec4<f32>(k.y * v_rgb.yz, k.z * v_rgb.xy);
                add_weights(&weights, g, vec4<f32>(0.0, dot(value.xy, v_rgb.yz), dot(value.zw, v_rgb.xy), 0.0));
            } else {
                gradient = vec4<f32>(k.z * v_rgb.z, k.w * v_rgb);
                add_weights(&weights, g, vec4<f32>(0.0, 0.0, value.x * v_rgb.z, dot(value.yzw, v_rgb)));
            }
            if gradients_only {
                keep_colour_gradient(n, gradient);
            } else {
                sh_coeffs[n] = value - colour_step(n, part, gradient, rate, pace);
            }
        }
    }
    end_colour(i);
    let v_direction = basis_gradient(degree, direction, weights);
    v_mean += sight_pulled(mean, (v_direction - direction * dot(direction, v_direction)) / distance);

    if gradients_only {
        keep_gradients(i, vec4<f32>(v_mean, v_logit), v_quat, vec4<f32>(v_log_scale, 0.0));
        return;
    }
    let visible = f32(max(counters[VISIBLE], 1u));
    var weight = step.opacity_reg;
    if distance < step.clear_range {
        weight += step.floater_weight;
    }
    v_logit += weight / visible * opacity * (1.0 - opacity);
    v_log_scale += step.scale_reg / (3.0 * visible) * bare_scales * HAS_SCALE;

    var new0 = t0 - transform_step(i, 0u, vec4<f32>(v_mean, v_logit), rates.xxxw, pace);
    let new1 = t1 - transform_step(i, 1u, v_quat, rates.yyyy, pace);
    let new2 = t2.xyz - transform_step(i, 2u, vec4<f32>(v_log_scale, 0.0), third_rates, pace).xyz;
    if lr_scale * step.mean_noise > 0.0 {
        // Noise of the shape of the Gaussian, for Gaussians that are nearly transparent (gate of 3DGS-MCMC,
        // eq. 8).
        let gate = 1.0 / (1.0 + exp(-100.0 * (0.005 - opacity)));
        // Keyed by the index among all trainable Gaussians: they come first, block after block.
        let bits = random_bits(step.seed, STREAM_MEAN_NOISE, block.base + i, frame.iteration);
        let bits2 = random_bits(step.seed, STREAM_MEAN_NOISE, block.base + i, ~frame.iteration);
        let radius = sqrt(-2.0 * log(vec2<f32>(uniform_open(bits.x), uniform_open(bits2.x))));
        let turn = 6.2831853 * vec2<f32>(uniform_open(bits.y), uniform_open(bits2.y));
        let normal = vec3<f32>(radius.x * cos(turn.x), radius.x * sin(turn.x), radius.y * cos(turn.y));
        // Standard deviations times a standard normal. The code of the paper multiplies by the covariance,
        // whose unit is an area: in a scene in metres it throws Gaussians of half a metre across hundreds of
        // metres.
        let shaped = rot * (bare_scales * HAS_SCALE * normal);
        let moved = new0.xyz + (gate * lr_scale * step.mean_noise) * shaped;
        new0 = vec4<f32>(moved, new0.w);
    }
    transforms[3u * i] = new0;
    transforms[3u * i + 1u] = new1;
    transforms[3u * i + 2u] = vec4<f32>(new2, bitcast<f32>(count));
    // For density control: sum of the pixel gradient, visits, the smoothing (smoothing.wgsl), and the sum of
    // the gradient w.r.t. the centre. The last is in units of half an image, as in 3DGS, whose pixel
    // coordinates run from -1 to 1.
    let by_centre = length(0.5 * vec2<f32>(frame.size) * centre_gradient(sum));
    density_sums[i] = vec4<f32>(seen.x + gradient_on_image(sum), seen.y + 1.0, seen.z, seen.w + by_centre);
}

fn add_weights(weights: ptr<function, Basis>, g: u32, own: vec4<f32>) {
    switch g {
        case 0u: { (*weights).b0 += own; }
        case 1u: { (*weights).b1 += own; }
        case 2u: { (*weights).b2 += own; }
        default: { (*weights).b3 += own; }
    }
}

fn greatest_of(b: Basis) -> f32 {
    let m = max(max(abs(b.b0), abs(b.b1)), max(abs(b.b2), abs(b.b3)));
    return max(max(m.x, m.y), max(m.z, m.w));
}
