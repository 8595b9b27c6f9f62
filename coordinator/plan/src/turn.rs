//! The turn about the vertical that makes cells along the axes compact.
//!
//! Structure from motion leaves the horizontal axes as arbitrary as the vertical one. A diagonal path would
//! cross its cells from corner to corner, and a tilted survey would have partly empty cells. So at every
//! degree the cameras are cut in four by rank across longer sides, as in the plan. The perimeters of the
//! rectangles around the four shares are measured, because margins and seams run along them. A turn is judged
//! by their mean.
//!
//! Two alternatives failed. The smallest rectangle around all cameras turned a sea-floor survey (`auv`) by 12
//! degrees because of the path to a second, small one. It also missed a diagonal street that bends at one
//! end. Areas instead of perimeters have their minimum some degrees beside a path.
//!
//! The rule, in full, so that nothing turns without a reason:
//! - The [`STRAYS`] of the centres that lie farthest from the middle do not count.
//! - The mean is geometric, so that one share with an odd shape has a quarter of the weight and no more.
//! - Perimeters must be at most [`WORTH_IT`] of those along the original axes.
//! - No very different direction ([`OTHERWISE_DEGREES`]) may be as good to within [`AS_GOOD`]: otherwise the
//!   layout has no main direction, and the winner would be accidental.
//! - Of the directions that differ by quarter turns the smallest turn is taken: x and z change as little as
//!   possible, and columns stay columns.
//!
//! It follows from the centres alone, with no state and no random number.

use glam::DVec2;

use crate::geometry::{Turn, TurnRule};

/// Share of the centres that may be strays; at least one of them.
const STRAYS: f64 = 0.05;
/// Fewest centres; with fewer, none is left out as a stray.
const FEW: usize = 8;
/// Rounds in which the middle of the centres is found without the strays.
const ROUNDS: usize = 4;
/// Most centres that are measured; of more, an even sample is taken.
const MOST: usize = 4096;
/// Number of halvings, and the minimum size of a half. Four shares distinguish surveys, paths and round
/// layouts. With more, the inner ones, which are equally compact at every angle, outvote the others.
const HALVINGS: u32 = 2;
const FEWEST: usize = 8;
/// Least perimeter of a rectangle, as a share of the diameter of the centres: shares may stand in one place.
const LEAST_PERIMETER: f64 = 1e-3;
/// Largest perimeter after a turn, as a share of the one before. A straight path is turned if it lies about
/// 10 degrees off an axis.
const WORTH_IT: f64 = 0.93;
/// Angles within this many degrees are judged together. The longer side of a share, and so its halving, may
/// change from one angle to the next, and that alone must not cause a turn.
const NEARBY: i32 = 4;
/// Directions that differ by more than this count as different.
const OTHERWISE_DEGREES: f64 = 15.0;
/// Perimeters count as equal if the larger is at most this many times the smaller.
const AS_GOOD: f64 = 1.04;

/// The turn for centres at (x, z) of the levelled frame.
pub fn find(centres: &[DVec2]) -> Turn {
    let centres = without_strays(centres);
    let centres: Vec<DVec2> = centres.iter().step_by(centres.len().div_ceil(MOST).max(1)).copied().collect();
    let keep = |rule, perimeter_ratio| Turn { rule, degrees: 0.0, perimeter_ratio };
    let (lo, hi) = bounds(&centres);
    let diameter = lo.distance(hi);
    // Guarded positively: no centre has no diameter.
    if !(diameter > 0.0 && diameter.is_finite()) {
        return keep(TurnRule::NoExtent, None);
    }
    let exact: Vec<f64> =
        (0..90).map(|degrees| mean_perimeter(&centres, f64::from(degrees), diameter)).collect();
    let by_degree: Vec<(f64, f64)> =
        (-44..=45).map(|degrees| (f64::from(degrees), around(&exact, degrees))).collect();
    let Some(best) = smallest(&by_degree) else { return keep(TurnRule::NoExtent, None) };
    let as_it_is = around(&exact, 0);

    let perimeter_ratio = Some(best.1 / as_it_is);
    if best.1 > WORTH_IT * as_it_is {
        return keep(TurnRule::SmallGain, perimeter_ratio);
    }
    let rivals = |&(degrees, perimeter): &(f64, f64)| {
        quarter_turns_off(degrees - best.0).abs() > OTHERWISE_DEGREES && perimeter <= AS_GOOD * best.1
    };
    if by_degree.iter().any(rivals) {
        return keep(TurnRule::Ambiguous, perimeter_ratio);
    }
    Turn { rule: TurnRule::CompactCells, degrees: best.0, perimeter_ratio }
}

