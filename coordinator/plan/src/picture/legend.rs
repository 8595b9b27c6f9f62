//! The text beside the map: title, scale, legend, and the table of partitions.

use super::canvas::{Canvas, Pen};
use super::{COLOURS, HELD_OUT, INK, MARGIN, MAX_TABLE, Map, ROW, SOFT, counts};
use crate::geometry::{TurnRule, UpRule};
use crate::plan::Plan;

pub fn draw_title(canvas: &mut Canvas, plan: &Plan, title: &str) {
    canvas.text(title, [MARGIN, 31.0], 17.0, 0.0, INK);
    let (views, held_out) = (plan.views as usize, plan.held_out.len());
    let cut = match (plan.columns, plan.rows) {
        (Some(columns), Some(rows)) => format!("{columns} x {rows} partitions (columns x rows)"),
        _ => format!("{} partitions by recursive cuts", plan.partitions.len()),
    };
    let line = format!(
        "{cut} for {} training views, {} held out, {}",
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
pub fn draw_scale(canvas: &mut Canvas, map: &Map) {
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
pub fn round_length(longest: f64) -> f64 {
    let power = 10f64.powf(longest.max(1e-12).log10().floor());
    [5.0, 2.0, 1.0].map(|digit| digit * power).into_iter().find(|&l| l <= longest).unwrap_or(power)
}

pub fn draw_legend(canvas: &mut Canvas, map: &Map, plan: &Plan) {
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
    for line in words(plan) {
        canvas.text(&line, [x, y], 10.0, 0.0, SOFT);
        y += 20.0;
    }
    draw_table(canvas, map, plan, x, y + 16.0);
}

fn at_baseline([x, y]: [f32; 2]) -> [f32; 2] {
    [x, y + 5.0]
}

/// Orientation of the scene, its cut, and the balance.
fn words(plan: &Plan) -> Vec<String> {
    let rule = match plan.alignment.rule {
        UpRule::MeanCameraDown => "down: mean of the cameras' down",
        UpRule::CentrePlane => "down: normal of the camera centres",
        UpRule::ViewingDirection => "down: mean viewing direction",
        UpRule::WorldY => "down: the world's y (no evidence)",
    };
    let [x, y, z] = plan.alignment.down;
    // Adding 0.0 makes a negative zero positive.
    let axis = |v: f64| (v * 1000.0).round() / 1000.0 + 0.0;
    let turn = plan.alignment.turn;
    let turned = match turn.rule {
        TurnRule::CompactCells => format!("turned by {:.1} degrees: compact cells", turn.degrees),
        TurnRule::SmallGain => "not turned: it would gain little".to_owned(),
        TurnRule::Ambiguous => "not turned: no main direction".to_owned(),
        TurnRule::NoExtent => "not turned: cameras in one place".to_owned(),
        TurnRule::Off => "not turned: partition.rotate is off".to_owned(),
    };
    let mut words =
        vec![rule.to_owned(), format!("in world axes: {:.3} {:.3} {:.3}", axis(x), axis(y), axis(z)), turned];
    if plan.partitions.len() > 1 {
        let balance = plan.balance;
        words.push(format!("largest / mean: cameras {:.2}, points {:.2}", balance.cameras, balance.points));
        words.push(format!("forecast time {:.2}, memory {:.2}", balance.seconds, balance.bytes));
    }
    words
}

/// One row a partition: cameras, points, and its share of the time and its memory by the forecast.
fn draw_table(canvas: &mut Canvas, map: &Map, plan: &Plan, x: f32, top: f32) {
    let columns = [x + 38.0, x + 118.0, x + 206.0, x + 282.0, x + 354.0];
    let heads = ["id", "cameras", "points", "time", "memory"];
    for (head, right) in heads.iter().zip(columns) {
        canvas.text(head, [right, top], 9.5, 1.0, SOFT);
    }
    let mut y = top + 9.0;
    canvas.polylines(&[vec![[x, y], [columns[4], y]]], Pen::solid(SOFT, 1.0));
    let room = ((map.height as f32 - y - 30.0) / ROW).max(1.0) as usize;
    let shown = plan.partitions.len().min(room).min(MAX_TABLE);
    let seconds: f64 = plan.partitions.iter().map(|partition| partition.forecast.seconds).sum();
    for partition in &plan.partitions[..shown] {
        y += ROW;
        canvas.discs(&[[x + 5.0, y - 4.5]], 5.0, map.colour(partition), 1.0);
        let cells = [
            partition.id.to_string(),
            counts(partition),
            short(partition.focus_points),
            format!("{:.1} %", 100.0 * partition.forecast.seconds / seconds.max(f64::MIN_POSITIVE)),
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
pub fn grouped(number: usize) -> String {
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
        1_000..10_000 => format!("{:.1} k", number as f64 / 1e3),
        10_000..1_000_000 => format!("{} k", number / 1_000),
        _ => format!("{:.2} M", number as f64 / 1e6),
    }
}
