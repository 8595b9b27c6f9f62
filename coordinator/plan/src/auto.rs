//! `partition.auto` chooses the number and shape of partitions.
//!
//! More partitions need less memory each and can be trained by more workers at a time. But each one trains a
//! margin beside its cell, and more than one needs the coarse model first. So on one worker, a single
//! partition that fits always finishes first. `auto` picks the cut predicted to finish soonest on these
//! workers. Every run must fit the smallest worker, and every cell must have [`MIN_CAMERAS`] cameras of its
//! own.
//!
//! The search cuts the plane in two, then repeatedly the cell with the largest load, by rank across its
//! longer side ([`Node::halves`]). Every state on the way is a candidate. The best one is compared with grids
//! of about as many cells, and a grid that is nearly as good wins, because users expect one. Where cameras
//! are uneven (a dense wreck beside a long transect) a grid is badly balanced, and the recursive cut stays.
//!
//! Time forecasts are only compared with each other: the order does not change when all runs take twice as
//! long.

use fathom_core::config::{DEFAULT_MEMORY_GIB, PartitionConfig};
use rayon::prelude::*;

use crate::cells::{Cell, Centre, Node, cut};
use crate::geometry::Interval;
use crate::plan::{Cut, CutShape, Forecast, MemoryFrom, PlannedFor};
use crate::selection::MIN_CAMERAS;

/// Maximum forecast of a run as a share of a worker's memory: forecasts were up to a tenth too low
/// (bench/history.jsonl).
const USABLE: f64 = 0.9;
/// Most partitions of a job, as in `partition.columns` x `partition.rows`.
const MOST_PARTITIONS: usize = 4096;
/// Maximum partitions per worker to try once all fit: four per worker already balance the work well.
const ENOUGH_A_WORKER: usize = 4;
/// A cut with more partitions must take less than this share of the time of one with fewer.
const SOONER: f64 = 0.95;
/// A cut is useless if a half needs more than this share of the whole's memory: then images take the memory,
/// not the scene.
const SMALLER: f64 = 0.97;
/// A grid may take this many times as long as the recursive cut and is still preferred.
const BADLY: f64 = 1.1;
/// Grids that are tried: those with the most compact cells.
const GRIDS: usize = 4;

/// The workers that are connected when a plan is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Connected {
    /// Those that take partitions.
    pub workers: u32,
    /// The smallest GPU memory that one of them reports, bytes.
    pub memory_bytes: Option<u64>,
}

impl Connected {
    /// The target of the plan: from the configuration, else from these workers, else the defaults.
    pub fn planned_for(self, config: &PartitionConfig) -> PlannedFor {
        let bytes = |gib: f64| (gib * f64::from(1 << 30)) as u64;
        let (memory_bytes, memory_from) = match self.memory_bytes {
            _ if config.memory_gib > 0.0 => (bytes(config.memory_gib), MemoryFrom::Configuration),
            Some(memory) => (memory, MemoryFrom::Workers),
            None => (bytes(DEFAULT_MEMORY_GIB), MemoryFrom::Default),
        };
        let workers = if config.workers > 0 { config.workers } else { self.workers.max(1) };
        PlannedFor { workers, memory_bytes, memory_from }
    }
}

/// Whether a run with a forecast of `bytes` fits a worker with `memory_bytes`.
pub fn fits(bytes: u64, memory_bytes: u64) -> bool {
    bytes as f64 <= USABLE * memory_bytes as f64
}

/// Some cells, and the forecast of their runs.
struct Trial {
    cells: Vec<Cell>,
    /// Forecast time until all workers are done, the coarse model included.
    seconds: f64,
    /// Memory of the largest run.
    bytes: u64,
}

impl Trial {
    /// A trial with these loads; the caller fills in the cells.
    fn of<'a>(loads: impl Iterator<Item = &'a Forecast>, global: &Forecast, workers: u32) -> Self {
        let (seconds, bytes): (Vec<f64>, Vec<u64>) = loads.map(|load| (load.seconds, load.bytes)).unzip();
        let before = if seconds.len() > 1 { global.seconds } else { 0.0 };
        let seconds = before + makespan(seconds, workers);
        Self { cells: Vec::new(), seconds, bytes: bytes.into_iter().max().unwrap_or(0) }
    }
}

/// A cell of the recursive cut, with its forecast.
struct Leaf<'a> {
    node: Node<'a>,
    load: Forecast,
    /// Cutting it in two is impossible or useless.
    stuck: bool,
}

