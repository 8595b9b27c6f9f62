//! `plan.png`: the plan from above, so that a person sees at a glance who trains what.
//!
//! The aligned x axis points right and z up the page, which is the view of a map (y points into it). The
//! same plan gives the same bytes. Text is drawn by `text`, shapes by `canvas`.

mod canvas;
mod text;

use fathom_core::scene::Points;
use fathom_core::views::TrainView;
use glam::DVec3;

use super::plan::{Interval, Partition, Plan, Rect, UpRule};
use canvas::{Canvas, Pen, Rgb};

const WIDTH: u32 = 1640;
/// Width of the column of words at the right.
const LEGEND: f32 = 400.0;
const MARGIN: f32 = 28.0;
const TITLE: f32 = 64.0;
/// Height below the map for the scale bar.
const FOOT: f32 = 84.0;
const INK: Rgb = [38, 45, 54];
const SOFT: Rgb = [110, 120, 132];
const HELD_OUT: Rgb = [20, 20, 20];
/// Okabe and Ito's colours without yellow, which is too light on white, and three more.
const COLOURS: [Rgb; 9] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 148, 108],
    [190, 85, 145],
    [219, 148, 0],
    [62, 160, 220],
    [130, 80, 60],
    [92, 86, 190],
    [122, 140, 44],
];
/// Most sparse points that are drawn; more only make the ground grey.
const MAX_POINTS: usize = 20_000;
/// Height of a row of the table of partitions.
const ROW: f32 = 18.0;
/// Rows of that table before it is cut short.
const MAX_TABLE: usize = 32;

/// Draws `plan` as a PNG. `views` and `points` are those that it was made from; `title` names the scene.
///
/// # Errors
/// When the picture cannot be encoded.
pub fn draw(plan: &Plan, views: &[TrainView], points: &Points, title: &str) -> Result<Vec<u8>, String> {
    let map = Map::new(plan, views);
    let mut canvas =
        Canvas::new(WIDTH, map.height).ok_or_else(|| "the picture does not fit in memory".to_owned())?;
    draw_ground(&mut canvas, &map, plan, points);
    draw_cells(&mut canvas, &map, plan);
    draw_cameras(&mut canvas, &map, plan, views);
    draw_labels(&mut canvas, &map, plan);
    draw_frame(&mut canvas, &map);
    draw_title(&mut canvas, plan, title);
    draw_scale(&mut canvas, &map);
    draw_legend(&mut canvas, &map, plan);
    canvas.encode()
}

/// From the aligned plane to pixels.
struct Map {
    /// Left, top, right, bottom of the map, pixels.
    frame: [f32; 4],
    /// Height of the whole picture.
    height: u32,
    /// Aligned x and z at the middle of the map.
    middle: [f64; 2],
    pixels_per_unit: f64,
    /// Radius of a camera's dot.
    dot: f32,
}

impl Map {
    fn new(plan: &Plan, views: &[TrainView]) -> Self {
        let mut x = (plan.extent.cameras.min[0], plan.extent.cameras.max[0]);
        let mut z = (plan.extent.cameras.min[2], plan.extent.cameras.max[2]);
        let mut include = |lo: [f64; 2], hi: [f64; 2]| {
            x = (x.0.min(lo[0]), x.1.max(hi[0]));
            z = (z.0.min(lo[1]), z.1.max(hi[1]));
        };
        for partition in &plan.partitions {
            let (min, max) = (partition.extended_box.min, partition.extended_box.max);
            include([min[0], min[2]], [max[0], max[2]]);
        }
        for view in views {
            let at = aligned_centre(plan, view);
            include([at.x, at.z], [at.x, at.z]);
        }
        let sides = [(x.1 - x.0).max(1e-9) * 1.03, (z.1 - z.0).max(1e-9) * 1.03];
        let width = f64::from(WIDTH as f32 - LEGEND - 2.0 * MARGIN);
        // A long, narrow scene still gets a map as high as the words beside it.
        let words = 260.0 + f64::from(ROW) * plan.partitions.len().min(MAX_TABLE) as f64;
        let map_height = (width * sides[1] / sides[0]).clamp(words.max(480.0), 1240.0);
        let bottom = TITLE + map_height as f32;
        let count = plan.views.max(1) as f32;
        Self {
            frame: [MARGIN, TITLE, MARGIN + width as f32, bottom],
            height: (bottom + FOOT) as u32,
            middle: [(x.0 + x.1) / 2.0, (z.0 + z.1) / 2.0],
            pixels_per_unit: (width / sides[0]).min(map_height / sides[1]),
            dot: (110.0 / count.sqrt()).clamp(1.7, 5.0),
        }
    }

