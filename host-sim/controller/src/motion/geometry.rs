//! Forward kinematics: joints to frames, poses and twists. Inverse kinematics are in `inverse`.
//!
//! Trigonometry is from libm, not from the system, so poses, and with them the traces of soak runs, are identical on
//! every machine.

mod inverse;

pub(super) use inverse::{Branch, length};

pub(super) const JOINTS: usize = 6;

/// A position and an orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    rotation: [[f64; 3]; 3],
    origin: [f64; 3],
}

impl Pose {
    /// No translation, no rotation.
    pub const IDENTITY: Self =
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], origin: [0.0; 3] };

    /// The frame with this pose: X, Y, Z in m, then rotations about the fixed X, Y and Z axes in rad.
    pub fn from_pose(pose: &[f64; 6]) -> Self {
        let [x, y, z, rx, ry, rz] = *pose;
        let ((sx, cx), (sy, cy), (sz, cz)) = (libm::sincos(rx), libm::sincos(ry), libm::sincos(rz));
        let rotation = [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ];
        Self { rotation, origin: [x, y, z] }
    }

    /// The frame's pose, as [`Self::from_pose`] takes it.
    pub fn pose(&self) -> [f64; 6] {
        let r = &self.rotation;
        let ry = libm::asin((-r[2][0]).clamp(-1.0, 1.0));
        let rx = libm::atan2(r[2][1], r[2][2]);
        let rz = libm::atan2(r[1][0], r[0][0]);
        let [x, y, z] = self.origin;
        [x, y, z, rx, ry, rz]
    }

    /// `other`, given in this frame, transformed to the parent frame.
    pub fn then(&self, other: &Self) -> Self {
        let [x, y, z] = self.rotated(&other.origin);
        let [ox, oy, oz] = self.origin;
        let column = |nth: usize| self.rotated(&other.rotation.map(|row| row[nth]));
        let (a, b, c) = (column(0), column(1), column(2));
        Self { rotation: [0, 1, 2].map(|row| [a[row], b[row], c[row]]), origin: [ox + x, oy + y, oz + z] }
    }

    /// A force (N) and torque (Nm) given in this frame, transformed to the parent frame.
    pub fn wrench_in_parent(&self, wrench: [f64; 6]) -> [f64; 6] {
        let [fx, fy, fz, tx, ty, tz] = wrench;
        let (force, torque) = (self.rotated(&[fx, fy, fz]), self.rotated(&[tx, ty, tz]));
        let lever = cross(&self.origin, &force);
        let [fx, fy, fz] = force;
        [fx, fy, fz, torque[0] + lever[0], torque[1] + lever[1], torque[2] + lever[2]]
    }

    /// A vector given in this frame's axes, rotated to the parent's.
    pub(super) fn rotated(&self, vector: &[f64; 3]) -> [f64; 3] {
        self.rotation.map(|row| row.iter().zip(vector).map(|(a, b)| a * b).sum())
    }

    /// A frame with this origin and no rotation.
    pub(super) fn at(origin: [f64; 3]) -> Self {
        Self { origin, ..Self::IDENTITY }
    }

    /// A frame moved by this vector and without rotation, both in the parent's axes.
    pub(super) fn shifted(&self, way: [f64; 3]) -> Self {
        Self::at([0, 1, 2].map(|nth| self.origin[nth] + way[nth]))
    }

    /// The base and the end of each link at joint positions `q`; the last is the flange.
    pub(super) fn along(q: &[f64; JOINTS]) -> [Self; JOINTS + 1] {
        let mut frames = [Self::IDENTITY; JOINTS + 1];
        for (nth, (&angle, link)) in q.iter().zip(&LINKS).enumerate() {
            frames[nth + 1] = frames[nth].then(&link.at(angle));
        }
        frames
    }

    /// The flange at joint positions `q`.
    pub(super) fn of_joints(q: &[f64; JOINTS]) -> Self {
        q.iter().zip(&LINKS).fold(Self::IDENTITY, |frame, (&angle, link)| frame.then(&link.at(angle)))
    }
}

/// The TCP's linear and angular velocity in the base frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Twist(pub(super) [f64; 6]);

impl Twist {
    pub(super) fn of(q: &[f64; JOINTS], qd: &[f64; JOINTS], tool: &Pose) -> Self {
        let tip = Pose::of_joints(q).then(tool).origin;
        let mut twist = [0.0; 6];
        let mut frame = Pose::IDENTITY;
        for ((&angle, &speed), link) in q.iter().zip(qd).zip(&LINKS) {
            let axis = frame.rotation.map(|row| row[2]);
            let arm = [0, 1, 2].map(|nth| tip[nth] - frame.origin[nth]);
            for (sum, part) in twist.iter_mut().zip(cross(&axis, &arm).iter().chain(&axis)) {
                *sum += speed * part;
            }
            frame = frame.then(&link.at(angle));
        }
        Self(twist)
    }
}

fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Denavit-Hartenberg parameters of one link: rotation about Z, `d_m` along Z, `a_m` along X, twist about X.
struct DhParameters {
    d_m: f64,
    a_m: f64,
    /// Sine and cosine of the twist, which is 0 or ±90°.
    twist: (f64, f64),
}

impl DhParameters {
    fn at(&self, angle: f64) -> Pose {
        let (s, c) = libm::sincos(angle);
        let (st, ct) = self.twist;
        Pose {
            rotation: [[c, -s * ct, s * st], [s, c * ct, -c * st], [0.0, st, ct]],
            origin: [self.a_m * c, self.a_m * s, self.d_m],
        }
    }
}

const UP: (f64, f64) = (1.0, 0.0);
const STRAIGHT: (f64, f64) = (0.0, 1.0);
const DOWN: (f64, f64) = (-1.0, 0.0);

const LINKS: [DhParameters; JOINTS] = [
    DhParameters { d_m: 0.145, a_m: 0.0, twist: UP },
    DhParameters { d_m: 0.0, a_m: -0.43, twist: STRAIGHT },
    DhParameters { d_m: 0.0, a_m: -0.365, twist: STRAIGHT },
    DhParameters { d_m: 0.125, a_m: 0.0, twist: UP },
    DhParameters { d_m: 0.11, a_m: 0.0, twist: DOWN },
    DhParameters { d_m: 0.1, a_m: 0.0, twist: STRAIGHT },
];