/// Chooses the cut of these cameras. `load` is the forecast of a cell that is one of `count`; `global` that
/// of the coarse model.
pub fn choose(
    centres: Vec<Centre<'_>>,
    planned_for: PlannedFor,
    global: &Forecast,
    load: &(dyn Fn(&Cell, usize) -> Forecast + Sync),
) -> (Vec<Cell>, Cut) {
    let PlannedFor { workers, memory_bytes, .. } = planned_for;
    let fits = |bytes: u64| fits(bytes, memory_bytes);
    let cut_of = |shape, reason| Cut { shape, reason, planned_for: Some(planned_for) };

    let root = Node::root(centres.clone());
    let one = load(&root.cell(), 1);
    let mut first = Trial::of([&one].into_iter(), global, workers);
    first.cells = vec![root.cell()];
    let best = recursive(root, &one, first, planned_for, &fits, global, load);

    if best.cells.len() == 1 {
        let why = if !fits(one.bytes) {
            "and cutting the scene does not reduce that".to_owned()
        } else if workers == 1 {
            "and one worker would not finish sooner with more".to_owned()
        } else {
            format!("and {workers} workers would not finish sooner with more")
        };
        let reason = format!("one partition: its run needs {}, {why}", of_memory(one.bytes, planned_for));
        return (vec![whole(&best)], cut_of(CutShape::Grid, reason));
    }

    let mut why = if fits(one.bytes) {
        format!("one run would need {}", of_memory(one.bytes, planned_for))
    } else {
        format!("one run would need {}, which is too much", of_memory(one.bytes, planned_for))
    };
    let still = if fits(best.bytes) { "" } else { ", which still is" };
    why += &format!(", these at most {}{still}", gib(best.bytes));
    if workers > 1 {
        why += &format!("; {workers} workers finish in {:.2} of its time", best.seconds / one.seconds);
    }
    let grids = grids(&centres, best.cells.len());
    let grids = grids.into_iter().map(|cells| {
        let loads: Vec<Forecast> = cells.par_iter().map(|cell| load(cell, cells.len())).collect();
        Trial { cells, ..Trial::of(loads.iter(), global, workers) }
    });
    let grid = grids
        .filter(|grid| fits(grid.bytes) || !fits(best.bytes))
        .min_by(|a, b| a.seconds.total_cmp(&b.seconds).then(a.cells.len().cmp(&b.cells.len())));
    match grid {
        Some(grid) if grid.seconds <= BADLY * best.seconds => {
            let reason = format!("{}: {why}", size(&grid.cells));
            (grid.cells, cut_of(CutShape::Grid, reason))
        }
        grid => {
            let against = match &grid {
                Some(grid) => format!(
                    "a grid of {} would take {:.2} times as long, because the cameras are uneven",
                    size(&grid.cells),
                    grid.seconds / best.seconds
                ),
                None => "no grid of about as many cells fits".to_owned(),
            };
            let reason = format!("{} cells by recursive cuts: {why}; {against}", best.cells.len());
            (best.cells, cut_of(CutShape::Recursive, reason))
        }
    }
}

/// The cell of the only partition: that of a grid of one.
fn whole(best: &Trial) -> Cell {
    Cell { place: Some((0, 0)), ..best.cells[0].clone() }
}

/// The best of the recursive cuts, one cell included.
fn recursive(
    root: Node<'_>,
    one: &Forecast,
    first: Trial,
    planned_for: PlannedFor,
    fits: &dyn Fn(u64) -> bool,
    global: &Forecast,
    load: &(dyn Fn(&Cell, usize) -> Forecast + Sync),
) -> Trial {
    let workers = planned_for.workers;
    let enough = ENOUGH_A_WORKER * workers as usize;
    let mut best = first;
    let mut leaves = vec![Leaf { node: root, load: one.clone(), stuck: false }];
    while leaves.len() < MOST_PARTITIONS {
        let all_fit = leaves.iter().all(|leaf| fits(leaf.load.bytes));
        if all_fit && (workers == 1 || leaves.len() >= enough) {
            break;
        }
        // First the run that does not fit, then the longest one: cutting another cell does not help while
        // that one stays.
        let heaviest = if all_fit {
            let longest = (0..leaves.len())
                .max_by(|&a, &b| leaves[a].load.seconds.total_cmp(&leaves[b].load.seconds).then(b.cmp(&a)));
            longest.filter(|&at| !leaves[at].stuck)
        } else {
            let too_large = |at: &usize| !leaves[*at].stuck && !fits(leaves[*at].load.bytes);
            (0..leaves.len()).filter(too_large).max_by_key(|&at| (leaves[at].load.bytes, usize::MAX - at))
        };
        let Some(at) = heaviest else { break };
        let Some([low, high]) = leaves[at].node.halves(MIN_CAMERAS) else {
            leaves[at].stuck = true;
            continue;
        };
        let count = leaves.len() + 1;
        let (a, b) = rayon::join(|| load(&low.cell(), count), || load(&high.cell(), count));
        if !all_fit && a.bytes.max(b.bytes) as f64 > SMALLER * leaves[at].load.bytes as f64 {
            leaves[at].stuck = true;
            continue;
        }
        let halves = [(low, a), (high, b)].map(|(node, load)| Leaf { node, load, stuck: false });
        leaves.splice(at..=at, halves);
        let candidate = Trial::of(leaves.iter().map(|leaf| &leaf.load), global, workers);
        let better = match (fits(best.bytes), fits(candidate.bytes)) {
            (true, true) => candidate.seconds < SOONER * best.seconds,
            (is_fit, would_fit) => would_fit || (!is_fit && candidate.bytes < best.bytes),
        };
        if better {
            best = Trial { cells: leaves.iter().map(|leaf| leaf.node.cell()).collect(), ..candidate };
        }
    }
    best
}

