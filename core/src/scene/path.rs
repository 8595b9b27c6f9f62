//! A smooth flight through given cameras.
//!
//! Centres follow a centripetal Catmull-Rom spline (Yuksel et al. 2011: no loops, no cusps between keys). It
//! is parametrised by arc length, so that the speed is even for any spacing of the keys. Rotations follow
//! cumulative cubic Bezier curves of unit quaternions (Kim, Kim and Shin 1995) on the shortest arcs.
//! Intrinsics change linearly.

use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec3};

use super::{PinholeCamera, Pose};
use crate::{CoreError, Result};

/// Number of pieces for measuring the length of a curve.
const PIECES: usize = 32;
/// Largest angular velocity at a key, in mean velocities of the slower of its two segments. A cubic with end
/// slopes of at most three times the mean does not overshoot (Fritsch and Carlson 1980).
const MOST_SPEED: f64 = 3.0;

/// A path through key cameras. Time runs from 0 at the first to 1 at the last.
#[derive(Clone, Debug)]
pub struct CameraPath {
    segments: Vec<Segment>,
    last: Key,
}

#[derive(Clone, Copy, Debug)]
struct Key {
    camera: PinholeCamera,
    centre: DVec3,
    camera_to_world: DQuat,
}

/// The part of a path from one key to the next.
#[derive(Clone, Debug)]
struct Segment {
    from: Key,
    to: Key,
    /// Time of its end, in the unit of durations.
    end: f64,
    duration: f64,
    curve: Curve,
    /// Factors of the cumulative Bezier curve: rotation vectors in the camera's frame.
    turns: [DVec3; 3],
}

/// A cubic between two points with given derivatives; parameter 0 to 1.
#[derive(Clone, Debug)]
struct Curve {
    ends: [DVec3; 2],
    tangents: [DVec3; 2],
    /// Length up to each border of the [`PIECES`].
    lengths: Vec<f64>,
}

impl CameraPath {
    /// The path through `keys` in their order; with one key it stays there.
    ///
    /// # Errors
    /// [`CoreError::Scene`] without keys, with cameras of different sizes, with unsound poses or with
    /// intrinsics that are not finite.
    pub fn new(keys: &[(PinholeCamera, Pose)]) -> Result<Self> {
        let refuse = |message: String| Err(CoreError::Scene(format!("camera path: {message}")));
        let Some((first, _)) = keys.first() else {
            return refuse("it needs at least one camera".to_owned());
        };
        for (index, (camera, pose)) in keys.iter().enumerate() {
            if (camera.width, camera.height) != (first.width, first.height) {
                return refuse(format!(
                    "camera {index} has {}x{} pixels, camera 0 has {}x{}; give all of them one size",
                    camera.width, camera.height, first.width, first.height
                ));
            }
            let numbers = [camera.fx, camera.fy, camera.cx, camera.cy];
            if !(pose.is_sound() && numbers.iter().all(|number| number.is_finite())) {
                return refuse(format!(
                    "the pose or the intrinsics of camera {index} are not usable numbers"
                ));
            }
        }
        let keys: Vec<Key> = keys
            .iter()
            .map(|(camera, pose)| Key {
                camera: *camera,
                centre: pose.centre(),
                camera_to_world: pose.rotation.inverse(),
            })
            .collect();
        Ok(Self { segments: segments(&keys), last: keys[keys.len() - 1] })
    }

    /// Camera and pose at `time`, 0 to 1; outside that range, those of the ends.
    pub fn at(&self, time: f64) -> (PinholeCamera, Pose) {
        let now = time.max(0.0) * self.segments.last().map_or(0.0, |last| last.end);
        // Two equal keys make a segment without duration, which is skipped.
        let index = self.segments.partition_point(|segment| segment.end <= now);
        let Some(segment) = self.segments.get(index) else {
            return (self.last.camera, pose(self.last.centre, self.last.camera_to_world));
        };
        let share = (1.0 - (segment.end - now) / segment.duration).max(0.0);
        let (from, to) = (&segment.from, &segment.to);
        let centre = segment.curve.after(share);
        (mixed(&from.camera, &to.camera, share), pose(centre, segment.camera_to_world(share)))
    }

    /// `count` cameras at even times, including the first and the last key. A single camera is the first key.
    pub fn frames(&self, count: u32) -> impl ExactSizeIterator<Item = (PinholeCamera, Pose)> {
        let last = f64::from(count.saturating_sub(1).max(1));
        (0..count).map(move |index| self.at(f64::from(index) / last))
    }
}

