//! Inverse kinematics: from the flange's frame to the joints.
//!
//! The arm has three parallel axes in the middle, and the last two axes of its wrist cross the others at right angles.
//! Each frame thus has up to eight exact solutions, which [`Branch`] distinguishes.

use super::{JOINTS, LINKS, Pose, cross};

/// One of the solutions: shoulder, elbow and wrist can each be in two positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::motion) struct Branch {
    shoulder: Way,
    elbow: Way,
    wrist: Way,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    One,
    Other,
}

impl Way {
    fn of(self, angle: f64) -> f64 {
        match self {
            Self::One => angle,
            Self::Other => -angle,
        }
    }
}

impl Branch {
    pub(in crate::motion) fn all() -> impl Iterator<Item = Self> {
        let ways = [Way::One, Way::Other];
        let pairs = ways.into_iter().flat_map(move |shoulder| ways.map(|elbow| (shoulder, elbow)));
        pairs.flat_map(move |(shoulder, elbow)| ways.map(|wrist| Self { shoulder, elbow, wrist }))
    }
}

impl Pose {
    /// The joint positions, in rad and within one turn, at which the flange has this frame; `None` if the arm does not
    /// reach it, or if joint 5 is straight, which leaves joint 6 undefined.
    pub(in crate::motion) fn joints(&self, branch: Branch) -> Option<[f64; JOINTS]> {
        let [base, upper, fore, side, wrist, flange] = &LINKS;
        let r = &self.rotation;
        let [x, y, _] = self.origin;
        // The last two axes cross here.
        let (wx, wy) = (x - flange.d_m * r[0][2], y - flange.d_m * r[1][2]);
        let aside = checked_acos(side.d_m / libm::hypot(wx, wy))?;
        let q1 = libm::atan2(wy, wx) + branch.shoulder.of(aside) + std::f64::consts::FRAC_PI_2;
        let (s1, c1) = libm::sincos(q1);
        let q5 = branch.wrist.of(checked_acos((x * s1 - y * c1 - side.d_m) / flange.d_m)?);
        let s5 = libm::sin(q5);
        if s5.abs() < STRAIGHT_WRIST {
            return None;
        }
        let q6 = libm::atan2((-r[0][1] * s1 + r[1][1] * c1) / s5, (r[0][0] * s1 - r[1][0] * c1) / s5);
        // The part of the three parallel axes, seen from the first link.
        let after = wrist.at(q5).then(&flange.at(q6));
        let middle = base.at(q1).inverse().then(self).then(&after.inverse());
        let [px, py, _] = middle.origin;
        let (a2, a3) = (upper.a_m, fore.a_m);
        let q3 = branch.elbow.of(checked_acos((px * px + py * py - a2 * a2 - a3 * a3) / (2.0 * a2 * a3))?);
        let (s3, c3) = libm::sincos(q3);
        let q2 = libm::atan2(py, px) - libm::atan2(a3 * s3, a2 + a3 * c3);
        let q4 = libm::atan2(middle.rotation[1][0], middle.rotation[0][0]) - q2 - q3;
        Some([q1, q2, q3, q4, q5, q6])
    }

    /// The inverse of this frame.
    pub(in crate::motion) fn inverse(&self) -> Self {
        let r = &self.rotation;
        let rotation = [0, 1, 2].map(|row| [r[0][row], r[1][row], r[2][row]]);
        let turned = Self { rotation, origin: [0.0; 3] };
        let [x, y, z] = turned.rotated(&self.origin);
        Self { origin: [-x, -y, -z], ..turned }
    }

    /// The vector from this frame's origin to the other's, in the parent's axes, m.
    pub(in crate::motion) fn way_to(&self, other: &Self) -> [f64; 3] {
        [0, 1, 2].map(|nth| other.origin[nth] - self.origin[nth])
    }