    fn pixel(&self, aligned: DVec3) -> [f32; 2] {
        [self.pixel_x(aligned.x), self.pixel_z(aligned.z)]
    }

    fn pixel_x(&self, x: f64) -> f32 {
        let middle = (self.frame[0] + self.frame[2]) / 2.0;
        middle + ((x - self.middle[0]) * self.pixels_per_unit) as f32
    }

    fn pixel_z(&self, z: f64) -> f32 {
        let middle = (self.frame[1] + self.frame[3]) / 2.0;
        middle - ((z - self.middle[1]) * self.pixels_per_unit) as f32
    }

    /// Left, top, right, bottom of a rectangle; open sides end at the frame.
    fn rect(&self, rect: &Rect) -> [f32; 4] {
        let [left, top, right, bottom] = self.frame;
        let x = |side: Option<f64>, open: f32| side.map_or(open, |x| self.pixel_x(x)).clamp(left, right);
        let z = |side: Option<f64>, open: f32| side.map_or(open, |z| self.pixel_z(z)).clamp(top, bottom);
        [x(rect.x.lo, left), z(rect.z.hi, top), x(rect.x.hi, right), z(rect.z.lo, bottom)]
    }

    fn holds(&self, [x, y]: [f32; 2]) -> bool {
        let [left, top, right, bottom] = self.frame;
        (left..=right).contains(&x) && (top..=bottom).contains(&y)
    }
}

fn aligned_centre(plan: &Plan, view: &TrainView) -> DVec3 {
    plan.alignment.rotation() * view.pose.centre()
}

/// Neighbours on all sides differ, since their numbers differ by 1 to 4 modulo 9; up to 3x3 all do.
fn colour(partition: &Partition) -> Rgb {
    COLOURS[(partition.row as usize + 3 * partition.column as usize) % COLOURS.len()]
}

fn draw_ground(canvas: &mut Canvas, map: &Map, plan: &Plan, points: &Points) {
    canvas.fill_rect(map.frame, [247, 249, 250], 1.0);
    for partition in &plan.partitions {
        canvas.fill_rect(map.rect(&partition.cell), colour(partition), 0.09);
    }
    let step = points.positions.len().div_ceil(MAX_POINTS).max(1);
    let dots: Vec<[f32; 2]> = points
        .positions
        .iter()
        .step_by(step)
        .map(|&p| plan.alignment.to_aligned(p))
        .filter(|p| p.is_finite())
        .map(|p| map.pixel(p))
        .filter(|&p| map.holds(p))
        .collect();
    canvas.discs(&dots, 1.0, [150, 158, 166], 0.4);
}

fn draw_cells(canvas: &mut Canvas, map: &Map, plan: &Plan) {
    for partition in &plan.partitions {
        canvas.stroke_rect(map.rect(&partition.cell), Pen::solid([90, 98, 108], 1.5));
    }
    for partition in &plan.partitions {
        let bounds = &partition.extended_box;
        let side = |axis: usize| Interval { lo: Some(bounds.min[axis]), hi: Some(bounds.max[axis]) };
        let rect = map.rect(&Rect { x: side(0), z: side(2) });
        canvas.stroke_rect(rect, Pen { colour: colour(partition), alpha: 0.75, width: 1.4, dash: 7.0 });
    }
}

