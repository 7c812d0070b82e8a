//! The arm: positions of its joints at any instant, and the values derived from them
//! (docs/simulated-controller.md section 3).
//!
//! In: moves, the rate of motion, an instant. Out: positions, speeds, torques and the TCP's pose. Does not know
//! programs, registers or states. Everything is a closed formula of time: nothing is stepped, and the same instant
//! always gives the same numbers.
//!
//! The geometry is that of a generic six-axis cobot with a reach of about 0.9 m, not the calibration of a product.

mod clock;
mod geometry;
mod line;
mod loads;

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};

use proto_core::time::Instant;

use clock::PathClock;
pub use geometry::Pose;
use geometry::{JOINTS, Twist};
use line::LinearPath;
pub use line::MAX_SPEED_M_S;
pub use loads::{Loads, Payload};

/// The arm's motion.
#[derive(Debug, Clone)]
pub struct Arm {
    /// Joint positions at the start of the present move, rad.
    origin: [f64; JOINTS],
    /// Joint travel of the present move, rad.
    travel: [f64; JOINTS],
    /// The present move, if it is a line; `travel` is then zero.
    line: Option<Box<LinearPath>>,
    /// Duration of the present move at full rate, s; 0 if there is none.
    length_s: f64,
    clock: PathClock,
    /// Offset of the pose, which allows an initial pose to be configured.
    pose_offset: [f64; 6],
}

/// Why a move is refused.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum MoveError {
    /// A joint would leave its range.
    JointRange {
        /// 1-based.
        joint: usize,
        /// The requested position, rad.
        position_rad: f64,
    },
    /// The speed is not within (0, [`MAX_SPEED_RAD_S`]].
    Speed {
        /// The requested speed, rad/s.
        speed_rad_s: f64,
    },
    /// The speed of a line is not within (0, [`MAX_SPEED_M_S`]].
    LineSpeed {
        /// The requested speed, m/s.
        speed_m_s: f64,
    },
    /// The pose has a value that is not finite.
    Pose,
    /// The arm does not reach a point of the line.
    OutOfReach {
        /// The point's distance from the start of the line, m.
        way_m: f64,
    },
    /// A joint would have to jump: the line passes through a singular pose, where the wrist or the elbow is straight.
    Singular {
        /// The point's distance from the start of the line, m.
        way_m: f64,
    },
    /// A joint would be faster than [`MAX_SPEED_RAD_S`].
    JointSpeed {
        /// 1-based.
        joint: usize,
        /// Its speed on the line, rad/s.
        speed_rad_s: f64,
    },
}

impl std::fmt::Display for MoveError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::JointRange { joint, position_rad } => {
                write!(f, "joint {joint}: {position_rad} rad is outside ±{JOINT_RANGE_RAD:.4} rad")
            }
            Self::Speed { speed_rad_s } => {
                write!(f, "speed {speed_rad_s} rad/s is not within (0, {MAX_SPEED_RAD_S:.4}]")
            }
            Self::LineSpeed { speed_m_s } => {
                write!(f, "speed {speed_m_s} m/s is not within (0, {MAX_SPEED_M_S}]")
            }
            Self::Pose => f.write_str("the pose is not finite"),
            Self::OutOfReach { way_m } => {
                write!(f, "the arm does not reach the line {way_m:.3} m from its start")
            }
            Self::Singular { way_m } => {
                write!(f, "a joint would jump {way_m:.3} m from the start: wrist or elbow is straight there")
            }
            Self::JointSpeed { joint, speed_rad_s } => {
                write!(f, "joint {joint} would need {speed_rad_s:.3} rad/s; it has {MAX_SPEED_RAD_S:.4}")
            }
        }
    }
}

impl std::error::Error for MoveError {}

/// The arm's state at one instant. The seventh item of each joint group is reserved and 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ArmState {
    /// rad.
    pub position: [f32; 7],
    /// rad/s.
    pub velocity: [f32; 7],
    /// rad/s².
    pub acceleration: [f32; 7],
    /// Nm.
    pub torque: [f32; 7],
    /// Per mille of the rated current.
    pub current: [f32; 7],
    /// °C.
    pub temperature: [f32; 7],
    /// X, Y, Z in m, Rx, Ry, Rz in rad, in the base frame.
    pub pose: [f32; 6],
    /// m/s, rad/s.
    pub tcp_velocity: [f32; 6],
    /// m/s², rad/s².
    pub tcp_acceleration: [f32; 6],
}

/// How fast the arm comes to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Braking {
    /// At a pause or the end of a program: from full speed to rest in 100 ms.
    Normal,
    /// At an emergency stop: four times as fast.
    Hard,
}

