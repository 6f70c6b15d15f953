//! Scripted gestures: master postures as pure functions of time.
//!
//! A gesture is a list of moves from rest to rest. Within a move every finger follows a minimum-jerk profile, so
//! angles, speeds and accelerations are continuous; every gesture starts and ends with the open hand, so it loops
//! without a jump and gestures can follow one another in any order.

use std::f64::consts::FRAC_PI_2;
use std::str::FromStr;

use crate::hand::MAX_FINGERS;

/// 20 joint angles, rad.
type Posture = [f64; 20];

/// The open hand: thumb to the radial side, everything else straight.
pub const OPEN: Posture = posture([FRAC_PI_2, 0.0, 0.0, 0.0], [STRAIGHT; 4]);

/// The seven gestures of the comparison runs: thumb and fingertips touch (with the paradigmatic hand's lengths).
pub const FINGER_TAPS: [Gesture; 7] = [
    Gesture::TapIndex,
    Gesture::TapMiddle,
    Gesture::TapRing,
    Gesture::Tripod,
    Gesture::TapIndexClose,
    Gesture::TapMiddleClose,
    Gesture::TripodClose,
];

/// What [`Gesture::Tour`] goes through, in order.
const TOUR: [Gesture; 13] = [
    Gesture::Open,
    Gesture::TapIndex,
    Gesture::TapMiddle,
    Gesture::TapRing,
    Gesture::Tripod,
    Gesture::Pinch,
    Gesture::Fist,
    Gesture::Count,
    Gesture::Wave,
    Gesture::TapIndexClose,
    Gesture::TapMiddleClose,
    Gesture::TripodClose,
    Gesture::Fist,
];

const STRAIGHT: [f64; 4] = [0.0; 4];
const CURLED: [f64; 4] = [0.0, 1.45, 1.70, 1.0];
const CURLED_LITTLE: [f64; 4] = [0.05, 1.40, 1.65, 0.95];
/// Beside the curled index, pointing distally.
const THUMB_BESIDE: [f64; 4] = [0.05, 0.70, 0.25, 0.0];
/// Raised beside the curled index, ...
const THUMB_RAISED: [f64; 4] = [0.05, 1.40, 0.0, 0.0];
/// ... then its last phalanx bent across it.
const THUMB_OVER: [f64; 4] = [0.05, 1.40, 0.0, -1.10];

const TAP_INDEX: Posture = posture(
    [2.699411, 1.769177, 0.615907, 0.0],
    [[0.000214, 0.694842, 1.363567, 1.194090], STRAIGHT, STRAIGHT, STRAIGHT],
);
const TAP_MIDDLE: Posture = posture(
    [2.172231, 1.913047, 0.523874, 0.0],
    [STRAIGHT, [-0.011889, 0.588065, 1.757143, 0.854460], STRAIGHT, STRAIGHT],
);
const TAP_RING: Posture = posture(
    [1.856962, 2.094395, 0.701288, 0.0],
    [STRAIGHT, STRAIGHT, [-0.093323, 0.805290, 1.894837, 0.851430], STRAIGHT],
);
const TRIPOD: Posture = posture(
    [2.422757, 1.838007, 0.538794, 0.0],
    [[0.012826, 0.740420, 1.395137, 1.196299], [-0.019990, 0.546752, 1.695813, 0.838058], STRAIGHT, STRAIGHT],
);
const TAP_INDEX_CLOSE: Posture = posture(
    [2.593657, 1.293815, 1.420665, 0.0],
    [[0.005011, 0.660302, 1.718282, 1.094473], STRAIGHT, STRAIGHT, STRAIGHT],
);
const TAP_MIDDLE_CLOSE: Posture = posture(
    [2.083787, 1.574005, 1.232025, 0.0],
    [STRAIGHT, [-0.011594, 0.669254, 1.851779, 1.153886], STRAIGHT, STRAIGHT],
);
const TRIPOD_CLOSE: Posture = posture(
    [2.295900, 1.389095, 1.374766, 0.0],
    [[0.013183, 0.691209, 1.766835, 1.107487], [-0.016935, 0.645860, 1.811957, 1.144262], STRAIGHT, STRAIGHT],
);