impl Segment {
    fn camera_to_world(&self, t: f64) -> DQuat {
        let weights = [1.0 - (1.0 - t).powi(3), t * t * (3.0 - 2.0 * t), t * t * t];
        let factors =
            self.turns.iter().zip(weights).map(|(turn, weight)| DQuat::from_scaled_axis(*turn * weight));
        factors.fold(self.from.camera_to_world, |rotation, factor| rotation * factor)
    }
}

impl Curve {
    fn new(ends: [DVec3; 2], tangents: [DVec3; 2]) -> Self {
        let mut curve = Self { ends, tangents, lengths: vec![0.0; PIECES + 1] };
        for piece in 0..PIECES {
            let length = curve.length_between(border(piece), border(piece + 1));
            curve.lengths[piece + 1] = curve.lengths[piece] + length;
        }
        curve
    }

    fn length(&self) -> f64 {
        self.lengths[PIECES]
    }

    /// The point after a share of its length.
    fn after(&self, share: f64) -> DVec3 {
        let walked = share * self.length();
        let piece = self.lengths.partition_point(|length| *length <= walked).clamp(1, PIECES) - 1;
        let (begin, end) = (border(piece), border(piece + 1));
        let left = walked - self.lengths[piece];
        let mut u = begin + (end - begin) * left / (self.lengths[piece + 1] - self.lengths[piece]);
        if !u.is_finite() {
            // The piece has no length, so all its points are equal.
            return self.at(begin);
        }
        // Newton's method; the speed hardly changes inside a piece.
        for _ in 0..4 {
            let step = (self.length_between(begin, u) - left) / self.slope(u).length();
            u = if step.is_finite() { (u - step).clamp(begin, end) } else { u };
        }
        self.at(u)
    }

    fn at(&self, u: f64) -> DVec3 {
        let ([from, to], [begin, end]) = (self.ends, self.tangents);
        let (u2, u3) = (u * u, u * u * u);
        (2.0 * u3 - 3.0 * u2 + 1.0) * from
            + (u3 - 2.0 * u2 + u) * begin
            + (3.0 * u2 - 2.0 * u3) * to
            + (u3 - u2) * end
    }

    /// Derivative by the parameter.
    fn slope(&self, u: f64) -> DVec3 {
        let ([from, to], [begin, end]) = (self.ends, self.tangents);
        let u2 = u * u;
        6.0 * (u - u2) * (to - from) + (3.0 * u2 - 4.0 * u + 1.0) * begin + (3.0 * u2 - 2.0 * u) * end
    }

    /// Length between two parameters (Gauss and Legendre, three nodes).
    fn length_between(&self, a: f64, b: f64) -> f64 {
        let (middle, half) = ((a + b) / 2.0, (b - a) / 2.0);
        let node = half * 0.6_f64.sqrt();
        let speed = |u: f64| self.slope(u).length();
        half * (5.0 * speed(middle - node) + 8.0 * speed(middle) + 5.0 * speed(middle + node)) / 9.0
    }
}

/// Parameter at which piece `index` of a curve begins.
fn border(index: usize) -> f64 {
    index as f64 / PIECES as f64
}

fn pose(centre: DVec3, camera_to_world: DQuat) -> Pose {
    let rotation = camera_to_world.normalize().inverse();
    Pose { rotation, translation: -(rotation * centre) }
}

fn segments(keys: &[Key]) -> Vec<Segment> {
    let curves = curves(&keys.iter().map(|key| key.centre).collect::<Vec<_>>());
    let angles: Vec<DVec3> =
        keys.windows(2).map(|pair| turn(pair[0].camera_to_world, pair[1].camera_to_world)).collect();
    let durations = durations(&curves, &angles);
    let velocities = angular_velocities(&angles, &durations);
    let mut end = 0.0;
    (keys.windows(2).zip(curves).enumerate())
        .map(|(index, (pair, curve))| {
            let (from, to, duration) = (pair[0], pair[1], durations[index]);
            let (first, last) = (velocities[index] * duration / 3.0, velocities[index + 1] * duration / 3.0);
            let after_first = from.camera_to_world * DQuat::from_scaled_axis(first);
            let before_last = to.camera_to_world * DQuat::from_scaled_axis(-last);
            let turns = [first, turn(after_first, before_last), last];
            end += duration;
            Segment { from, to, end, duration, curve, turns }
        })
        .collect()
}