impl Arm {
    /// An arm at rest with these joint positions, rad.
    pub fn at(joints: [f64; JOINTS]) -> Self {
        Self {
            origin: joints,
            travel: [0.0; JOINTS],
            line: None,
            length_s: 0.0,
            clock: PathClock::stopped(),
            pose_offset: [0.0; 6],
        }
    }

    /// Sets the pose offset for the present pose to become `pose`; `None` items stay.
    pub fn calibrate(&mut self, pose: [Option<f64>; 6], tool: &Pose) {
        let computed = Pose::of_joints(&self.origin).then(tool).pose();
        for ((offset, wanted), computed) in self.pose_offset.iter_mut().zip(pose).zip(computed) {
            if let Some(wanted) = wanted {
                *offset = wanted - computed;
            }
        }
    }

    /// Starts a move to `target` rad, at rest at both ends, no joint faster than `speed_rad_s`.
    ///
    /// # Errors
    /// [`MoveError`]: nothing changed.
    pub fn move_to(
        &mut self,
        now: Instant,
        target: [f64; JOINTS],
        speed_rad_s: f64,
        rate: f64,
    ) -> Result<(), MoveError> {
        for (nth, &position_rad) in target.iter().enumerate() {
            if position_rad.is_nan() || position_rad.abs() > JOINT_RANGE_RAD {
                return Err(MoveError::JointRange { joint: nth + 1, position_rad });
            }
        }
        if speed_rad_s.is_nan() || speed_rad_s <= 0.0 || speed_rad_s > MAX_SPEED_RAD_S {
            return Err(MoveError::Speed { speed_rad_s });
        }
        self.settle(now);
        let mut longest = 0.0_f64;
        for ((travel, &to), &from) in self.travel.iter_mut().zip(&target).zip(&self.origin) {
            *travel = to - from;
            longest = longest.max(travel.abs());
        }
        self.length_s =
            (PEAK_SPEED * longest / speed_rad_s).max((PEAK_ACCELERATION * longest / MAX_ACCEL_RAD_S2).sqrt());
        // The profile starts from rest, so the rate needs no ramp.
        self.clock = PathClock::running(now, rate);
        Ok(())
    }

    /// Starts a straight line of the TCP to `pose` (X, Y, Z in m, Rx, Ry, Rz in rad), at rest at both ends, the
    /// TCP no faster than `speed_m_s`.
    ///
    /// # Errors
    /// [`MoveError`]: nothing changed.
    pub fn move_along(
        &mut self,
        now: Instant,
        pose: [f64; 6],
        speed_m_s: f64,
        tool: &Pose,
        rate: f64,
    ) -> Result<(), MoveError> {
        if pose.iter().any(|item| !item.is_finite()) {
            return Err(MoveError::Pose);
        }
        let computed = std::array::from_fn(|nth| pose[nth] - self.pose_offset[nth]);
        let from = self.joints(now).0;
        let line = LinearPath::plan(&from, &Pose::from_pose(&computed), tool, speed_m_s)?;
        self.settle(now);
        self.length_s = line.length_s;
        self.line = Some(Box::new(line));
        self.clock = PathClock::running(now, rate);
        Ok(())
    }

    /// Continues the present move at this fraction of its planned speed; 0 stops it.
    pub fn set_rate(&mut self, now: Instant, rate: f64, braking: Braking) {
        self.clock.set_rate(now, rate, braking);
    }

    /// Ends the present move: the arm stays where it is.
    pub fn settle(&mut self, now: Instant) {
        self.origin = self.joints(now).0;
        self.travel = [0.0; JOINTS];
        self.line = None;
        self.length_s = 0.0;
        self.clock = PathClock::stopped();
    }

    /// When the present move ends at the present rate; `None` if it does not.
    pub fn arrival(&self) -> Option<Instant> {
        self.clock.reaches(self.length_s)
    }

    /// When the arm comes to rest at the present rate; `None` if it does not.
    pub fn rest(&self) -> Option<Instant> {
        match (self.clock.halts(), self.arrival()) {
            (Some(halt), Some(arrival)) => Some(halt.min(arrival)),
            (halt, arrival) => halt.or(arrival),
        }
    }

    /// The arm's state at `now`, with this tool and payload (kg).
    pub fn observe(&self, now: Instant, tool: &Pose, payload_kg: f64) -> ArmState {
        let (q, qd, qdd) = self.joints(now);
        let flange = Pose::of_joints(&q).then(tool);
        let mut pose = flange.pose();
        for (item, offset) in pose.iter_mut().zip(&self.pose_offset) {
            *item += offset;
        }
        let twist = Twist::of(&q, &qd, tool);
        // The twist a little later, to compute its derivative.
        let (mut q_next, mut qd_next) = (q, qd);
        for nth in 0..JOINTS {
            q_next[nth] += qd[nth] * STEP_S;
            qd_next[nth] += qdd[nth] * STEP_S;
        }
        let later = Twist::of(&q_next, &qd_next, tool);
        let mut state = ArmState::default();
        for nth in 0..JOINTS {
            state.position[nth] = q[nth] as f32;
            state.velocity[nth] = qd[nth] as f32;
            state.acceleration[nth] = qdd[nth] as f32;
            let torque = torque(nth, &q, &qd, &qdd, payload_kg);
            state.torque[nth] = torque as f32;
            state.current[nth] = (torque / RATED_TORQUE[nth] * 1000.0) as f32;
            state.temperature[nth] = TEMPERATURE[nth];
            state.pose[nth] = pose[nth] as f32;
            state.tcp_velocity[nth] = twist.0[nth] as f32;
            state.tcp_acceleration[nth] = ((later.0[nth] - twist.0[nth]) / STEP_S) as f32;
        }
        state
    }

