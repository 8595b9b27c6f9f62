//! The forecast of `fathom_core::memory` against the memory of real runs, as reported by wgpu's allocator.

use std::sync::Arc;

use fathom_core::appearance::Settings;
use fathom_core::config::{
    Composition, FilmConfig, Medium, Moments, PriorsConfig, SurfaceConfig, TrainConfig, WaterConfig,
};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, device_for_test};
use fathom_core::memory::{self, MemoryForecast, RunSize, visible_in_fullest_view};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::surface::{Surface, SurfaceRecord, WATER};
use fathom_core::train::surface::{SurfaceRun, SurfaceTrainer};
use fathom_core::train::{MediumRun, TrainRun, Trainer};
use fathom_core::views::TrainView;
use fathom_twins::samples::{grey, random};
use glam::DVec3;

struct Case {
    trained: u32,
    frozen: u32,
    sh_degree: u8,
    moments: Moments,
    exposure: bool,
    water: bool,
    dark_channel: bool,
    film: bool,
    disks: bool,
    /// Whether water lies on the floor, up to a tenth of the height of the cameras.
    surface: bool,
    size: [u32; 2],
    views: u32,
    /// Height of the cameras above a floor of 2 x 2.
    height: f64,
}

impl Case {
    fn config(&self) -> TrainConfig {
        TrainConfig {
            iterations: 2 * self.views,
            max_gaussians: self.trained,
            sh_degree: self.sh_degree,
            moments: self.moments,
            exposure: self.exposure,
            disks: self.disks || self.surface,
            sets: self.surface.then(|| SurfaceConfig::default().shares),
            refine_steps: 4,
            ..TrainConfig::default()
        }
    }

    fn water_config(&self) -> WaterConfig {
        let priors =
            PriorsConfig { dark_channel: f32::from(u8::from(self.dark_channel)), ..Default::default() };
        let film = FilmConfig { on: self.film, ..FilmConfig::default() };
        let medium = if self.water { Medium::PerPixel } else { Medium::None };
        WaterConfig { medium, priors, film, ..WaterConfig::default() }
    }

    fn views(&self) -> Vec<TrainView> {
        let [width, height] = self.size;
        let (w, h) = (f64::from(width), f64::from(height));
        let camera = PinholeCamera { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 };
        (0..self.views)
            .map(|i| {
                let turn = f64::from(i) / f64::from(self.views) * std::f64::consts::TAU;
                let below = DVec3::new(0.3 * turn.sin(), 0.0, 0.3 * turn.cos());
                let pose = Pose::looking_at(below - self.height * DVec3::Y, below, DVec3::Z);
                TrainView { name: format!("{i}"), camera, pose, clear_range: 0.0 }
            })
            .collect()
    }

    /// A floor with some relief. Its Gaussians are as wide as their spacing.
    fn model(&self, seed: u32, count: u32) -> Gaussians {
        let mut model = random(seed, count as usize, self.sh_degree);
        model.means.iter_mut().for_each(|mean| mean[1] *= 0.05);
        let spacing = 2.0 / f64::from(count.max(1)).sqrt();
        model.log_scales.fill([spacing.ln() as f32; 3]);
        model
    }

    /// As [`Case::model`], `up` above the floor.
    fn raised(&self, seed: u32, count: f32, up: f64) -> Gaussians {
        let mut model = self.model(seed, count as u32);
        model.means.iter_mut().for_each(|mean| mean[1] -= up as f32);
        model
    }