fn draw_cameras(canvas: &mut Canvas, map: &Map, plan: &Plan, views: &[TrainView]) {
    let rotation = plan.alignment.rotation();
    canvas.polylines(
        &paths(map, plan, views),
        Pen { colour: [120, 128, 138], alpha: 0.55, width: 1.0, dash: 0.0 },
    );
    let tick = |view: &TrainView| {
        let from = map.pixel(aligned_centre(plan, view));
        let ahead = rotation * view.pose.forward();
        let length = 4.2 * map.dot;
        vec![from, [from[0] + ahead.x as f32 * length, from[1] - ahead.z as f32 * length]]
    };
    for partition in &plan.partitions {
        let own = || partition.base_views.iter().filter_map(|&i| views.get(i as usize));
        let ticks: Vec<Vec<[f32; 2]>> = own().map(tick).collect();
        let dots: Vec<[f32; 2]> = own().map(|view| map.pixel(aligned_centre(plan, view))).collect();
        let pen = Pen { colour: colour(partition), alpha: 0.6, width: (map.dot * 0.5).max(1.0), dash: 0.0 };
        canvas.polylines(&ticks, pen);
        canvas.discs(&dots, map.dot, colour(partition), 1.0);
    }
    let held_out = || plan.held_out.iter().filter_map(|&i| views.get(i as usize));
    let rings: Vec<[f32; 2]> = held_out().map(|view| map.pixel(aligned_centre(plan, view))).collect();
    canvas.discs(&rings, map.dot, [255, 255, 255], 1.0);
    canvas.rings(&rings, map.dot, Pen::solid(HELD_OUT, (map.dot * 0.45).max(0.9)));
}

/// Lines through the centres of consecutive views, broken where the camera jumps: where a step is ten
/// times the median one.
fn paths(map: &Map, plan: &Plan, views: &[TrainView]) -> Vec<Vec<[f32; 2]>> {
    let centres: Vec<DVec3> = views.iter().map(|view| aligned_centre(plan, view)).collect();
    let mut steps: Vec<f64> = centres.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
    steps.sort_unstable_by(f64::total_cmp);
    let longest = 10.0 * steps.get(steps.len() / 2).copied().unwrap_or(0.0);
    let mut lines: Vec<Vec<[f32; 2]>> = Vec::new();
    for (i, &centre) in centres.iter().enumerate() {
        let jumps = i == 0 || centres[i - 1].distance(centre) > longest;
        match lines.last_mut() {
            Some(line) if !jumps => line.push(map.pixel(centre)),
            _ => lines.push(vec![map.pixel(centre)]),
        }
    }
    lines
}

/// The number of each partition and of its cameras, in the middle of its cell.
fn draw_labels(canvas: &mut Canvas, map: &Map, plan: &Plan) {
    for partition in &plan.partitions {
        let [left, top, right, bottom] = map.rect(&partition.cell);
        let name = format!("{}", partition.id);
        let counts = format!("{} + {}", partition.base_views.len(), others(partition));
        let (width, height) = (right - left, bottom - top);
        let [x, y] = [(left + right) / 2.0, (top + bottom) / 2.0];
        let half = text::width(&counts, 10.0).max(text::width(&name, 15.0)) / 2.0 + 9.0;
        if width > 2.0 * half + 6.0 && height > 62.0 {
            let pill = [x - half, y - 26.0, x + half, y + 24.0];
            canvas.fill_rect(pill, [255, 255, 255], 0.88);
            canvas.stroke_rect(pill, Pen::solid(colour(partition), 1.6));
            canvas.text(&name, [x, y - 2.0], 15.0, 0.5, INK);
            canvas.text(&counts, [x, y + 15.0], 10.0, 0.5, INK);
        } else if width > text::width(&name, 10.0) + 8.0 && height > 20.0 {
            let half = text::width(&name, 10.0) / 2.0 + 4.0;
            canvas.fill_rect([x - half, y - 9.0, x + half, y + 9.0], [255, 255, 255], 0.88);
            canvas.text(&name, [x, y + 5.0], 10.0, 0.5, INK);
        }
    }
}

/// Chosen cameras that are not its own.
fn others(partition: &Partition) -> usize {
    partition.chosen_views.len() - partition.base_views.len()
}

