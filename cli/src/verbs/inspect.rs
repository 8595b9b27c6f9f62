//! `fathom inspect`: shows a scene and its plan of partitions without training.

use std::path::PathBuf;

use clap::Args;
use fathom_core::config::TrainConfig;
use fathom_core::cover::predicted_unseen;
use fathom_core::scene::{Purpose, Scene, load_scene};
use fathom_core::views::TrainView;
use fathom_plan::{Balance, Forecast, Plan, PlanInput, TurnRule, picture, plan};
use serde_json::{Value, json};

use crate::config_args::JobArgs;
use crate::error::{CliError, Result};
use crate::output;

/// Above this share of `unseen`, metrics depend more on the choice of views than on the model.
const MUCH_UNSEEN: f64 = 0.05;

/// Arguments of `fathom inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// Scene: a folder with sparse/0, a transforms.json, or a cameras.json
    #[arg(value_name = "DATA")]
    data: PathBuf,
    #[command(flatten)]
    job: JobArgs,
    /// File for the picture of the plan: cameras, cells and boxes on the horizontal plane
    #[arg(long, value_name = "FILE", default_value = "plan.png")]
    plan: PathBuf,
    /// Do not draw the plan
    #[arg(long, conflicts_with = "plan")]
    no_plan: bool,
    /// Print cameras, images, points, extent and the plan as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: InspectArgs) -> Result<()> {
    let config = args.job.resolve()?;
    let scene = load_scene(&args.data, Purpose::Inspect, &config.data)?;
    let views = full_size_views(&scene)?;
    let plan = plan(&PlanInput { views: &views, points: &scene.points, config: &config })
        .map_err(|error| CliError::Message(format!("{}: {error}", args.data.display())))?;
    if !args.no_plan {
        let title = super::submit::folder_name(&args.data);
        let png = picture::draw(&plan, &views, &scene.points, &title)
            .map_err(|error| CliError::Message(format!("the picture of the plan: {error}")))?;
        std::fs::write(&args.plan, png).map_err(CliError::io("write", &args.plan))?;
    }
    let cameras: Vec<_> = views.iter().map(|view| (view.camera, view.pose)).collect();
    let unseen = predicted_unseen(&cameras, &plan.held_out, &scene.points);
    if args.json {
        return output::json(&as_json(&scene, &plan, &config.train, unseen)?);
    }
    for text in describe(&scene, &plan, &config.train, unseen) {
        output::lines(text);
    }
    if !args.no_plan {
        output::line(format!("picture of the plan: {}", args.plan.display()));
    }
    Ok(())
}

/// All views with their undistorted cameras at full size, as input of the plan.
fn full_size_views(scene: &Scene) -> Result<Vec<TrainView>> {
    scene
        .views
        .iter()
        .map(|view| {
            let camera = scene.camera(view.camera_id).ok_or_else(|| {
                CliError::Message(format!("{}: view {} has no camera", scene.root.display(), view.name))
            })?;
            Ok(TrainView {
                name: view.name.clone(),
                camera: camera.pinhole()?,
                pose: view.pose,
                clear_range: 0.0,
            })
        })
        .collect()
}

fn describe(scene: &Scene, plan: &Plan, train: &TrainConfig, unseen: Option<f64>) -> Vec<String> {
    let with_image = scene.views.iter().filter(|view| view.image.is_some()).count();
    let with_mask = scene.views.iter().filter(|view| view.mask.is_some()).count();
    let mut lines = vec![
        format!("{}: {}", scene.root.display(), scene.source),
        format!(
            "{} views ({with_image} with photographs, {with_mask} with masks, {} held out), {} cameras, {} sparse points",
            scene.views.len(),
            plan.held_out.len(),
            scene.cameras.len(),
            scene.points.len()
        ),
    ];
    for camera in scene.cameras.iter().take(5) {
        lines.push(format!(
            "camera {}: {:?}, {}x{}, {:?}",
            camera.id, camera.model, camera.width, camera.height, camera.params
        ));
    }
    if scene.cameras.len() > 5 {
        lines.push(format!("and {} more cameras (--json lists all)", scene.cameras.len() - 5));
    }
    lines.extend(unseen.map(|share| {
        format!(
            "held-out views: {:.1} % of their area near sparse points is in fewer than two training views",
            100.0 * share
        )
    }));
    let size = plan.extent.cameras;
    lines.push(format!(
        "cameras spread over {:.4} x {:.4} scene units, {:.4} from highest to lowest; down is {:.3?} ({:?})",
        size.side(0),
        size.side(2),
        size.side(1),
        plan.alignment.down,
        plan.alignment.rule
    ));
    lines.push(turn(plan));
    lines.push(match (plan.columns, plan.rows) {
        (Some(columns), Some(rows)) => format!("plan: {columns} x {rows} partitions"),
        _ => format!("plan: {} partitions by recursive cuts", plan.partitions.len()),
    });
    if plan.cut.planned_for.is_some() {
        lines.push(format!("  {}", plan.cut.reason));
    }
    if plan.partitions.len() > 1 {
        let Balance { cameras, points, seconds, bytes } = plan.balance;
        lines.push(format!(
            "  largest / mean: cameras {cameras:.2}, points {points:.2}, time {seconds:.2}, memory {bytes:.2}"
        ));
    }
    if let Some(global) = &plan.global {
        lines.push(format!(
            "  coarse model: {} iterations, up to {} Gaussians, {}",
            global.iterations,
            global.max_gaussians,
            forecast(&global.forecast)
        ));
    }
    let seconds: f64 = plan.partitions.iter().map(|partition| partition.forecast.seconds).sum();
    for partition in &plan.partitions {
        lines.push(format!(
            "  {}: {} cameras of its own, {} chosen, {} points, {} iterations, up to {} Gaussians, {:.1} % of the partitions' time, {}",
            partition.id,
            partition.base_views.len(),
            partition.chosen_views.len(),
            partition.focus_points,
            partition.iterations,
            partition.max_gaussians,
            100.0 * partition.forecast.seconds / seconds.max(f64::MIN_POSITIVE),
            forecast(&partition.forecast)
        ));
    }
    if let Some(borders) = &plan.borders {
        lines.push(format!(
            "  borders: {:.4} scene units to each side of {} of them, {} cameras at most, {} iterations, {}",
            borders.width,
            borders.segments.len(),
            borders.views.len(),
            borders.iterations,
            forecast(&borders.forecast)
        ));
    }
    lines.extend(warnings(scene, plan, train, unseen));
    lines
}