    /// The surface of a case with one; each set begins with half of its share of the cap.
    fn surface_run(&self) -> TrainRun {
        let settings = SurfaceConfig::default();
        let level = self.height / 10.0;
        let plane = Surface { normal: -DVec3::Y, offset: level, ior: WATER };
        let none = || Gaussians::empty(self.sh_degree);
        let sum: f32 = settings.shares.iter().sum();
        let [straight, refracted, reflected] =
            settings.shares.map(|share| 0.5 * self.trained as f32 * share / sum);
        let surface = SurfaceRun {
            record: SurfaceRecord::given(&plane),
            pivot: -level * DVec3::Y,
            reflected: self.raised(8, reflected, 3.0 * level),
            refracted: self.raised(9, refracted, 0.0),
            context: [none(), none()],
            config: settings,
        };
        TrainRun { focus: self.raised(5, straight, 1.2 * level), surface: Some(surface), ..self.run() }
    }

    fn run(&self) -> TrainRun {
        TrainRun {
            config: self.config(),
            extent: 3.0,
            views: Arc::new(grey(self.views())),
            // Density control fills the rest of the cap.
            focus: self.model(5, self.trained / 2),
            context: self.model(6, self.frozen),
            surfaces: Gaussians::empty(self.config().sh_degree),
            medium: self.water.then(|| MediumRun::fixed(&self.water_config(), Composition::PixelsSrgb, 1.0)),
            surface: None,
        }
    }

    /// The forecast of a coordinator, which has points but no Gaussians.
    fn forecast(&self, gpu: &Gpu) -> MemoryForecast {
        let (config, water) = (self.config(), self.water_config());
        let views = self.views();
        let means = self.model(7, 4000).means;
        let points: Vec<DVec3> = means.into_iter().map(|mean| DVec3::from(mean.map(f64::from))).collect();
        let all = u64::from(self.trained + self.frozen);
        let run = RunSize {
            settings: Settings::new(&config, &water),
            trained: self.trained.into(),
            frozen: self.frozen.into(),
            visible: visible_in_fullest_view(
                views.iter().map(|view| (view.camera, view.pose)),
                &[(&points, all)],
            ),
            pictures: &vec![self.size; self.views as usize],
            tile: gpu.tile(),
            binding_bytes: gpu.adapter().max_binding_bytes,
            measures: false,
        };
        run.forecast()
    }
}

/// Six sizes. High cameras see the whole floor, near ones a part.
const CASES: [Case; 6] = {
    use Moments::{Compact, F32};
    let base = Case {
        trained: 2000,
        frozen: 0,
        sh_degree: 3,
        moments: Compact,
        exposure: false,
        water: false,
        dark_channel: false,
        film: false,
        disks: false,
        surface: false,
        size: [96, 72],
        views: 6,
        height: 2.5,
    };
    [
        Case { ..base },
        Case {
            trained: 8000,
            sh_degree: 0,
            exposure: true,
            water: true,
            size: [160, 120],
            views: 10,
            ..base
        },
        Case { trained: 20_000, moments: F32, size: [200, 133], height: 0.7, views: 6, ..base },
        Case {
            trained: 12_000,
            frozen: 8000,
            sh_degree: 1,
            water: true,
            dark_channel: true,
            film: true,
            size: [240, 100],
            height: 1.2,
            ..base
        },
        Case { trained: 50_000, sh_degree: 2, size: [128, 96], views: 4, ..base },
        Case { trained: 20_000, disks: true, size: [200, 150], views: 5, ..base },
    ]
};

#[test]
fn the_forecast_of_three_sets_is_within_10_percent_of_the_peak() {
    for (trained, size, height) in
        [(8000, [160, 120], 2.5), (40_000, [96, 72], 2.5), (20_000, [320, 240], 1.2)]
    {
        let case = Case { trained, surface: true, size, height, ..CASES[0] };
        let Some(gpu) = device_for_test("the forecast of memory with a water surface") else { return };
        let before = gpu.memory().unwrap().allocated_bytes;
        gpu.reset_peak();
        let mut trainer = SurfaceTrainer::new(Arc::clone(&gpu), case.surface_run()).unwrap();
        trainer.advance(u32::MAX).unwrap();
        assert!(trainer.model().unwrap().len() as u32 > trained * 9 / 10, "the cap is not filled");
        let peak = gpu.memory().unwrap().peak_bytes - before;
        let forecast = case.forecast(&gpu);
        let ratio = forecast.total() as f64 / peak as f64;
        println!("{trained} disks at {size:?}: {ratio:.3}");
        assert!(
            (0.9..=1.1).contains(&ratio),
            "{trained} disks: {} bytes forecast, {peak} at the peak: {ratio:.3}\n{forecast:?}\n{:?}",
            forecast.total(),
            gpu.memory_by_label()
        );
    }
}