    /// The axis, in this frame, and the angle (0..=π) of the rotation to the other frame.
    pub(in crate::motion) fn turn_to(&self, other: &Self) -> ([f64; 3], f64) {
        let r = self.inverse().then(other).rotation;
        let vector = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]];
        let sine = length(&vector) / 2.0;
        let cosine = (r[0][0] + r[1][1] + r[2][2] - 1.0) / 2.0;
        let angle = libm::atan2(sine, cosine);
        if sine > 1e-7 {
            return (vector.map(|item| item / (2.0 * sine)), angle);
        }
        if cosine > 0.0 {
            return ([0.0, 0.0, 1.0], 0.0);
        }
        // Half a turn: (R + 1) / 2 is the product of the axis with itself.
        let largest = [0, 1, 2].into_iter().max_by(|&a, &b| r[a][a].total_cmp(&r[b][b])).unwrap_or(0);
        let mut axis = [0, 1, 2].map(|row| r[row][largest] / 2.0);
        axis[largest] += 0.5;
        let length = length(&axis);
        (axis.map(|item| item / length), angle)
    }

    /// This frame moved by `way` in the parent's axes and rotated about an axis of its own.
    pub(in crate::motion) fn moved(&self, way: [f64; 3], axis: &[f64; 3], angle: f64) -> Self {
        let (s, c) = libm::sincos(angle);
        let columns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|unit| {
            let side = cross(axis, &unit);
            let along: f64 = axis.iter().zip(&unit).map(|(a, b)| a * b).sum();
            [0, 1, 2].map(|nth| unit[nth] * c + side[nth] * s + axis[nth] * along * (1.0 - c))
        });
        let turn =
            Self { rotation: [0, 1, 2].map(|row| columns.map(|column| column[row])), origin: [0.0; 3] };
        let turned = self.then(&turn);
        Self { origin: [0, 1, 2].map(|nth| self.origin[nth] + way[nth]), ..turned }
    }
}

pub(in crate::motion) fn length(vector: &[f64; 3]) -> f64 {
    vector.iter().map(|item| item * item).sum::<f64>().sqrt()
}

/// Arc cosine; `None` outside -1..=1, with a tolerance for rounding errors.
fn checked_acos(cosine: f64) -> Option<f64> {
    (cosine.abs() <= 1.0 + 1e-12).then(|| libm::acos(cosine.clamp(-1.0, 1.0)))
}

/// Sine of joint 5 below which it counts as straight.
const STRAIGHT_WRIST: f64 = 1e-6;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_solution_leads_back_to_its_frame() {
        let mut found = 0;
        let mut angle = 0.1_f64;
        for _ in 0..200 {
            let q: [f64; 6] = std::array::from_fn(|_| {
                angle = (angle * 7.13 + 1.7) % 6.0;
                angle - 3.0
            });
            let frame = Pose::of_joints(&q);
            let solutions: Vec<_> = Branch::all().filter_map(|branch| frame.joints(branch)).collect();
            found += solutions.len();
            for solution in &solutions {
                let back = Pose::of_joints(solution);
                let apart = length(&frame.way_to(&back)) + frame.turn_to(&back).1;
                assert!(apart < 1e-6, "{q:?} {solution:?}: {apart}");
            }
            let is_own =
                |solution: &[f64; 6]| solution.iter().zip(&q).all(|(a, b)| libm::cos(a - b) > 1.0 - 1e-9);
            assert!(solutions.iter().any(is_own), "{q:?} is none of its own solutions: {solutions:?}");
        }
        assert!(found > 800, "{found}");
    }

    #[test]
    fn frames_are_undone_and_moved() {
        let a = Pose::from_pose(&[0.3, -0.2, 0.5, 0.4, -1.1, 2.0]);
        for pose in [[0.1, 0.2, -0.3, 3.0, 0.2, 0.1], [0.1, 0.0, 0.0, std::f64::consts::PI, 0.0, 0.0]] {
            let b = a.then(&Pose::from_pose(&pose));
            let (axis, angle) = a.turn_to(&b);
            let moved = a.moved(a.way_to(&b), &axis, angle);
            assert!(length(&moved.way_to(&b)) < 1e-12 && moved.turn_to(&b).1 < 1e-7, "{pose:?}");
        }
        let none = a.then(&a.inverse());
        assert!(length(&none.way_to(&Pose::IDENTITY)) < 1e-12);
        assert_eq!(a.turn_to(&a).1, 0.0);
    }
}