/// The smallest perimeter with its angle; of several the smallest turn, of two of those the positive one.
fn smallest(perimeters: &[(f64, f64)]) -> Option<(f64, f64)> {
    let order = |a: &&(f64, f64), b: &&(f64, f64)| {
        a.1.total_cmp(&b.1).then(a.0.abs().total_cmp(&b.0.abs())).then(b.0.total_cmp(&a.0))
    };
    perimeters.iter().min_by(order).copied()
}

/// Mean of the perimeters at angles near this one, which are the same a quarter turn on.
fn around(by_degree: &[f64], degrees: i32) -> f64 {
    let near = (-NEARBY..=NEARBY).map(|off| by_degree[(degrees + off).rem_euclid(90) as usize]);
    near.sum::<f64>() / f64::from(2 * NEARBY + 1)
}

/// Geometric mean of the perimeters around the shares of the centres, after a turn by `degrees`.
fn mean_perimeter(centres: &[DVec2], degrees: f64, diameter: f64) -> f64 {
    // The plane is (x, z), and a turn about y takes z towards x: an angle from x towards z is undone by it.
    let back = DVec2::from_angle(-degrees.to_radians());
    let mut turned: Vec<DVec2> = centres.iter().map(|centre| back.rotate(*centre)).collect();
    let mut logarithms = Vec::new();
    measure(&mut turned, HALVINGS, LEAST_PERIMETER * diameter, &mut logarithms);
    (logarithms.iter().sum::<f64>() / logarithms.len().max(1) as f64).exp()
}

/// Halves the centres by rank across the longer side, `halvings` times, and adds the logarithm of each
/// share's perimeter.
fn measure(centres: &mut [DVec2], halvings: u32, least: f64, logarithms: &mut Vec<f64>) {
    let (lo, hi) = bounds(centres);
    let sides = hi - lo;
    if halvings == 0 || centres.len() < 2 * FEWEST {
        logarithms.push((2.0 * sides.element_sum()).max(least).ln());
        return;
    }
    let axis = usize::from(sides.y > sides.x);
    let middle = centres.len() / 2;
    centres.select_nth_unstable_by(middle, |a, b| {
        a[axis].total_cmp(&b[axis]).then(a[1 - axis].total_cmp(&b[1 - axis]))
    });
    let (low, high) = centres.split_at_mut(middle);
    measure(low, halvings - 1, least, logarithms);
    measure(high, halvings - 1, least, logarithms);
}

/// Smallest and largest coordinates.
fn bounds(centres: &[DVec2]) -> (DVec2, DVec2) {
    let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    centres.iter().fold(none, |(lo, hi), centre| (lo.min(*centre), hi.max(*centre)))
}

/// The angle without whole quarter turns: above -45 and at most 45.
fn quarter_turns_off(degrees: f64) -> f64 {
    let rest = degrees.rem_euclid(90.0);
    if rest > 45.0 { rest - 90.0 } else { rest }
}