/// Rotation about the vertical, and its reason.
fn turn(plan: &Plan) -> String {
    let turn = plan.alignment.turn;
    let share = turn.perimeter_ratio.map_or(String::new(), |ratio| format!("{:.0} %", 100.0 * ratio));
    match turn.rule {
        TurnRule::CompactCells => format!(
            "rotated by {:.2} degrees about the vertical: cells around the cameras have {share} of the \
             perimeter",
            turn.degrees
        ),
        TurnRule::SmallGain => {
            format!(
                "not rotated about the vertical: cells around the cameras would have {share} of the perimeter"
            )
        }
        TurnRule::Ambiguous => {
            "not rotated about the vertical: the cameras extend in no direction more than in another"
                .to_owned()
        }
        TurnRule::NoExtent => "not rotated about the vertical: all cameras are in one place".to_owned(),
        TurnRule::Off => "not rotated about the vertical: partition.rotate is off".to_owned(),
    }
}

/// "about 116.2 MB on the GPU (MB: Gaussians 25.2, visible 4.8, intersections 39.7, pictures 34.9, transfers
/// 11.5, measuring 0.0)".
fn forecast(forecast: &Forecast) -> String {
    let parts = &forecast.parts;
    let share = |bytes: u64| format!("{:.1}", bytes as f64 / 1e6);
    format!(
        "about {} on the GPU (MB: Gaussians {}, visible {}, intersections {}, pictures {}, transfers {}, measuring {})",
        output::bytes(forecast.bytes),
        share(parts.gaussians),
        share(parts.per_visible),
        share(parts.per_intersection),
        share(parts.pixels + parts.photographs),
        share(parts.transfers),
        share(parts.measuring)
    )
}

/// Warnings of the scene, of the plan, then of the held-out views.
fn warnings(scene: &Scene, plan: &Plan, train: &TrainConfig, unseen: Option<f64>) -> Vec<String> {
    let extrapolates = unseen.filter(|share| *share > MUCH_UNSEEN).map(|share| {
        format!(
            "{:.1} % of the area of the held-out views is in fewer than two training views: the model can \
             only guess there, and metrics will be low. Hold out fewer views (a larger --test-every), or add \
             overlapping photographs",
            100.0 * share
        )
    });
    scene.warnings.iter().cloned().chain(plan.warnings(train)).chain(extrapolates).collect()
}

fn as_json(scene: &Scene, plan: &Plan, train: &TrainConfig, unseen: Option<f64>) -> Result<Value> {
    let images: Vec<Value> = scene
        .views
        .iter()
        .map(|view| {
            let q = view.pose.rotation;
            json!({
                "name": view.name,
                "camera": view.camera_id,
                "world_to_camera_quat_wxyz": [q.w, q.x, q.y, q.z],
                "world_to_camera_translation": view.pose.translation.to_array(),
                "centre": view.pose.centre().to_array(),
                "image": view.image,
                "mask": view.mask,
            })
        })
        .collect();
    let warnings = warnings(scene, plan, train, unseen);
    let plan = serde_json::to_value(plan).map_err(|error| CliError::Message(format!("the plan: {error}")))?;
    Ok(json!({
        "source": scene.source,
        "root": scene.root,
        "cameras": scene.cameras,
        "images": images,
        "counts": {
            "cameras": scene.cameras.len(),
            "images": scene.views.len(),
            "with_photograph": scene.views.iter().filter(|view| view.image.is_some()).count(),
            "with_mask": scene.views.iter().filter(|view| view.mask.is_some()).count(),
            "points": scene.points.len(),
        },
        "extent": scene.extent(),
        "unseen": unseen,
        "warnings": warnings,
        "plan": plan,
    }))
}
