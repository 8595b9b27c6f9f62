//! Colour, alpha and range of every pixel, computed from the splats of the kernels.

use fathom_twins::{RasterRules, intersect, rasterize_forward, samples};

use crate::bounds::of_images;
use crate::device::layouts;
use crate::view::{BACKGROUND, Scene, View, hard_scenes};

/// Compares every pixel and returns the number of edge pixels.
#[track_caller]
fn check(view: &View) -> usize {
    let (width, height) = (view.scene.camera.width, view.scene.camera.height);
    let background = view.scene.background64();
    let splats = view.splats();
    let lists = intersect(&splats, width, height);
    let twin = rasterize_forward(&splats, &lists, width, height, background, &RasterRules::HARD);
    let bounds = of_images(&splats, &lists, width, height, background);
    let (image, range) = (view.image(), view.range_image());
    let mut edges = 0;
    for (i, bound) in bounds.iter().enumerate() {
        edges += usize::from(bound.edge);
        let pixel = image[i].map(f64::from);
        let numbers = [
            ("red", pixel[0], twin.rgb[i][0], bound.rgb),
            ("green", pixel[1], twin.rgb[i][1], bound.rgb),
            ("blue", pixel[2], twin.rgb[i][2], bound.rgb),
            ("alpha", pixel[3], twin.alpha[i], bound.alpha),
            ("range", f64::from(range[i]), twin.range[i], bound.range),
        ];
        for (name, kernel, twin, tolerance) in numbers {
            assert!(
                (kernel - twin).abs() <= tolerance,
                "{}: {name} at pixel {}, {}: kernel {kernel}, twin {twin}, difference {:e}, tolerance {tolerance:e}",
                view.scene.name,
                i as u32 % width,
                i as u32 / width,
                (kernel - twin).abs(),
            );
        }
    }
    edges
}

#[test]
fn images_of_hard_scenes_match_the_twin() {
    for gpu in layouts() {
        for scene in hard_scenes(51, 400, 1) {
            let edges = check(&View::render(&gpu, &scene));
            // The band of alpha around 1/255 is about 1e-6 wide, for needles 1e-4. Few of 400 splats on 4,000
            // pixels lie in it.
            assert!(edges <= 4000 / 50, "{}: {edges} pixels at an edge", scene.name);
        }
    }
}

#[test]
fn images_of_odd_sizes_match_the_twin() {
    for gpu in layouts() {
        for (width, height) in [(1, 1), (16, 16), (17, 1), (1, 33), (8, 8), (9, 7), (128, 96), (75, 53)] {
            let scene = Scene::new(&format!("{width}x{height}"), samples::random(52, 150, 0), width, height);
            check(&View::render(&gpu, &scene));
        }
    }
}

#[test]
fn tiles_without_splats_show_the_background() {
    for gpu in layouts() {
        let mut model = samples::random(53, 3, 0);
        model.log_scales.iter_mut().for_each(|scales| *scales = [-5.0; 3]);
        let view = View::render(&gpu, &Scene::new("three specks", model, 100, 60));
        check(&view);
        let lists = view.tile_lists();
        let empty = lists.iter().filter(|ids| ids.is_empty()).count();
        assert!(empty > lists.len() / 2, "{empty} empty tiles of {}", lists.len());
        let [r, g, b] = BACKGROUND;
        let clear = view.image().iter().filter(|pixel| **pixel == [r, g, b, 0.0]).count();
        assert!(clear > 4000, "{clear} clear pixels of 6000");
    }
}

#[test]
fn a_view_of_nothing_is_the_background() {
    for gpu in layouts() {
        // No Gaussians at all, and none in front of the camera.
        let mut behind = samples::random(54, 20, 0);
        behind.means.iter_mut().for_each(|mean| mean[2] -= 50.0);
        let none = fathom_core::gaussians::Gaussians::empty(0);
        for (name, model) in [("all behind", behind), ("empty model", none)] {
            let view = View::render(&gpu, &Scene::new(name, model, 33, 18));
            let [r, g, b] = BACKGROUND;
            assert!(view.image().iter().all(|pixel| *pixel == [r, g, b, 0.0]), "{name}");
            assert!(view.range_image().iter().all(|range| *range == 0.0), "{name}");
        }
    }
}

#[test]
fn opaque_splats_end_rays_where_the_twin_ends_them() {
    for gpu in layouts() {
        // Opacity 0.9999: alpha is capped at the centres, and two layers end a ray.
        let mut model = samples::random(55, 600, 0);
        model.opacity_logits.fill(9.2);
        let view = View::render(&gpu, &Scene::new("opaque", model, 75, 53));
        check(&view);
        let ended = view.image().iter().filter(|pixel| pixel[3] > 0.99).count();
        assert!(ended > 1000, "{ended} pixels are covered; more rays must end");
        let splats = view.splats();
        let lists = intersect(&splats, 75, 53);
        let twin = rasterize_forward(&splats, &lists, 75, 53, view.scene.background64(), &RasterRules::HARD);
        let tiles_across = view.uniform.tiles[0];
        let tile = gpu.tile();
        let tile_ends: Vec<u32> = gpu
            .read(&view.frame.targets().unwrap().tile_ends, 0, view.uniform.tile_count() as usize)
            .unwrap();
        let kernel_lists = view.tile_lists();
        // The backward pass starts from tile_ends, so every splat that the twin blended must lie before it.
        for (i, &last) in twin.last.iter().enumerate().filter(|(_, last)| **last > 0) {
            let (x, y) = (i as u32 % 75, i as u32 / 75);
            let id = lists.of_tile(x / 16, y / 16)[last as usize - 1] as usize;
            let at = (y / tile * tiles_across + x / tile) as usize;
            let place = kernel_lists[at].iter().position(|&other| other == id);
            assert!(
                place.is_some_and(|p| p < tile_ends[at] as usize),
                "pixel {x}, {y}: splat {id} at {place:?}"
            );
        }
    }
}