/// A scripted gesture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Gesture {
    /// The open hand at rest.
    Open,
    /// Thumb tip to index tip (set A, natural).
    TapIndex,
    /// Thumb tip to middle tip (set A).
    TapMiddle,
    /// Thumb tip to ring tip (set A).
    TapRing,
    /// Thumb tip between index and middle tips (set A).
    Tripod,
    /// Tap of the index, more curled (set B).
    TapIndexClose,
    /// Tap of the middle, more curled (set B).
    TapMiddleClose,
    /// Tripod, more curled (set B).
    TripodClose,
    /// Three quick index pinches that open only half way.
    Pinch,
    /// A fist, the thumb over the index.
    Fist,
    /// Counting from one (index) to five.
    Count,
    /// A wave of flexion from the little finger to the index and back.
    Wave,
    /// The tripod on the time line of the paper's Fig. 8, 80 s.
    TripodFig8,
    /// The curled tripod on the same time line.
    TripodCloseFig8,
    /// All of the above (but the two long time lines) one after the other, with a person's timing.
    Tour,
}

/// No gesture has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown gesture `{name}`; known are {}", Gesture::ALL.map(Gesture::name).join(", "))]
pub struct UnknownGesture {
    /// What was asked for.
    pub name: String,
}

/// A move to a posture and a rest there.
#[derive(Clone, Copy)]
struct Segment {
    to: Posture,
    /// Duration of the move, s.
    r#move: f64,
    /// Rest after it, s.
    rest: f64,
    /// Per finger, which part of the move it moves in, as fractions.
    window: [[f64; 2]; MAX_FINGERS],
}

/// All fingers together.
const TOGETHER: [[f64; 2]; MAX_FINGERS] = [[0.0, 1.0]; MAX_FINGERS];
/// A person's fingers neither start nor stop at once.
const HUMAN: [[f64; 2]; MAX_FINGERS] = [[0.05, 0.97], [0.0, 0.94], [0.02, 0.97], [0.04, 0.99], [0.06, 1.0]];
const FINGERS_FIRST: [[f64; 2]; MAX_FINGERS] = [[0.25, 1.0], [0.0, 0.75], [0.02, 0.78], [0.04, 0.80], [0.06, 0.82]];
const THUMB_FIRST: [[f64; 2]; MAX_FINGERS] = [[0.0, 0.75], [0.25, 1.0], [0.22, 0.97], [0.20, 0.95], [0.18, 0.93]];

impl Gesture {
    /// Every gesture.
    pub const ALL: [Self; 15] = [
        Self::Open,
        Self::TapIndex,
        Self::TapMiddle,
        Self::TapRing,
        Self::Tripod,
        Self::TapIndexClose,
        Self::TapMiddleClose,
        Self::TripodClose,
        Self::Pinch,
        Self::Fist,
        Self::Count,
        Self::Wave,
        Self::TripodFig8,
        Self::TripodCloseFig8,
        Self::Tour,
    ];

    /// The gesture called `name`, as [`Gesture::name`] spells it.
    ///
    /// # Errors
    /// [`UnknownGesture`] lists the names there are.
    pub fn parse(name: &str) -> Result<Self, UnknownGesture> {
        Self::ALL.into_iter().find(|gesture| gesture.name() == name).ok_or_else(|| UnknownGesture { name: name.into() })
    }

