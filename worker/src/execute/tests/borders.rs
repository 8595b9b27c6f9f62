//! Tests border training on a real device: a floor with a damaged middle, and photographs of the undamaged
//! floor.

use fathom_core::config::Composition;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Output, Renderer, WaterView, device_for_test};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::ply;
use fathom_core::views::{PackedImage, TrainView};
use fathom_core::water::{StandardErrors, Water};

use fathom_proto::worker::v1::BordersSpec;

use super::*;

/// Half the width of the damaged strip around x = 0 and of the trained band.
const REACH: f32 = 0.3;
const SIZE: [u32; 2] = [48, 36];

/// A floor of small Gaussians with varying colour.
fn floor() -> Gaussians {
    let mut floor = Gaussians::empty(0);
    for (x, z) in (-16..=16).flat_map(|x| (-8..=8).map(move |z| (x, z))) {
        floor.means.push([0.1 * x as f32, 0.0, 0.1 * z as f32]);
        floor.quats.push([1.0, 0.0, 0.0, 0.0]);
        floor.log_scales.push([0.07_f32.ln(), 0.01_f32.ln(), 0.07_f32.ln()]);
        floor.opacity_logits.push(3.0);
        let wave = |k: f32| (k * x as f32 + 0.7 * z as f32).sin();
        floor.sh_coeffs.push([0.8 * wave(0.3), 0.8 * wave(0.5), 0.8 * wave(0.9)]);
    }
    floor
}

fn is_damaged(mean: [f32; 3]) -> bool {
    mean[0].abs() <= REACH
}

/// A water in which backscatter is a third of the light.
fn water() -> WaterRecord {
    let water = Water { beta_d: [0.2, 0.1, 0.1], beta_b: [0.2; 3], b_inf: [0.1, 0.3, 0.5] };
    let acts = Composition::GaussiansSrgb;
    WaterRecord::new(&water, acts, StandardErrors::from_array([1e-3; 9]), "descended", 0.0)
}

/// Photographs of `model` under the water by cameras above `at`.
struct Photographer {
    gpu: Arc<Gpu>,
    views: Vec<TrainView>,
}

impl Photographer {
    fn new(gpu: Arc<Gpu>) -> Self {
        let camera = fathom_core::scene::PinholeCamera {
            width: SIZE[0],
            height: SIZE[1],
            fx: 40.0,
            fy: 40.0,
            cx: 24.0,
            cy: 18.0,
        };
        // Two views of the middle, one from each side, and one that does not see it.
        let at = [(-0.3, 0.1), (0.3, -0.1), (-0.6, 0.0), (0.6, 0.0), (9.0, 0.0)];
        let views = at.iter().enumerate().map(|(index, (x, z))| {
            let eye = DVec3::new(*x, -1.6, *z);
            let pose = Pose::looking_at(eye, DVec3::new(*x, 0.0, *z), DVec3::Z);
            TrainView { name: format!("{index}.png"), camera, pose, clear_range: 0.0 }
        });
        let views = views.collect();
        Self { gpu, views }
    }

    fn seen(&self, model: &Gaussians) -> Vec<PackedImage> {
        let mut renderer = Renderer::new(Arc::clone(&self.gpu), model).unwrap();
        renderer.set_water(Some(WaterView::of_record(&water(), Output::Underwater)));
        let seen = |view: &TrainView| {
            let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
            quantised(rendered.width, rendered.height, &rendered.rgb)
        };
        self.views.iter().map(seen).collect()
    }

    /// Mean PSNR over the views of the middle.
    fn psnr(&self, model: &Gaussians, truth: &[PackedImage]) -> f64 {
        let seen = self.seen(model);
        (0..4).map(|view| psnr(&seen[view], &truth[view])).sum::<f64>() / 4.0
    }
}

struct Damaged {
    dir: tempfile::TempDir,
    task: TaskInput,
    /// The undamaged model.
    whole: Gaussians,
    /// The merged model as bytes.
    merged: Vec<u8>,
    photographer: Photographer,
    truth: Vec<PackedImage>,
}

impl Damaged {
    /// `None` where there is no adapter.
    fn new(what: &str) -> Option<Self> {
        let photographer = Photographer::new(device_for_test(what)?);
        let dir = tempfile::tempdir().unwrap();
        let mut task = TaskInput { stage: Stage::Borders, ..task(dir.path(), 0) };
        let whole = floor();
        let truth = photographer.seen(&whole);
        let camera = Camera {
            id: 1,
            model: CameraModel::Pinhole,
            width: SIZE[0],
            height: SIZE[1],
            params: vec![40.0, 40.0, 24.0, 18.0],
        };
        task.manifest.cameras = vec![camera];
        let photographs = photographer.views.iter().zip(&truth).map(|(view, picture)| {
            let rgb: Vec<u8> =
                picture.pixels.iter().flat_map(|pixel| pixel.to_le_bytes()[..3].to_vec()).collect();
            let png = encode_png(SIZE[0], SIZE[1], &rgb).unwrap();
            let digest = blake3::hash(&png).to_hex().to_string();
            let path = dir.path().join(&digest);
            std::fs::write(&path, &png).unwrap();
            task.files.insert(digest.clone(), path);
            let image = BlobRef { digest, bytes: png.len() as u64 };
            ManifestView { name: view.name.clone(), camera_id: 1, pose: view.pose, image, mask: None }
        });
        task.manifest.views = photographs.collect();
        let mut damaged = whole.clone();
        for index in 0..damaged.len() {
            if is_damaged(damaged.means[index]) {
                damaged.opacity_logits[index] = 0.0;
            }
        }
        let merged = ply::to_bytes(&damaged, &[water().to_comment().unwrap()]).unwrap();
        let path = dir.path().join("merged.ply");
        std::fs::write(&path, &merged).unwrap();
        task.inputs.insert(Artifact::Model, path);
        task.config.train.sh_degree = 0;
        task.config.borders.learning_rate = 0.5;
        let strip = |reach: f64| FocusBox {
            align_quat_wxyz: vec![1.0, 0.0, 0.0, 0.0],
            min_x: -reach,
            max_x: reach,
            min_z: f64::NEG_INFINITY,
            max_z: f64::INFINITY,
        };
        let width = f64::from(REACH) + 0.01;
        task.common = CommonSpec {
            views: (0..5).collect(),
            max_resolution_px: 48,
            iterations: 120,
            max_gaussians: 0,
            viewing_distance: Some(1.6),
            ..task.common
        };
        task.work =
            Work::Borders(BordersSpec { band: vec![strip(width)], surroundings: vec![strip(2.0 * width)] });
        Some(Self { dir, task, whole, merged, photographer, truth })
    }
}