/// The centres without those that lie farthest from the middle of the others. Distances do not depend on the
/// axes, so what is left does not either.
fn without_strays(centres: &[DVec2]) -> Vec<DVec2> {
    if centres.len() < FEW {
        return centres.to_vec();
    }
    let strays = (STRAYS * centres.len() as f64).ceil() as usize;
    let mut sorted = centres.to_vec();
    let mut kept = sorted.len();
    for _ in 0..ROUNDS {
        let middle = sorted[..kept].iter().sum::<DVec2>() / kept as f64;
        // By coordinates where distances tie, so that the order of the input does not decide.
        sorted.sort_by(|a, b| {
            let far = |p: &DVec2| p.distance_squared(middle);
            far(a).total_cmp(&far(b)).then(a.x.total_cmp(&b.x)).then(a.y.total_cmp(&b.y))
        });
        kept = centres.len() - strays;
    }
    sorted.truncate(kept);
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(points: &[DVec2], degrees: f64) -> Vec<DVec2> {
        let direction = DVec2::from_angle(degrees.to_radians());
        points.iter().map(|p| direction.rotate(*p)).collect()
    }

    /// A lawn-mower survey of 10 x 4 units with its lines along x.
    fn survey() -> Vec<DVec2> {
        (0..9)
            .flat_map(|line| (0..41).map(move |i| DVec2::new(f64::from(i) * 0.25, f64::from(line) * 0.5)))
            .collect()
    }

    #[test]
    fn a_tilted_survey_is_turned_along_the_axes() {
        for degrees in [20.0, 30.0, 42.0, -25.0, -40.0] {
            let turn = find(&turned(&survey(), degrees));
            assert_eq!(turn.rule, TurnRule::CompactCells, "{degrees}: {turn:?}");
            assert!((turn.degrees - degrees).abs() < 3.0, "{degrees}: {turn:?}");
        }
        // Beyond half a quarter turn the nearer axis is the other one.
        assert!((find(&turned(&survey(), 60.0)).degrees + 30.0).abs() < 3.0);
    }

    #[test]
    fn a_survey_along_the_axes_or_nearly_so_stays() {
        for degrees in [0.0, 90.0, 180.0, 2.0, -2.0] {
            let turn = find(&turned(&survey(), degrees));
            assert_eq!((turn.rule, turn.degrees), (TurnRule::SmallGain, 0.0), "{degrees}: {turn:?}");
        }
    }

    #[test]
    fn strays_do_not_decide() {
        let mut centres = turned(&survey(), 30.0);
        let clean = find(&centres);
        // A twentieth is 19; here are 15, far away and on a line of their own.
        centres.extend((0..15).map(|i| DVec2::new(-300.0 - f64::from(i), 900.0 + 7.0 * f64::from(i))));
        let turn = find(&centres);
        assert_eq!(turn.rule, TurnRule::CompactCells);
        assert!((turn.degrees - clean.degrees).abs() < 3.0, "{turn:?} against {clean:?}");
    }

    #[test]
    fn a_round_layout_and_a_triangle_keep_their_axes() {
        let ring: Vec<DVec2> =
            (0..72).map(|i| DVec2::from_angle(f64::from(i) * std::f64::consts::TAU / 72.0) * 5.0).collect();
        let turn = find(&ring);
        assert!(matches!(turn.rule, TurnRule::SmallGain | TurnRule::Ambiguous), "{turn:?}");
        assert_eq!(turn.degrees, 0.0);
        let corner = |i: f64| DVec2::from_angle(i * std::f64::consts::TAU / 3.0);
        let side = |a: DVec2, b: DVec2| (0..30).map(move |i| a.lerp(b, f64::from(i) / 30.0));
        let triangle: Vec<DVec2> =
            [0.0, 1.0, 2.0].into_iter().flat_map(|i| side(corner(i), corner(i + 1.0))).collect();
        for degrees in [0.0, 7.0, 15.0, 40.0] {
            assert_eq!(find(&turned(&triangle, degrees)).degrees, 0.0, "{degrees}");
        }
    }

    #[test]
    fn a_layout_with_two_equal_directions_keeps_its_axes() {
        // Two paths that cross, 40 degrees apart: shares along one are compact where those along the other
        // are not.
        let arm = |degrees: f64| {
            (-50..=50).map(move |i| DVec2::from_angle(f64::to_radians(degrees)) * f64::from(i))
        };
        let turn = find(&arm(20.0).chain(arm(60.0)).collect::<Vec<_>>());
        assert_eq!((turn.rule, turn.degrees), (TurnRule::Ambiguous, 0.0), "{turn:?}");
    }

    #[test]
    fn a_path_to_a_small_survey_does_not_turn_the_large_one() {
        // The case where the smallest rectangle around all of them fails: 10 x 10 along the axes, and a tenth
        // far off to one side.
        let large =
            (0..40).flat_map(|i| (0..25).map(move |j| DVec2::new(f64::from(i) * 0.25, f64::from(j) * 0.4)));
        let away = (0..100).map(|i| DVec2::new(10.0 + 0.2 * f64::from(i), -4.0 + 0.02 * f64::from(i)));
        let turn = find(&large.chain(away).collect::<Vec<_>>());
        assert!(turn.degrees.abs() < 3.0, "{turn:?}");
    }

    #[test]
    fn a_nearly_straight_path_is_turned_along_an_axis() {
        let path: Vec<DVec2> =
            (0..60).map(|i| DVec2::new(f64::from(i), 0.4 * (f64::from(i) * 0.7).sin())).collect();
        for degrees in [15.0, 45.0, -30.0] {
            let turn = find(&turned(&path, degrees));
            assert_eq!(turn.rule, TurnRule::CompactCells, "{degrees}: {turn:?}");
            assert!(quarter_turns_off(turn.degrees - degrees).abs() < 3.0, "{degrees}: {turn:?}");
        }
        assert_eq!(find(&turned(&path, 4.0)).degrees, 0.0, "a few degrees are not worth it");
        let exact: Vec<DVec2> = (0..60).map(|i| DVec2::new(0.0, f64::from(i))).collect();
        assert!((find(&turned(&exact, 33.0)).degrees - 33.0).abs() < 0.2);
    }

    #[test]
    fn cameras_in_one_place_have_no_direction() {
        for count in [0, 1, 2, 40] {
            let turn = find(&vec![DVec2::new(3.0, -1.0); count]);
            assert_eq!(
                turn,
                Turn { rule: TurnRule::NoExtent, degrees: 0.0, perimeter_ratio: None },
                "{count}"
            );
        }
    }

    #[test]
    fn the_turn_does_not_depend_on_the_order_of_the_centres() {
        let centres = turned(&survey(), 21.0);
        let mut other = centres.clone();
        other.rotate_left(100);
        other.reverse();
        // Sums of another order differ in their last bits, and so may which of two ties goes.
        assert!((find(&centres).degrees - find(&other).degrees).abs() < 0.2);
    }
}
