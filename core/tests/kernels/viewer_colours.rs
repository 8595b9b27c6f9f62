//! Colours for viewers: they let programs that blend in sRGB show a model that is blended in linear light.

use fathom_core::config::Composition;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, Output, Renderer, WaterView};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::viewer_colours::ViewerColours;
use fathom_core::views::{PackedImage, TrainView};
use fathom_core::water::Water;

use crate::device::device;
use crate::trainer::{photographs, truth};

/// The picture of `model` from `view`: under `water`, or as viewers show it.
fn picture(
    gpu: &std::sync::Arc<Gpu>,
    model: &Gaussians,
    water: Option<WaterView>,
    view: &TrainView,
) -> PackedImage {
    let mut renderer = Renderer::new(gpu.clone(), model).unwrap().with_water(water);
    let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
    quantised(rendered.width, rendered.height, &rendered.rgb)
}

#[test]
fn new_colours_alone_show_a_linear_model_in_srgb_viewers() {
    let Some(gpu) = device() else { return };
    let mut views = photographs(&gpu, 96, 72).views;
    let held_out = views.remove(2);
    // Half transparent, so that colours overlap.
    let model = Gaussians { opacity_logits: vec![0.0; truth().len()], ..truth() };
    let water = Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
    let shown = WaterView {
        water,
        refinement: None,
        by_direction: None,
        composition: Composition::PixelsLinear,
        output: Output::Restored,
    };
    let find = |iterations| {
        let (mut reported, views) = (Vec::new(), views.clone());
        let colours = ViewerColours { iterations, seed: 1 };
        let found = colours.find(&gpu, &model, shown, views, |now| reported.push(now.iteration)).unwrap();
        (found, reported)
    };
    let (found, reported) = find(620);
    assert_eq!((reported.first(), reported.last()), (Some(&50), Some(&620)));
    assert_eq!(
        Gaussians { sh_coeffs: model.sh_coeffs.clone(), ..found.clone() },
        model,
        "only colours may change"
    );
    let own = picture(&gpu, &model, Some(shown), &held_out);
    let [before, after] = [&model, &found].map(|model| psnr(&picture(&gpu, model, None, &held_out), &own));
    // The remaining difference is at the edges of Gaussians over black, which no colour can correct.
    assert!(after > before + 4.0, "from {before} to {after} dB");
    assert_eq!(find(620).0, found, "the same seed must give the same bytes");
}