/// Wipes what reaches beyond the map and frames it.
fn draw_frame(canvas: &mut Canvas, map: &Map) {
    let [left, top, right, bottom] = map.frame;
    let (width, height) = (WIDTH as f32, map.height as f32);
    let white = [255, 255, 255];
    canvas.fill_rect([0.0, 0.0, width, top], white, 1.0);
    canvas.fill_rect([0.0, bottom, width, height], white, 1.0);
    canvas.fill_rect([0.0, top, left, bottom], white, 1.0);
    canvas.fill_rect([right, top, width, bottom], white, 1.0);
    canvas.stroke_rect(map.frame, Pen::solid(INK, 2.0));
}

fn draw_title(canvas: &mut Canvas, plan: &Plan, title: &str) {
    canvas.text(title, [MARGIN, 31.0], 17.0, 0.0, INK);
    let (views, held_out) = (plan.views as usize, plan.held_out.len());
    let line = format!(
        "{} x {} partitions (columns x rows) for {} training views, {} held out, {}",
        plan.columns,
        plan.rows,
        grouped(views - held_out),
        grouped(held_out),
        match plan.points {
            0 => "no sparse points".to_owned(),
            count => format!("{} sparse points", grouped(count as usize)),
        },
    );
    canvas.text(&line, [MARGIN, 53.0], 10.5, 0.0, SOFT);
}

/// A bar of a round length, and the axes.
fn draw_scale(canvas: &mut Canvas, map: &Map) {
    let [left, _, right, bottom] = map.frame;
    let longest = f64::from(right - left) * 0.24 / map.pixels_per_unit;
    let length = round_length(longest);
    let pixels = (length * map.pixels_per_unit) as f32;
    let y = bottom + 32.0;
    let x = left + 150.0;
    let pen = Pen::solid(INK, 2.4);
    canvas.polylines(
        &[
            vec![[x, y], [x + pixels, y]],
            vec![[x, y - 6.0], [x, y + 6.0]],
            vec![[x + pixels, y - 6.0], [x + pixels, y + 6.0]],
        ],
        pen,
    );
    canvas.text(&format!("{length} scene units"), [x + pixels / 2.0, y + 25.0], 11.5, 0.5, INK);

    let (x, y) = (left + 12.0, bottom + 62.0);
    let pen = Pen::solid(INK, 2.0);
    canvas.polylines(
        &[
            vec![[x, y - 44.0], [x, y], [x + 44.0, y]],
            vec![[x - 5.0, y - 37.0], [x, y - 44.0], [x + 5.0, y - 37.0]],
            vec![[x + 37.0, y - 5.0], [x + 44.0, y], [x + 37.0, y + 5.0]],
        ],
        pen,
    );
    canvas.text("x", [x + 52.0, y + 4.0], 11.5, 0.0, INK);
    canvas.text("z", [x + 10.0, y - 36.0], 11.5, 0.0, INK);
    canvas.text("seen from above", [right, bottom + 36.0], 10.5, 1.0, SOFT);
}

/// The largest of 1, 2 and 5 times a power of ten that is at most `longest`.
fn round_length(longest: f64) -> f64 {
    let power = 10f64.powf(longest.max(1e-12).log10().floor());
    [5.0, 2.0, 1.0].map(|digit| digit * power).into_iter().find(|&l| l <= longest).unwrap_or(power)
}