#[test]
fn a_damaged_border_is_repaired_and_nothing_else_changes() {
    let Some(damaged) = Damaged::new("a border that is mended") else { return };
    let executor = executor("a border that is mended", None).unwrap();
    let Damaged { task, whole, merged, photographer, truth, .. } = &damaged;
    let control = Keeps::new(None);
    let done = executor.execute(task, &control).unwrap();
    assert_eq!((done.gaussians as usize, done.resumed_from), (whole.len(), 0));
    assert_eq!(control.reported.lock().unwrap().last(), Some(&(120, 120)));

    let [before, after] =
        [&merged[..], &done.result[..]].map(|model| ply::from_bytes(model, "model").unwrap());
    let row_bytes = ply::Layout::new(0).unwrap().row_bytes();
    let header = merged.len() - whole.len() * row_bytes;
    assert_eq!(done.result[..header], merged[..header], "the water or the number of rows changed");
    let row = |model: &[u8], index: usize| model[header + index * row_bytes..][..row_bytes].to_vec();
    let mut trained = 0;
    for index in 0..whole.len() {
        let changed = row(&done.result, index) != row(merged, index);
        assert!(
            !changed || is_damaged(before.means[index]),
            "row {index} of {:?} changed",
            before.means[index]
        );
        trained += u32::from(changed);
    }
    assert!(trained > 60, "only {trained} of 7 x 17 changed");

    let [was, is] = [&before, &after].map(|model| photographer.psnr(model, truth));
    println!("{was:.2} dB with the damage, {is:.2} dB after");
    assert!(is > was + 4.0, "{was:.2} dB with the damage, {is:.2} dB after");
    // Without the water, the strip would take the backscatter as its colour.
    let bluish = |model: &Gaussians| {
        let blue = (0..model.len()).filter(|index| is_damaged(whole.means[*index]));
        blue.map(|index| model.sh_coeffs[index][2]).sum::<f32>() / trained as f32
    };
    let (found, meant) = (bluish(&after), bluish(whole));
    assert!((found - meant).abs() < 0.1, "blue is {found}, expected {meant}");
}

#[test]
fn interrupted_border_training_gives_the_same_bytes() {
    let Some(mut damaged) = Damaged::new("interrupted border training") else { return };
    let executor = executor("interrupted border training", None).unwrap();
    damaged.task.common.iterations = 40;
    damaged.task.config.borders.relocate = true;
    let whole = executor.execute(&damaged.task, &Keeps::new(None)).unwrap();
    let leaves = Keeps::new(Some(1));
    let Err(TaskError::Stopped { checkpoint: Some((checkpoint, done)) }) =
        executor.execute(&damaged.task, &leaves)
    else {
        panic!("it did not leave")
    };
    assert!(done > 0 && done < 40, "left at {done}");
    let path = damaged.dir.path().join("checkpoint");
    std::fs::write(&path, &checkpoint).unwrap();
    let resumed = executor.execute(&TaskInput { checkpoint: Some(path), ..damaged.task }, &Keeps::new(None));
    let resumed = resumed.unwrap();
    assert_eq!(resumed.resumed_from, done);
    assert!(resumed.result == whole.result, "resumed to other bytes");
    assert!(whole.result != damaged.merged, "nothing was trained");
}

#[test]
fn borders_that_no_view_shows_leave_the_model_as_it_is() {
    let Some(mut damaged) = Damaged::new("borders that no view shows") else { return };
    let executor = executor("borders that no view shows", None).unwrap();
    // None of the remaining views shows the band.
    damaged.task.common.views = vec![4];
    let unseen = executor.execute(&damaged.task, &Keeps::new(None)).unwrap();
    assert!(unseen.result == damaged.merged, "trained on a view that does not show it");
    damaged.task.common.views = vec![0, 1];
    let Work::Borders(spec) = &mut damaged.task.work else { panic!("it trains borders") };
    (spec.band[0].min_x, spec.band[0].max_x) = (5.0, 6.0);
    let empty = executor.execute(&damaged.task, &Keeps::new(None)).unwrap();
    assert!(empty.result == damaged.merged, "there is nothing to train");
}