/// The rotation from `a` to `b` on the shortest arc, as a rotation vector in the frame of `a`.
fn turn(a: DQuat, b: DQuat) -> DVec3 {
    let between = a.inverse() * b;
    // A negative w means the longer arc.
    (if between.w < 0.0 { -between } else { between }).to_scaled_axis()
}

/// The curves between points (centripetal Catmull-Rom: the knot spacing is the square root of the distance).
fn curves(points: &[DVec3]) -> Vec<Curve> {
    let knots = |a: DVec3, b: DVec3| a.distance(b).sqrt();
    // The slope per knot at `at`, from its neighbours; a neighbour at the same position does not count.
    let slope = |before: DVec3, at: DVec3, after: DVec3| {
        let (d0, d1) = (knots(before, at), knots(at, after));
        if d0 > 0.0 && d1 > 0.0 {
            (at - before) / d0 - (after - before) / (d0 + d1) + (after - at) / d1
        } else {
            (after - before) / (d0 + d1).max(f64::MIN_POSITIVE)
        }
    };
    (1..points.len())
        .map(|next| {
            let (p1, p2) = (points[next - 1], points[next]);
            // Beyond the ends the path continues straight.
            let p0 = if next >= 2 { points[next - 2] } else { 2.0 * p1 - p2 };
            let p3 = if next + 1 < points.len() { points[next + 1] } else { 2.0 * p2 - p1 };
            let d = knots(p1, p2);
            Curve::new([p1, p2], [d * slope(p0, p1, p2), d * slope(p1, p2, p3)])
        })
        .collect()
}

/// Duration of each segment: its length, but at least the time for its rotation, where a right angle takes as
/// long as a mean segment. So a camera that rotates on the spot does not jump, and a moving one keeps its
/// speed.
fn durations(curves: &[Curve], angles: &[DVec3]) -> Vec<f64> {
    let moved: f64 = curves.iter().map(Curve::length).sum();
    let per_radian = if moved > 0.0 { moved / curves.len() as f64 / FRAC_PI_2 } else { 1.0 };
    let needed =
        curves.iter().zip(angles).map(|(curve, angle)| curve.length().max(per_radian * angle.length()));
    let durations: Vec<f64> = needed.collect();
    // All keys are equal: any duration above 0 works.
    if durations.iter().sum::<f64>() > 0.0 { durations } else { vec![1.0; durations.len()] }
}

/// Angular velocity at each key, in its camera's frame: the mean of both sides, limited so that neither side
/// overshoots. At the ends it is that of the only side.
fn angular_velocities(angles: &[DVec3], durations: &[f64]) -> Vec<DVec3> {
    let velocity = |index: usize| {
        if durations[index] > 0.0 { angles[index] / durations[index] } else { DVec3::ZERO }
    };
    (0..=angles.len())
        .map(|key| match (key.checked_sub(1), (key < angles.len()).then_some(key)) {
            (Some(before), Some(after)) => {
                let (a, b) = (velocity(before), velocity(after));
                ((a + b) / 2.0).clamp_length_max(MOST_SPEED * a.length().min(b.length()))
            }
            (Some(only), None) | (None, Some(only)) => velocity(only),
            (None, None) => DVec3::ZERO,
        })
        .collect()
}