fn draw_legend(canvas: &mut Canvas, map: &Map, plan: &Plan) {
    let x = map.frame[2] + 26.0;
    let mut y = map.frame[1] + 14.0;
    let blue = COLOURS[0];
    let mark = [x + 18.0, 0.0];
    for entry in 0..7 {
        let at = [mark[0], y - 5.0];
        let words = match entry {
            0 => {
                canvas.polylines(
                    &[vec![at, [at[0] + 16.0, at[1]]]],
                    Pen { alpha: 0.6, ..Pen::solid(blue, 2.2) },
                );
                canvas.discs(&[at], 4.5, blue, 1.0);
                "camera and where it looks"
            }
            1 => {
                canvas.rings(&[at], 4.5, Pen::solid(HELD_OUT, 1.8));
                "held-out view, in no partition"
            }
            2 => {
                let line = vec![[x, at[1]], [x + 36.0, at[1]]];
                canvas.polylines(&[line], Pen { alpha: 0.55, ..Pen::solid([120, 128, 138], 1.4) });
                "path of the camera"
            }
            3 => {
                let swatch = [x, at[1] - 8.0, x + 36.0, at[1] + 8.0];
                canvas.fill_rect(swatch, blue, 0.12);
                canvas.stroke_rect(swatch, Pen::solid([90, 98, 108], 1.5));
                "cell: kept at the merge"
            }
            4 => {
                let swatch = [x, at[1] - 8.0, x + 36.0, at[1] + 8.0];
                canvas.stroke_rect(swatch, Pen { colour: blue, alpha: 0.75, width: 1.5, dash: 6.0 });
                "extended box: trained"
            }
            5 => {
                let dots = [-12.0, -3.0, 4.0, 13.0].map(|dx| [at[0] + dx, at[1] + dx % 5.0]);
                canvas.discs(&dots, 1.2, [150, 158, 166], 0.9);
                "sparse points"
            }
            _ => {
                canvas.text("5 + 7", at_baseline(at), 10.0, 0.5, INK);
                "own cameras + others that see it"
            }
        };
        canvas.text(words, [x + 52.0, y], 10.5, 0.0, INK);
        y += 27.0;
    }
    y += 6.0;
    for line in up_words(plan) {
        canvas.text(&line, [x, y], 10.0, 0.0, SOFT);
        y += 20.0;
    }
    draw_table(canvas, map, plan, x, y + 16.0);
}

fn at_baseline([x, y]: [f32; 2]) -> [f32; 2] {
    [x, y + 5.0]
}

fn up_words(plan: &Plan) -> [String; 2] {
    let rule = match plan.alignment.rule {
        UpRule::MeanCameraDown => "down: mean of the cameras' down",
        UpRule::CentrePlane => "down: normal of the camera centres",
        UpRule::ViewingDirection => "down: mean viewing direction",
        UpRule::WorldY => "down: the world's y (no evidence)",
    };
    let [x, y, z] = plan.alignment.down;
    // Adding 0.0 makes a negative zero positive.
    let axis = |v: f64| (v * 1000.0).round() / 1000.0 + 0.0;
    [rule.to_owned(), format!("in world axes: {:.3} {:.3} {:.3}", axis(x), axis(y), axis(z))]
}

/// One row a partition: cameras, iterations, cap and forecast.
fn draw_table(canvas: &mut Canvas, map: &Map, plan: &Plan, x: f32, top: f32) {
    let columns = [x + 38.0, x + 118.0, x + 206.0, x + 282.0, x + 354.0];
    let heads = ["id", "cameras", "iterations", "cap", "memory"];
    for (head, right) in heads.iter().zip(columns) {
        canvas.text(head, [right, top], 9.5, 1.0, SOFT);
    }
    let mut y = top + 9.0;
    canvas.polylines(&[vec![[x, y], [columns[4], y]]], Pen::solid(SOFT, 1.0));
    let room = ((map.height as f32 - y - 30.0) / ROW).max(1.0) as usize;
    let shown = plan.partitions.len().min(room).min(MAX_TABLE);
    for partition in &plan.partitions[..shown] {
        y += ROW;
        canvas.discs(&[[x + 5.0, y - 4.5]], 5.0, colour(partition), 1.0);
        let cells = [
            partition.id.to_string(),
            format!("{} + {}", partition.base_views.len(), others(partition)),
            grouped(partition.iterations as usize),
            short(partition.max_gaussians.into()),
            format!("{} MB", partition.forecast.bytes.div_ceil(1_000_000)),
        ];
        for (cell, right) in cells.iter().zip(columns) {
            canvas.text(cell, [right, y], 9.5, 1.0, INK);
        }
    }
    if shown < plan.partitions.len() {
        let rest = format!("and {} more: see plan.json", plan.partitions.len() - shown);
        canvas.text(&rest, [x, y + 22.0], 9.5, 0.0, SOFT);
    }
}

/// 1234567 as 1,234,567.
fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// Three digits and k or M.
fn short(number: u64) -> String {
    match number {
        0..1_000 => number.to_string(),
        1_000..1_000_000 => format!("{} k", number / 1_000),
        _ => format!("{:.2} M", number as f64 / 1e6),
    }
}

#[cfg(test)]
mod tests;
