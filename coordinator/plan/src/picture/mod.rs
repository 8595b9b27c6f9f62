//! `plan.png` draws the plan from above, so that each partition's share is visible at a glance.
//!
//! The aligned x axis points right and z up the page, which is the view of a map (y points into it). The
//! same plan gives the same bytes. Text is drawn by `text`, shapes by `canvas`.

mod canvas;
mod legend;
mod text;

use fathom_core::scene::Points;
use fathom_core::views::TrainView;
use glam::DVec3;

use super::geometry::{Interval, Rect};
use super::plan::{Partition, Plan};
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
    draw_labels(&mut canvas, &map, plan, views);
    draw_frame(&mut canvas, &map);
    legend::draw_title(&mut canvas, plan, title);
    legend::draw_scale(&mut canvas, &map);
    legend::draw_legend(&mut canvas, &map, plan);
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
    /// Of each partition.
    colours: Vec<Rgb>,
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
        let words = 330.0 + f64::from(ROW) * plan.partitions.len().min(MAX_TABLE) as f64;
        let map_height = (width * sides[1] / sides[0]).clamp(words.max(480.0), 1240.0);
        let bottom = TITLE + map_height as f32;
        let count = plan.views.max(1) as f32;
        Self {
            frame: [MARGIN, TITLE, MARGIN + width as f32, bottom],
            height: (bottom + FOOT) as u32,
            middle: [(x.0 + x.1) / 2.0, (z.0 + z.1) / 2.0],
            pixels_per_unit: (width / sides[0]).min(map_height / sides[1]),
            dot: (110.0 / count.sqrt()).clamp(1.7, 5.0),
            colours: colours(plan),
        }
    }

    fn colour(&self, partition: &Partition) -> Rgb {
        self.colours.get(partition.id.0 as usize).copied().unwrap_or(INK)
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

/// A colour for each partition, so that neighbours differ.
fn colours(plan: &Plan) -> Vec<Rgb> {
    let mut numbers: Vec<usize> = Vec::with_capacity(plan.partitions.len());
    for partition in &plan.partitions {
        let number = match (partition.column, partition.row) {
            // Numbers of neighbours on all sides differ by 1 to 4 modulo 9; up to 3x3 all do.
            (Some(column), Some(row)) => row as usize + 3 * column as usize,
            _ => {
                let of_neighbours: Vec<usize> = plan
                    .neighbours(partition.id)
                    .iter()
                    .filter_map(|id| numbers.get(id.0 as usize).copied())
                    .collect();
                let first = partition.id.0 as usize;
                let free = |number: &usize| !of_neighbours.contains(&(number % COLOURS.len()));
                (first..first + COLOURS.len()).find(free).unwrap_or(first)
            }
        };
        numbers.push(number % COLOURS.len());
    }
    numbers.into_iter().map(|number| COLOURS[number]).collect()
}

fn draw_ground(canvas: &mut Canvas, map: &Map, plan: &Plan, points: &Points) {
    canvas.fill_rect(map.frame, [247, 249, 250], 1.0);
    for partition in &plan.partitions {
        canvas.fill_rect(map.rect(&partition.cell), map.colour(partition), 0.09);
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
        canvas.stroke_rect(rect, Pen { colour: map.colour(partition), alpha: 0.75, width: 1.4, dash: 7.0 });
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
        let pen =
            Pen { colour: map.colour(partition), alpha: 0.6, width: (map.dot * 0.5).max(1.0), dash: 0.0 };
        canvas.polylines(&ticks, pen);
        canvas.discs(&dots, map.dot, map.colour(partition), 1.0);
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

/// The number of each partition and of its cameras, in its cell where the fewest cameras are hidden.
fn draw_labels(canvas: &mut Canvas, map: &Map, plan: &Plan, views: &[TrainView]) {
    let cameras: Vec<[f32; 2]> = views.iter().map(|view| map.pixel(aligned_centre(plan, view))).collect();
    for partition in &plan.partitions {
        let cell @ [left, top, right, bottom] = map.rect(&partition.cell);
        let name = format!("{}", partition.id);
        let counts = counts(partition);
        let (width, height) = (right - left, bottom - top);
        let half = text::width(&counts, 10.0).max(text::width(&name, 15.0)) / 2.0 + 9.0;
        if width > 2.0 * half + 6.0 && height > 62.0 {
            let [x, y] = quiet_place(cell, [half, 26.0], &cameras);
            let pill = [x - half, y - 26.0, x + half, y + 24.0];
            canvas.fill_rect(pill, [255, 255, 255], 0.88);
            canvas.stroke_rect(pill, Pen::solid(map.colour(partition), 1.6));
            canvas.text(&name, [x, y - 2.0], 15.0, 0.5, INK);
            canvas.text(&counts, [x, y + 15.0], 10.0, 0.5, INK);
        } else if width > text::width(&name, 10.0) + 8.0 && height > 20.0 {
            let half = text::width(&name, 10.0) / 2.0 + 4.0;
            let [x, y] = quiet_place(cell, [half, 9.0], &cameras);
            canvas.fill_rect([x - half, y - 9.0, x + half, y + 9.0], [255, 255, 255], 0.88);
            canvas.text(&name, [x, y + 5.0], 10.0, 0.5, INK);
        }
    }
}

/// The middle of a label of twice `half` in a cell, where it hides the fewest cameras; of several such places
/// the one nearest to the middle of the cell.
fn quiet_place([left, top, right, bottom]: [f32; 4], half: [f32; 2], cameras: &[[f32; 2]]) -> [f32; 2] {
    const PLACES: i16 = 9;
    let inside = |p: &&[f32; 2]| p[0] >= left && p[0] <= right && p[1] >= top && p[1] <= bottom;
    let cameras: Vec<[f32; 2]> = cameras.iter().filter(inside).copied().collect();
    let place =
        |share: f32, lo: f32, hi: f32, half: f32| (lo + hi) / 2.0 + share * ((hi - lo) / 2.0 - half - 3.0);
    let shares = || (-PLACES..=PLACES).map(|step| f32::from(step) / f32::from(PLACES));
    let places = shares().flat_map(|x| shares().map(move |y| [x, y]));
    let hidden = |[x, y]: [f32; 2]| {
        let covered = |p: &&[f32; 2]| (p[0] - x).abs() < half[0] + 3.0 && (p[1] - y).abs() < half[1] + 3.0;
        cameras.iter().filter(covered).count()
    };
    let best = places
        .map(|[x, y]| ([place(x, left, right, half[0]), place(y, top, bottom, half[1])], x.hypot(y)))
        .map(|(at, off)| (hidden(at), off, at))
        .min_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    best.map_or([(left + right) / 2.0, (top + bottom) / 2.0], |(_, _, at)| at)
}

/// Chosen cameras: its own, and others. By contribution not all of its own need be chosen.
fn counts(partition: &Partition) -> String {
    let is_own = |view: &&u32| partition.base_views.binary_search(view).is_ok();
    let own = partition.chosen_views.iter().filter(is_own).count();
    format!("{own} + {}", partition.chosen_views.len() - own)
}

/// Clears everything drawn outside the map, and frames the map.
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

#[cfg(test)]
mod tests;