#[test]
fn the_forecast_is_within_15_percent_of_six_measured_peaks() {
    for case in CASES {
        // One device per case, because memory in the caches of earlier cases would count.
        let Some(gpu) = device_for_test("the forecast of memory") else { return };
        let before = gpu.memory().unwrap().allocated_bytes;
        gpu.reset_peak();
        let mut trainer = Trainer::new(Arc::clone(&gpu), case.run()).unwrap();
        trainer.advance(u32::MAX).unwrap();
        trainer.gaussians().unwrap();
        let peak = gpu.memory().unwrap().peak_bytes - before;
        let forecast = case.forecast(&gpu);
        let ratio = forecast.total() as f64 / peak as f64;
        println!("{} Gaussians: {ratio:.3}", case.trained);
        assert!(
            (0.85..=1.15).contains(&ratio),
            "{} Gaussians: {} bytes forecast, {peak} at the peak: {ratio:.3}\n{forecast:?}\n{:?}\n{:?}",
            case.trained,
            forecast.total(),
            trainer.memory(),
            gpu.memory_by_label()
        );
    }
}

#[test]
fn the_forecast_sizes_match_the_buffers() {
    for case in CASES {
        let Some(gpu) = device_for_test("the sizes of buffers") else { return };
        let mut trainer = Trainer::new(Arc::clone(&gpu), case.run()).unwrap();
        trainer.advance(1).unwrap();
        let (visible, intersections) = trainer.list_capacities();
        let used = trainer.memory();
        let labels = gpu.memory_by_label().unwrap();
        let of = |names: &[&str]| names.iter().filter_map(|name| labels.get(*name)).sum::<u64>();
        let by_pixel = [
            "image",
            "range image",
            "truth",
            "SSIM moments",
            "SSIM partials",
            "SSIM smoothed",
            "v_image",
            "v_range",
            "exposed",
            "seen",
            "dark channel signal",
            "dark channel rows",
            "dark channel columns",
            "filmed",
            "normal image",
            "gradient of normals",
            "gradient of masks",
            "pixel gradients",
        ];
        let [trained, frozen] = [case.trained, case.frozen].map(u64::from);
        let pixels = u64::from(case.size[0] * case.size[1]);
        let gaussians = trained * memory::trained_bytes(case.sh_degree, case.moments)
            + frozen * memory::frozen_bytes(case.sh_degree);
        for (what, forecast, taken) in [
            ("Gaussians", gaussians, used.gaussians),
            ("flags", (trained + frozen) * memory::FLAG_BYTES, of(&["visible flags"])),
            ("visible", u64::from(visible) * memory::visible_bytes(case.disks), used.per_visible),
            (
                "intersections",
                u64::from(intersections) * memory::intersection_bytes(case.disks),
                used.per_intersection,
            ),
            ("gradients", u64::from(intersections) * memory::slot_bytes(case.disks), of(&["slot gradients"])),
            (
                "pixels",
                pixels * memory::pixel_bytes(Settings::new(&case.config(), &case.water_config())),
                of(&by_pixel),
            ),
        ] {
            // Room for histograms, and for the driver's alignment of buffers.
            let most = forecast + forecast / 100 + 2048;
            assert!(
                (forecast..=most).contains(&taken),
                "{what} of {}: {forecast} forecast, {taken} taken",
                case.trained
            );
        }
    }
}
