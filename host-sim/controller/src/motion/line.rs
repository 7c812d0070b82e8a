//! A straight line of the TCP, as a path of the joints.
//!
//! The path is exact at every point: it uses the inverse kinematics on the branch of the arm at the start. The samples
//! only select the turn of each joint, and show whether the whole line can be followed.

use super::geometry::{Branch, JOINTS, Pose, length};
use super::{
    JOINT_RANGE_RAD, MAX_ACCEL_RAD_S2, MAX_SPEED_RAD_S, MoveError, PEAK_ACCELERATION, PEAK_SPEED, quintic,
};

/// The line, followed from rest to rest.
#[derive(Debug, Clone)]
pub(super) struct LinearPath {
    /// The TCP at the start.
    from: Pose,
    /// m, in the base frame.
    way: [f64; 3],
    /// Axis of the rotation in the TCP's frame at the start.
    axis: [f64; 3],
    angle: f64,
    /// From the TCP to the flange.
    flange: Pose,
    branch: Branch,
    /// Joints at equal steps of the move's time.
    samples: Vec<[f64; JOINTS]>,
    /// Duration at full rate, s; 0 if the target is reached at the start.
    pub(super) length_s: f64,
}

impl LinearPath {
    /// The line from the joints `from` to the TCP frame `to`.
    ///
    /// # Errors
    /// [`MoveError`] if it cannot be followed at this speed.
    pub(super) fn plan(
        from: &[f64; JOINTS],
        to: &Pose,
        tool: &Pose,
        speed_m_s: f64,
    ) -> Result<Self, MoveError> {
        if speed_m_s.is_nan() || speed_m_s <= 0.0 || speed_m_s > MAX_SPEED_M_S {
            return Err(MoveError::LineSpeed { speed_m_s });
        }
        let flange = Pose::of_joints(from);
        let tcp = flange.then(tool);
        let way = tcp.way_to(to);
        let (axis, angle) = tcp.turn_to(to);
        let way_m = length(&way);
        let length_s = [
            PEAK_SPEED * way_m / speed_m_s,
            PEAK_SPEED * angle / MAX_TURN_RAD_S,
            (PEAK_ACCELERATION * way_m / MAX_ACCEL_M_S2).sqrt(),
            (PEAK_ACCELERATION * angle / MAX_ACCEL_RAD_S2).sqrt(),
        ];
        let length_s = length_s.into_iter().fold(0.0, f64::max);
        // The solution that matches the arm now.
        let own = Branch::all().find(|&branch| {
            flange.joints(branch).is_some_and(|joints| {
                near(joints, from).iter().zip(from).all(|(a, b)| (a - b).abs() < SAME_RAD)
            })
        });
        let branch = own.ok_or(MoveError::Singular { way_m: 0.0 })?;
        let mut line = Self {
            from: tcp,
            way,
            axis,
            angle,
            flange: tool.inverse(),
            branch,
            samples: vec![*from],
            length_s,
        };
        for nth in 1..=SAMPLES {
            let x = nth as f64 / SAMPLES as f64;
            let at_m = way_m * quintic(x);
            let before = line.samples[nth - 1];
            let joints = line.solve(x).ok_or(MoveError::OutOfReach { way_m: at_m })?;
            let joints = near(joints, &before);
            if joints.iter().zip(&before).any(|(a, b)| (a - b).abs() > MAX_STEP_RAD) {
                // The joints are fast where the arm is stretched, at the end of its reach.
                let leads_out = line.solve(1.0).is_none();
                let way_m = at_m;
                return Err(if leads_out {
                    MoveError::OutOfReach { way_m }
                } else {
                    MoveError::Singular { way_m }
                });
            }
            for (nth, &position_rad) in joints.iter().enumerate() {
                if position_rad.abs() > JOINT_RANGE_RAD {
                    return Err(MoveError::JointRange { joint: nth + 1, position_rad });
                }
            }
            line.samples.push(joints);
        }
        line.limit()?;
        Ok(line)
    }

    /// Checks the joints' speeds, and lengthens the move as their accelerations require.
    fn limit(&mut self) -> Result<(), MoveError> {
        if self.length_s <= 0.0 {
            return Ok(());
        }
        let step_s = self.length_s / SAMPLES as f64;
        let mut acceleration = 0.0_f64;
        for three in self.samples.windows(3) {
            let [before, at, after] = three else { continue };
            for (nth, ((before, at), after)) in before.iter().zip(at).zip(after).enumerate() {
                let speed_rad_s = ((after - before) / (2.0 * step_s)).abs();
                if speed_rad_s > MAX_SPEED_RAD_S {
                    return Err(MoveError::JointSpeed { joint: nth + 1, speed_rad_s });
                }
                acceleration = acceleration.max(((after - 2.0 * at + before) / (step_s * step_s)).abs());
            }
        }
        self.length_s *= (acceleration / MAX_ACCEL_RAD_S2).sqrt().max(1.0);
        Ok(())
    }

    /// The joints at this fraction of the move's time, and their first two derivatives.
    pub(super) fn at(&self, x: f64) -> [[f64; JOINTS]; 3] {
        let here = self.joints(x);
        if x <= 0.0 || x >= 1.0 {
            return [here, [0.0; JOINTS], [0.0; JOINTS]];
        }
        let (before, after) = (self.joints(x - STEP), self.joints(x + STEP));
        let first = std::array::from_fn(|nth| (after[nth] - before[nth]) / (2.0 * STEP));
        let second = std::array::from_fn(|nth| (after[nth] - 2.0 * here[nth] + before[nth]) / (STEP * STEP));
        [here, first, second]
    }

    pub(super) fn end(&self) -> [f64; JOINTS] {
        self.samples.last().copied().unwrap_or_default()
    }

    fn joints(&self, x: f64) -> [f64; JOINTS] {
        let nearest = (x.clamp(0.0, 1.0) * SAMPLES as f64).round() as usize;
        let sample = self.samples.get(nearest).copied().unwrap_or_else(|| self.end());
        self.solve(x).map_or(sample, |joints| near(joints, &sample))
    }

    fn solve(&self, x: f64) -> Option<[f64; JOINTS]> {
        let s = quintic(x);
        let tcp = self.from.moved(self.way.map(|item| item * s), &self.axis, self.angle * s);
        tcp.then(&self.flange).joints(self.branch)
    }
}

/// The same joint positions, each in the turn that is nearest to `to`.
fn near(joints: [f64; JOINTS], to: &[f64; JOINTS]) -> [f64; JOINTS] {
    let turn = 2.0 * std::f64::consts::PI;
    std::array::from_fn(|nth| joints[nth] - ((joints[nth] - to[nth]) / turn).round() * turn)
}

/// Maximum speed of the TCP on a line, m/s.
pub const MAX_SPEED_M_S: f64 = 2.0;
/// Maximum acceleration of the TCP, m/s².
const MAX_ACCEL_M_S2: f64 = 8.0;
/// Maximum rotational speed of the tool, rad/s.
const MAX_TURN_RAD_S: f64 = std::f64::consts::FRAC_PI_2;
const SAMPLES: usize = 256;
/// A joint that turns farther than this between two samples jumps.
const MAX_STEP_RAD: f64 = 0.3;
/// Tolerance within which inverse kinematics return the original joints.
const SAME_RAD: f64 = 1e-5;
/// Step of the difference quotients.
const STEP: f64 = 1e-4;