/// Grids of about `count` cells, the most compact cells first.
fn grids(centres: &[Centre<'_>], count: usize) -> Vec<Vec<Cell>> {
    let most = (count + count / 4).min(centres.len() / MIN_CAMERAS).min(MOST_PARTITIONS);
    let mut sizes: Vec<(usize, usize)> = (count..=most)
        .flat_map(|cells| (1..=cells).filter(move |m| cells % m == 0).map(move |m| (m, cells / m)))
        .filter(|(columns, rows)| centres.len() / columns / rows >= MIN_CAMERAS)
        .collect();
    let side = |axis: fn(&Centre<'_>) -> f64| {
        let mut at: Vec<f64> = centres.iter().map(axis).collect();
        at.sort_unstable_by(f64::total_cmp);
        let strays = at.len() / 20;
        at.get(at.len() - 1 - strays).zip(at.get(strays)).map_or(0.0, |(hi, lo)| hi - lo)
    };
    let (width, depth) = (side(|c| c.at.x), side(|c| c.at.z));
    let elongation = |&(columns, rows): &(usize, usize)| {
        let ratio = (width / columns as f64) / (depth / rows as f64).max(f64::MIN_POSITIVE);
        ratio.max(1.0 / ratio.max(f64::MIN_POSITIVE))
    };
    sizes.sort_by(|a, b| elongation(a).total_cmp(&elongation(b)).then(a.cmp(b)));
    sizes.truncate(GRIDS);
    let all = sizes.into_iter().map(|(columns, rows)| cut(centres.to_vec(), columns as u32, rows as u32));
    all.filter(|cells| cells.iter().all(|cell| has_width(cell.rect.x) && has_width(cell.rect.z))).collect()
}

/// Cells between cameras at one coordinate have none.
fn has_width(side: Interval) -> bool {
    side.lo.zip(side.hi).is_none_or(|(lo, hi)| lo < hi)
}

/// "2x3".
fn size(grid: &[Cell]) -> String {
    let (column, row) = grid.iter().filter_map(|cell| cell.place).max().unwrap_or_default();
    format!("{}x{}", column + 1, row + 1)
}

/// Time until `workers` have done runs of these lengths, the longest first.
fn makespan(mut seconds: Vec<f64>, workers: u32) -> f64 {
    seconds.sort_unstable_by(|a, b| b.total_cmp(a));
    let mut busy = vec![0.0_f64; workers.max(1) as usize];
    for run in seconds {
        if let Some(first_free) = busy.iter_mut().min_by(|a, b| a.total_cmp(b)) {
            *first_free += run;
        }
    }
    busy.into_iter().fold(0.0, f64::max)
}

/// "3.1 of the 8.0 GiB that a worker has by default".
fn of_memory(bytes: u64, planned_for: PlannedFor) -> String {
    let from = match planned_for.memory_from {
        MemoryFrom::Configuration => "that partition.memory_gib allows",
        MemoryFrom::Workers => "of the smallest worker",
        MemoryFrom::Default => "that a worker has by default",
    };
    format!("{} of the {} {from}", gib(bytes), gib(planned_for.memory_bytes))
}

/// "3.1 GiB".
pub fn gib(bytes: u64) -> String {
    format!("{:.2} GiB", bytes as f64 / f64::from(1 << 30))
}
