//! The basic types of a plan: the aligned frame, boxes, intervals and rectangles in it, and lines between
//! cells.
//!
//! Intervals are half-open, (lo, hi], so that cells which share a side share no point. Everything goes
//! through [`Alignment::to_aligned`], so that all callers agree on the place of a Gaussian to the last bit.

use fathom_core::seams::{Axis, Line};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// The aligned frame: y down, x and z horizontal, the world's origin and unit of length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Alignment {
    /// How down was found.
    pub rule: UpRule,
    /// Down in world axes, unit length.
    pub down: [f64; 3],
    /// Length of the mean of the cameras' down vectors, 0 to 1; above 0.5 it decides.
    pub mean_down_length: f64,
    /// The subsequent turn about the vertical.
    pub turn: Turn,
    /// The whole rotation: the smallest one that takes `down` to +y, then the turn about y; order w x y z.
    pub world_to_aligned_quat_wxyz: [f64; 4],
}

impl Alignment {
    /// The rotation from world to aligned axes.
    pub fn rotation(&self) -> DQuat {
        let [w, x, y, z] = self.world_to_aligned_quat_wxyz;
        DQuat::from_xyzw(x, y, z, w)
    }

    /// A world point in the aligned frame.
    pub fn to_aligned(&self, world: [f32; 3]) -> DVec3 {
        self.rotation() * DVec3::from(world.map(f64::from))
    }
}

/// A turn about the vertical, so that cells along the axes are compact.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Turn {
    /// The reason.
    pub rule: TurnRule,
    /// Degrees about +y (down) by the right-hand rule, z towards x; above -45 and at most 45. 0 where nothing
    /// is turned.
    pub degrees: f64,
    /// Least perimeter around shares of the cameras at any turn, relative to the original axes; `None` where
    /// it was not computed.
    pub perimeter_ratio: Option<f64>,
}

/// The reason for the turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TurnRule {
    /// This turn gives the most compact rectangles of cameras.
    CompactCells,
    /// No turn makes the rectangles much smaller than they are along the axes, which stay.
    SmallGain,
    /// A very different direction is equally good (crossing paths, a round layout): the axes stay.
    Ambiguous,
    /// The cameras stand in one place: the axes stay.
    NoExtent,
    /// `partition.rotate` is off.
    Off,
}

/// The rule that found the vertical.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpRule {
    /// The mean camera-down vector is longer than 0.5: it is down.
    MeanCameraDown,
    /// The normal of the plane of camera centres, its sign from the mean viewing direction.
    CentrePlane,
    /// The centres lie on a line or in a point: the mean viewing direction, perpendicular to that line.
    ViewingDirection,
    /// There is no evidence: the world's y axis is taken for down.
    WorldY,
}

/// A finite box, aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Box3 {
    /// Smallest x, y, z.
    pub min: [f64; 3],
    /// Largest x, y, z.
    pub max: [f64; 3],
}

impl Box3 {
    /// Whether `point` lies inside or on the border.
    pub fn contains(&self, point: DVec3) -> bool {
        (0..3).all(|axis| point[axis] >= self.min[axis] && point[axis] <= self.max[axis])
    }

    /// Length along one axis.
    pub fn side(&self, axis: usize) -> f64 {
        self.max[axis] - self.min[axis]
    }
}

/// The half-open interval (lo, hi]; `None` is open to infinity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interval {
    /// Lower bound, not in the interval.
    pub lo: Option<f64>,
    /// Upper bound, in the interval.
    pub hi: Option<f64>,
}

impl Interval {
    /// The whole axis.
    pub const ALL: Self = Self { lo: None, hi: None };

    /// Whether a finite `value` lies in the interval.
    pub fn contains(&self, value: f64) -> bool {
        value.is_finite() && self.lo.is_none_or(|lo| value > lo) && self.hi.is_none_or(|hi| value <= hi)
    }
}

/// A rectangle on the aligned x-z plane, endless in y.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rect {
    /// Along x.
    pub x: Interval,
    /// Along z.
    pub z: Interval,
}

impl Rect {
    /// Whether an aligned point with finite coordinates lies in it.
    pub fn contains(&self, aligned: DVec3) -> bool {
        aligned.y.is_finite() && self.x.contains(aligned.x) && self.z.contains(aligned.z)
    }

    /// Whether two have points in common.
    pub fn meets(&self, other: &Self) -> bool {
        let meet = |a: Interval, b: Interval| {
            let (lo, hi) = (
                |i: Interval| i.lo.unwrap_or(f64::NEG_INFINITY),
                |i: Interval| i.hi.unwrap_or(f64::INFINITY),
            );
            lo(a) < hi(b) && lo(b) < hi(a)
        };
        meet(self.x, other.x) && meet(self.z, other.z)
    }

    /// The interval along one axis.
    pub fn along(&self, axis: Axis) -> Interval {
        match axis {
            Axis::X => self.x,
            Axis::Z => self.z,
        }
    }
}

/// A part of the border between cells: a line on the aligned x-z plane at one coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Segment {
    /// The axis along which its coordinate stays the same.
    pub axis: Axis,
    /// That coordinate, scene units.
    pub at: f64,
    /// Where it begins on the other axis; `None` is open.
    pub lo: Option<f64>,
    /// Where it ends.
    pub hi: Option<f64>,
}

impl Segment {
    /// The rectangle within `reach` of it on each axis, scene units.
    pub fn band(&self, reach: f64) -> Rect {
        let across = Interval { lo: Some(self.at - reach), hi: Some(self.at + reach) };
        let along = Interval { lo: self.lo.map(|lo| lo - reach), hi: self.hi.map(|hi| hi + reach) };
        match self.axis {
            Axis::X => Rect { x: across, z: along },
            Axis::Z => Rect { x: along, z: across },
        }
    }
}

impl From<Line> for Segment {
    fn from(line: Line) -> Self {
        let closed = |end: f64| end.is_finite().then_some(end);
        Self { axis: line.axis, at: line.at, lo: closed(line.from), hi: closed(line.to) }
    }
}