/// The camera with interpolated focal lengths and principal point.
fn mixed(from: &PinholeCamera, to: &PinholeCamera, share: f64) -> PinholeCamera {
    let mix = |a: f64, b: f64| a + (b - a) * share;
    PinholeCamera {
        fx: mix(from.fx, to.fx),
        fy: mix(from.fy, to.fy),
        cx: mix(from.cx, to.cx),
        cy: mix(from.cy, to.cy),
        ..*from
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: PinholeCamera =
        PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };

    fn path(poses: &[Pose]) -> CameraPath {
        let keys: Vec<_> = poses.iter().map(|pose| (CAMERA, *pose)).collect();
        CameraPath::new(&keys).expect("a path")
    }

    fn refused(keys: &[(PinholeCamera, Pose)]) -> String {
        CameraPath::new(keys).map(|_| ()).expect_err("a refusal").to_string()
    }

    /// The time of each key, 0 to 1.
    fn key_times(path: &CameraPath) -> Vec<f64> {
        let total = path.segments.last().map_or(1.0, |last| last.end);
        std::iter::once(0.0).chain(path.segments.iter().map(|segment| segment.end / total)).collect()
    }

    /// Unevenly spaced keys on a winding path, with changing directions.
    fn winding() -> Vec<Pose> {
        [
            ([0.0, 0.0, 0.0], [0.0, 0.0, 5.0]),
            ([1.0, 0.0, 0.2], [1.0, 1.0, 5.0]),
            ([1.1, 0.1, 0.2], [2.0, 1.0, 4.0]),
            ([6.0, -2.0, 1.0], [0.0, 0.0, 0.0]),
            ([6.0, 3.0, 4.0], [1.0, 0.0, 0.0]),
            ([0.0, 3.0, 4.5], [3.0, 1.0, 1.0]),
        ]
        .map(|(eye, target)| Pose::looking_at(eye.into(), target.into(), DVec3::Y))
        .to_vec()
    }

    /// Angle between two poses, radians.
    fn angle(a: &Pose, b: &Pose) -> f64 {
        turn(a.rotation, b.rotation).length()
    }

    #[test]
    fn a_path_passes_through_its_keys_in_their_order() {
        let poses = winding();
        let path = path(&poses);
        let times = key_times(&path);
        assert!(times.is_sorted(), "{times:?}");
        for (time, key) in times.iter().zip(&poses) {
            // The speed at a key magnifies the rounding of times.
            let (_, pose) = path.at(*time);
            assert!(
                pose.centre().distance(key.centre()) < 1e-9,
                "at {time}: {} {}",
                pose.centre(),
                key.centre()
            );
            assert!(angle(&pose, key) < 1e-6, "at {time}: turned by {}", angle(&pose, key));
        }
        let frames: Vec<_> = path.frames(7).collect();
        assert_eq!(frames.len(), 7);
        for (frame, key) in [(&frames[0], &poses[0]), (&frames[6], &poses[5])] {
            assert!(frame.1.centre().distance(key.centre()) < 1e-12 && angle(&frame.1, key) < 1e-6);
        }
    }

    #[test]
    fn the_speed_is_even_for_unevenly_spaced_keys() {
        let ahead = |pose: Pose| Pose::looking_at(pose.centre(), pose.centre() + DVec3::Z, DVec3::Y);
        let path = path(&winding().into_iter().map(ahead).collect::<Vec<_>>());
        let centres: Vec<DVec3> = path.frames(20_000).map(|(_, pose)| pose.centre()).collect();
        let steps: Vec<f64> = centres.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
        let mean = steps.iter().sum::<f64>() / steps.len() as f64;
        let worst = steps.iter().map(|step| (step / mean - 1.0).abs()).fold(0.0, f64::max);
        // Quadrature of the lengths and chords across bends cause 1.2e-5.
        assert!(worst < 1e-4, "a step is {worst} off the mean {mean}");
    }

    #[test]
    fn rotations_are_smooth_for_any_signs_of_quaternions() {
        let poses = winding();
        let mut turned = poses.clone();
        for pose in turned.iter_mut().step_by(2) {
            pose.rotation = -pose.rotation;
        }
        let (path, same) = (path(&poses), path(&turned));
        let frames: Vec<Pose> = path.frames(2000).map(|(_, pose)| pose).collect();
        for (a, (_, b)) in frames.iter().zip(same.frames(2000)) {
            assert!(a.is_sound());
            assert!(angle(a, &b) < 1e-6 && a.centre().distance(b.centre()) < 1e-9);
        }
        let whole: f64 = poses.windows(2).map(|pair| angle(&pair[0], &pair[1])).sum();
        let steps: Vec<f64> = frames.windows(2).map(|pair| angle(&pair[0], &pair[1])).collect();
        let fastest = steps.iter().copied().fold(0.0, f64::max);
        assert!(fastest < 0.03, "a step of {fastest} radians");
        let all: f64 = steps.iter().sum();
        assert!((0.99..1.5).contains(&(all / whole)), "turned by {all} for {whole} between keys");
        // The velocity is continuous: it changes little from step to step.
        let jerk = steps.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
        assert!(jerk < 0.1 * fastest, "the angular velocity jumps by {jerk} of {fastest}");
    }

    #[test]
    fn the_shortest_arc_is_taken() {
        let looking = |degrees: f64| {
            let (x, z) = degrees.to_radians().sin_cos();
            Pose::looking_at(DVec3::ZERO, DVec3::new(x, 0.0, z), DVec3::Y)
        };
        // From 170 to 190 degrees, through 180 and not through 0. The camera does not move, so the rotation
        // alone determines the time.
        let path = path(&[looking(170.0), looking(190.0)]);
        let middle = path.at(0.5).1.forward();
        assert!(middle.distance(DVec3::NEG_Z) < 1e-6, "{middle}");
        let early = path.at(0.25).1.forward();
        assert!((early.angle_between(DVec3::NEG_Z).to_degrees() - 5.0).abs() < 1e-6, "{early}");
    }

    #[test]
    fn a_camera_that_turns_on_the_spot_takes_its_time() {
        let looking = |eye: DVec3, ahead: DVec3| Pose::looking_at(eye, eye + ahead, DVec3::Y);
        let path = path(&[
            looking(DVec3::ZERO, DVec3::Z),
            looking(DVec3::X, DVec3::Z),
            looking(DVec3::X, DVec3::X),
            looking(2.0 * DVec3::X, DVec3::X),
        ]);
        let times = key_times(&path);
        // A right angle takes as long as the mean of the three segments. Two of them have length 1, so this
        // is 2/3.
        assert!((times[2] - times[1] - (2.0 / 3.0) / (8.0 / 3.0)).abs() < 1e-9, "{times:?}");
        let (_, half_way) = path.at((times[1] + times[2]) / 2.0);
        assert!((half_way.centre() - DVec3::X).length() < 1e-9);
        assert!((half_way.forward().angle_between(DVec3::Z).to_degrees() - 45.0).abs() < 1.0);
    }

    #[test]
    fn one_key_two_keys_and_equal_keys_make_a_path() {
        let pose = Pose::looking_at(DVec3::X, DVec3::ZERO, DVec3::Y);
        for keys in [&[pose][..], &[pose, pose], &[pose, pose, pose]] {
            for (camera, at) in path(keys).frames(3) {
                assert_eq!(camera, CAMERA);
                assert!(at.centre().distance(DVec3::X) < 1e-12 && angle(&at, &pose) < 1e-6);
            }
        }
        let away = Pose::looking_at(3.0 * DVec3::X, DVec3::ZERO, DVec3::Y);
        let two = path(&[pose, away]);
        for (frame, x) in two.frames(5).zip([1.0, 1.5, 2.0, 2.5, 3.0]) {
            assert!(frame.1.centre().distance(x * DVec3::X) < 1e-9, "{}", frame.1.centre());
        }
        assert_eq!(two.frames(1).len(), 1);
        // A key that is listed twice counts once.
        let doubled = path(&[pose, pose, away]);
        assert!(doubled.at(0.5).1.centre().distance(2.0 * DVec3::X) < 1e-9);
    }

    #[test]
    fn intrinsics_change_from_key_to_key() {
        let [a, b] = [0.0, 1.0].map(|x| Pose::looking_at(DVec3::X * x, DVec3::Z, DVec3::Y));
        let wide = PinholeCamera { fx: 30.0, fy: 40.0, cx: 30.0, ..CAMERA };
        let path = CameraPath::new(&[(CAMERA, a), (wide, b)]).expect("a path");
        let expected = PinholeCamera { fx: 40.0, fy: 45.0, cx: 31.0, ..CAMERA };
        let (camera, _) = path.at(0.5);
        for (have, want) in
            [(camera.fx, expected.fx), (camera.fy, expected.fy), (camera.cx, expected.cx), (camera.cy, 24.0)]
        {
            assert!((have - want).abs() < 1e-9, "{camera:?}");
        }
        assert_eq!((camera.width, camera.height), (64, 48));
    }

    #[test]
    fn a_path_that_cannot_be_flown_is_refused_with_the_reason() {
        let pose = Pose::looking_at(DVec3::X, DVec3::ZERO, DVec3::Y);
        assert!(refused(&[]).contains("at least one camera"));
        let larger = PinholeCamera { width: 65, ..CAMERA };
        let said = refused(&[(CAMERA, pose), (larger, pose)]);
        assert!(said.contains("camera 1 has 65x48") && said.contains("64x48"), "{said}");
        let lost = Pose { translation: DVec3::new(0.0, f64::NAN, 0.0), ..pose };
        assert!(refused(&[(CAMERA, pose), (CAMERA, lost)]).contains("camera 1"));
    }
}