    /// Name on the command line and in files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::TapIndex => "tap_index",
            Self::TapMiddle => "tap_middle",
            Self::TapRing => "tap_ring",
            Self::Tripod => "tripod",
            Self::TapIndexClose => "tap_index_close",
            Self::TapMiddleClose => "tap_middle_close",
            Self::TripodClose => "tripod_close",
            Self::Pinch => "pinch",
            Self::Fist => "fist",
            Self::Count => "count",
            Self::Wave => "wave",
            Self::TripodFig8 => "tripod_fig8",
            Self::TripodCloseFig8 => "tripod_close_fig8",
            Self::Tour => "tour",
        }
    }

    /// One line for a help text.
    #[must_use]
    pub const fn description(self) -> &'static str {
        match self {
            Self::Open => "the open hand at rest",
            Self::TapIndex => "thumb tip to index tip: close 2 s, hold 0.5 s, open 2 s",
            Self::TapMiddle => "thumb tip to middle tip: close 2 s, hold 0.5 s, open 2 s",
            Self::TapRing => "thumb tip to ring tip: close 2 s, hold 0.5 s, open 2 s",
            Self::Tripod => "thumb tip between index and middle tips: close 2 s, hold 0.5 s, open 2 s",
            Self::TapIndexClose => "index tap with the fingers more curled",
            Self::TapMiddleClose => "middle tap with the fingers more curled",
            Self::TripodClose => "tripod with the fingers more curled",
            Self::Pinch => "three quick index pinches that open half way",
            Self::Fist => "a fist, the thumb over the index",
            Self::Count => "counting from one to five",
            Self::Wave => "a wave of flexion through the fingers and back",
            Self::TripodFig8 => "tripod on the time line of the paper's Fig. 8, 80 s",
            Self::TripodCloseFig8 => "curled tripod on the time line of the paper's Fig. 8, 80 s",
            Self::Tour => "all gestures one after the other with a person's timing",
        }
    }

    /// The posture the gesture closes to, rad, if it is of the kind that closes once.
    #[must_use]
    pub const fn posture(self) -> Option<[f64; 20]> {
        Some(match self {
            Self::Open => OPEN,
            Self::TapIndex | Self::Pinch => TAP_INDEX,
            Self::TapMiddle => TAP_MIDDLE,
            Self::TapRing => TAP_RING,
            Self::Tripod | Self::TripodFig8 => TRIPOD,
            Self::TapIndexClose => TAP_INDEX_CLOSE,
            Self::TapMiddleClose => TAP_MIDDLE_CLOSE,
            Self::TripodClose | Self::TripodCloseFig8 => TRIPOD_CLOSE,
            Self::Fist => fist(THUMB_OVER),
            Self::Count | Self::Wave | Self::Tour => return None,
        })
    }

    /// Length of one run, s.
    #[must_use]
    pub fn duration(self) -> f64 {
        let mut duration = 0.0;
        self.visit(&mut |segment| {
            duration += segment.r#move + segment.rest;
            true
        });
        duration
    }

    /// Joint angles at time `t` (s, from the start), rad; beyond the duration it starts again, without a jump.
    ///
    /// A `t` that is not finite gives the start.
    #[must_use]
    pub fn sample(self, t: f64) -> [f64; 20] {
        let t = t.rem_euclid(self.duration());
        let mut rest = if t.is_finite() { t } else { 0.0 };
        let mut q = OPEN;
        self.visit(&mut |segment| {
            let u = (rest / segment.r#move).min(1.0);
            for (finger, [start, end]) in segment.window.into_iter().enumerate() {
                let s = minimum_jerk((u - start) / (end - start));
                let joints = finger * 4..finger * 4 + 4;
                for (angle, to) in q[joints.clone()].iter_mut().zip(&segment.to[joints]) {
                    *angle += s * (to - *angle);
                }
            }
            rest -= segment.r#move + segment.rest;
            rest > 0.0
        });
        q
    }

    /// Calls `visit` with the segments of one run in order, until it returns false.
    fn visit(self, visit: &mut dyn FnMut(Segment) -> bool) {
        let run: &[Segment] = match self {
            Self::Open => &[Segment { to: OPEN, r#move: 1.0, rest: 1.0, window: TOGETHER }],
            Self::TapIndex => &comparison_run(TAP_INDEX),
            Self::TapMiddle => &comparison_run(TAP_MIDDLE),
            Self::TapRing => &comparison_run(TAP_RING),
            Self::Tripod => &comparison_run(TRIPOD),
            Self::TapIndexClose => &comparison_run(TAP_INDEX_CLOSE),
            Self::TapMiddleClose => &comparison_run(TAP_MIDDLE_CLOSE),
            Self::TripodClose => &comparison_run(TRIPOD_CLOSE),
            Self::TripodFig8 => &fig8(TRIPOD),
            Self::TripodCloseFig8 => &fig8(TRIPOD_CLOSE),
            Self::Pinch => &PINCH,
            Self::Fist => &FIST,
            Self::Count => &COUNT,
            Self::Wave => &WAVE,
            Self::Tour => {
                tour(visit);
                return;
            }
        };
        for segment in run {
            if !visit(*segment) {
                return;
            }
        }
    }
}

impl FromStr for Gesture {
    type Err = UnknownGesture;

    fn from_str(name: &str) -> Result<Self, UnknownGesture> {
        Self::parse(name)
    }
}

impl std::fmt::Display for Gesture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

/// The minimum-jerk profile from 0 at `u` = 0 to 1 at `u` = 1, constant outside.
#[must_use]
pub fn minimum_jerk(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * u * (10.0 - u * (15.0 - 6.0 * u))
}

/// The taps a little quicker than in the comparison runs, fingers not quite together, a rest in between.
fn tour(visit: &mut dyn FnMut(Segment) -> bool) {
    for gesture in TOUR {
        let mut more = true;
        let brisk = FINGER_TAPS.contains(&gesture);
        gesture.visit(&mut |mut segment| {
            if brisk {
                segment.r#move *= 0.8;
                segment.window = HUMAN;
            }
            more = visit(segment);
            more
        });
        if !more || !visit(Segment { to: OPEN, r#move: 0.2, rest: 0.2, window: TOGETHER }) {
            return;
        }
    }
}

/// The comparison runs of the paper's Fig. 6: close, hold, open.
const fn comparison_run(to: Posture) -> [Segment; 2] {
    [
        Segment { to, r#move: 2.0, rest: 0.5, window: TOGETHER },
        Segment { to: OPEN, r#move: 2.0, rest: 0.0, window: TOGETHER },
    ]
}

/// The time line of the paper's Fig. 8: thumb and index close from 16 to 36 s, the middle from 18 to 36 s, and open
/// in the mirror image about 40 s.
const fn fig8(to: Posture) -> [Segment; 3] {
    let mut closing = TOGETHER;
    closing[2] = [0.1, 1.0];
    let mut opening = TOGETHER;
    opening[2] = [0.0, 0.9];
    [
        Segment { to: OPEN, r#move: 8.0, rest: 8.0, window: TOGETHER },
        Segment { to, r#move: 20.0, rest: 8.0, window: closing },
        Segment { to: OPEN, r#move: 20.0, rest: 16.0, window: opening },
    ]
}

const PINCH: [Segment; 6] = {
    let half_open = blend(OPEN, TAP_INDEX, 0.75);
    let close = Segment { to: TAP_INDEX, r#move: 0.7, rest: 0.2, window: TOGETHER };
    let release = Segment { to: half_open, r#move: 0.6, rest: 0.1, window: TOGETHER };
    [
        Segment { r#move: 1.6, ..close },
        release,
        close,
        release,
        close,
        Segment { to: OPEN, r#move: 1.6, rest: 0.0, window: HUMAN },
    ]
};

const FIST: [Segment; 4] = [
    Segment { to: fist(THUMB_RAISED), r#move: 1.5, rest: 0.0, window: FINGERS_FIRST },
    Segment { to: fist(THUMB_OVER), r#move: 0.7, rest: 0.6, window: TOGETHER },
    Segment { to: fist(THUMB_RAISED), r#move: 0.7, rest: 0.0, window: TOGETHER },
    Segment { to: OPEN, r#move: 1.5, rest: 0.0, window: THUMB_FIRST },
];

const COUNT: [Segment; 6] = [
    Segment { to: fist(THUMB_BESIDE), r#move: 1.3, rest: 0.4, window: FINGERS_FIRST },
    count(1),
    count(2),
    count(3),
    count(4),
    Segment { to: OPEN, r#move: 0.9, rest: 0.5, window: TOGETHER },
];

const WAVE: [Segment; 2] = {
    let to = posture([FRAC_PI_2, 0.0, 0.0, 0.0], [[0.0, 1.0, 0.9, 0.5]; 4]);
    let inwards = [[0.0, 1.0], [0.45, 1.0], [0.3, 0.85], [0.15, 0.7], [0.0, 0.55]];
    let outwards = [[0.0, 1.0], [0.0, 0.55], [0.15, 0.7], [0.3, 0.85], [0.45, 1.0]];
    [
        Segment { to, r#move: 1.8, rest: 0.2, window: inwards },
        Segment { to: OPEN, r#move: 1.8, rest: 0.0, window: outwards },
    ]
};

const fn posture(thumb: [f64; 4], fingers: [[f64; 4]; 4]) -> Posture {
    let mut q = [0.0; 20];
    let mut joint = 0;
    while joint < 4 {
        q[joint] = thumb[joint];
        let mut finger = 0;
        while finger < 4 {
            q[4 + finger * 4 + joint] = fingers[finger][joint];
            finger += 1;
        }
        joint += 1;
    }
    q
}

const fn fist(thumb: [f64; 4]) -> Posture {
    posture(thumb, [CURLED, CURLED, CURLED, CURLED_LITTLE])
}

/// `fingers` fingers straight, the index first, the rest curled and the thumb beside them.
const fn count(fingers: usize) -> Segment {
    let mut shape = [CURLED, CURLED, CURLED, CURLED_LITTLE];
    let mut finger = 0;
    while finger < fingers {
        shape[finger] = STRAIGHT;
        finger += 1;
    }
    Segment { to: posture(THUMB_BESIDE, shape), r#move: 0.9, rest: 0.4, window: TOGETHER }
}

const fn blend(from: Posture, to: Posture, s: f64) -> Posture {
    let mut q = from;
    let mut joint = 0;
    while joint < 20 {
        q[joint] += s * (to[joint] - q[joint]);
        joint += 1;
    }
    q
}