    /// Position, velocity and acceleration of every joint.
    fn joints(&self, now: Instant) -> ([f64; JOINTS], [f64; JOINTS], [f64; JOINTS]) {
        let mut q = self.origin;
        let (mut qd, mut qdd) = ([0.0; JOINTS], [0.0; JOINTS]);
        if self.length_s <= 0.0 {
            return (q, qd, qdd);
        }
        let path = self.clock.at(now);
        let x = path.position_s / self.length_s;
        if let Some(line) = &self.line {
            if x >= 1.0 {
                return (line.end(), qd, qdd);
            }
            let [q, first, second] = line.at(x);
            let (dx, ddx) = (path.rate / self.length_s, path.rate_change / self.length_s);
            for nth in 0..JOINTS {
                qd[nth] = first[nth] * dx;
                qdd[nth] = second[nth] * dx * dx + first[nth] * ddx;
            }
            return (q, qd, qdd);
        }
        if x >= 1.0 {
            for (q, travel) in q.iter_mut().zip(&self.travel) {
                *q += travel;
            }
            return (q, qd, qdd);
        }
        let s = quintic(x);
        let ds = 30.0 * x * x * (1.0 - x) * (1.0 - x) / self.length_s;
        let dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (self.length_s * self.length_s);
        for nth in 0..JOINTS {
            q[nth] += self.travel[nth] * s;
            qd[nth] = self.travel[nth] * ds * path.rate;
            qdd[nth] = self.travel[nth] * (dds * path.rate * path.rate + ds * path.rate_change);
        }
        (q, qd, qdd)
    }
}

/// The quintic from 0 to 1 with zero speed and acceleration at both ends.
fn quintic(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

/// A plausible torque: gravity on the three pitching joints, inertia and viscous friction.
fn torque(nth: usize, q: &[f64], qd: &[f64], qdd: &[f64], payload_kg: f64) -> f64 {
    let load = payload_kg * 9.81;
    let (upper, fore, wrist) = (libm::cos(q[1]), libm::cos(q[1] + q[2]), libm::cos(q[1] + q[2] + q[3]));
    let at_wrist = (1.2 + 0.1 * load) * wrist;
    let at_elbow = (11.0 + 0.37 * load) * fore + at_wrist;
    let gravity = match nth {
        1 => (38.0 + 0.43 * load) * upper + at_elbow,
        2 => at_elbow,
        3 => at_wrist,
        _ => 0.0,
    };
    gravity + INERTIA[nth] * qdd[nth] + FRICTION[nth] * qd[nth]
}

/// Joint positions at the start, unless configured, rad.
pub const HOME: [f64; JOINTS] = [0.0, -FRAC_PI_4, -FRAC_PI_2, -FRAC_PI_4, FRAC_PI_2, 0.0];
/// Maximum joint position in both directions, rad.
pub const JOINT_RANGE_RAD: f64 = 2.0 * std::f64::consts::PI;
/// Maximum speed of a move, rad/s.
pub const MAX_SPEED_RAD_S: f64 = std::f64::consts::PI;
/// Maximum acceleration of a move, rad/s².
const MAX_ACCEL_RAD_S2: f64 = 12.0;
/// Peak of the quintic's first derivative, 15/8.
const PEAK_SPEED: f64 = 1.875;
/// Peak of its second derivative, 10/√3.
const PEAK_ACCELERATION: f64 = 5.773_502_691_896_258;
/// Step of the difference quotient for the TCP's acceleration, s.
const STEP_S: f64 = 1e-5;
const INERTIA: [f64; JOINTS] = [3.0, 3.5, 1.4, 0.25, 0.2, 0.1];
const FRICTION: [f64; JOINTS] = [12.0, 12.0, 8.0, 3.0, 3.0, 2.0];
const RATED_TORQUE: [f64; JOINTS] = [150.0, 150.0, 110.0, 28.0, 28.0, 28.0];
const TEMPERATURE: [f32; JOINTS] = [31.0, 32.5, 32.0, 34.0, 34.5, 35.0];

#[cfg(test)]
mod tests;
