//! The shaders as text: their layouts match the host. No adapter needed.

use std::mem::offset_of;

use fathom_core::gpu::{
    BlockUniform, DbdrState, DbdrUniform, ExposureUniform, FilmUniform, FrameUniform, LossUniform,
    MaskLossUniform, MediumUniform, NormalsUniform, PriorsUniform, StepUniform, SurfaceState,
    SurfaceStepUniform, SurfaceUniform, TileLayout, WaterState, WaterUniform, shader_source,
};

/// Asserts that struct `name` of `stage` has the size and the offsets of its mirror.
#[track_caller]
fn compare(stage: &str, name: &str, size: usize, fields: &[(&str, usize)]) {
    let module = naga::front::wgsl::parse_str(&shader_source(stage, TileLayout::GPU).unwrap()).unwrap();
    let found = module.types.iter().find_map(|(_, ty)| match &ty.inner {
        naga::TypeInner::Struct { members, span } if ty.name.as_deref() == Some(name) => {
            Some((members, *span))
        }
        _ => None,
    });
    let Some((members, span)) = found else { panic!("{stage} has no struct {name}") };
    let in_wgsl: Vec<(&str, usize)> =
        members.iter().map(|m| (m.name.as_deref().unwrap_or("?"), m.offset as usize)).collect();
    assert_eq!(in_wgsl, fields, "{name}: fields in WGSL (left) and in the host's mirror");
    assert_eq!(span as usize, size, "{name}: size in WGSL (left) and of the host's mirror");
}

macro_rules! mirror {
    ($stage:literal, $name:literal, $type:ty, $($field:ident),+ $(,)?) => {
        compare($stage, $name, size_of::<$type>(), &[$((stringify!($field), offset_of!($type, $field))),+])
    };
}

#[test]
fn uniforms_of_the_host_have_the_layout_of_the_shaders() {
    mirror!(
        "cull",
        "Frame",
        FrameUniform,
        view_x,
        view_y,
        view_z,
        eye,
        sh_degree,
        focal,
        principal,
        ratio_min,
        ratio_max,
        background,
        iteration,
        size,
        tiles,
        visible_capacity,
        intersect_capacity,
        gaussians,
        blocks,
        rect_min,
        rect_max,
        first_tile,
        end_tile,
        mip_filter,
        medium,
    );
    mirror!("cull", "Block", BlockUniform, base, count, index, sh_stride);
    mirror!(
        "project_backward",
        "Step",
        StepUniform,
        means_lr,
        quats_lr,
        scales_lr,
        opacity_lr,
        sh_dc_lr,
        sh_rest_lr,
        opacity_reg,
        scale_reg,
        mean_noise,
        overwhite_weight,
        floater_weight,
        mask_lr,
        seed,
        gradients_only,
        trainable,
        clear_range
    );
    mirror!(
        "film",
        "Film",
        FilmUniform,
        size,
        cells,
        view,
        views,
        rate,
        unbias1,
        unbias2,
        view_rate,
        view_unbias1,
        view_unbias2,
    );
    mirror!("normal_consistency", "Normals", NormalsUniform, weight, least_alpha, pad_a, pad_b);
    mirror!("surface_rays", "Surface", SurfaceUniform, normal, offset, eta, schlick, as_shown, over,);
    mirror!(
        "surface_step",
        "SurfaceStep",
        SurfaceStepUniform,
        rows,
        offset_rate,
        tilt_rate,
        unbias1,
        unbias2,
        pad,
        pad1,
        pad2,
        pivot,
        pad3,
    );
    mirror!("surface_step", "SurfaceState", SurfaceState, moment1, moment2, left_out, pad0, pad1, pad2,);
    mirror!("surface_mask", "MaskLoss", MaskLossUniform, cells, first, weight,);
    mirror!("expose", "Exposure", ExposureUniform, pixels, view, views, pad0, rate, unbias1, unbias2, pad1,);
    mirror!(
        "water",
        "Water",
        WaterUniform,
        beta_d,
        scale,
        beta_b,
        per_unit,
        b_inf,
        most,
        refinement,
        red,
        green,
        blue,
    );
    mirror!(
        "water_step",
        "WaterState",
        WaterState,
        raw,
        moment1,
        moment2,
        left_out,
        shares,
        gathered,
        gathered_iterations,
    );
    mirror!("dbdr_step", "DbdrState", DbdrState, raw, moment1, moment2, left_out, pad);
    mirror!("dbdr_step", "Dbdr", DbdrUniform, rows, rate, unbias1, unbias2,);
    mirror!(
        "water",
        "Medium",
        MediumUniform,
        pixels,
        compose,
        encode,
        rows,
        gaussian_rows,
        masked,
        unit,
        rate,
        unbias1,
        unbias2,
        decay,
        background_weight,
        background_distance,
        surface_weight,
        gathers,
        map_columns,
        map_rows,
        open_weight,
        range_weight,
        range_slack,
        edge_distance,
    );
    mirror!(
        "depth_smoothness",
        "Priors",
        PriorsUniform,
        size,
        masked,
        on_photograph,
        linear,
        radius,
        unit,
        dark_weight,
        negative,
        smooth_weight,
        pad0,
        pad1,
    );
    mirror!(
        "loss_sum",
        "LossParams",
        LossUniform,
        size,
        channel,
        masked,
        ssim_weight,
        scale,
        log_at,
        pad,
        weights_a,
        weights_b,
    );
}
