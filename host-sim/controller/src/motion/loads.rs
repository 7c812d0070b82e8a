//! Forces of the arm's own weight and its payload: what a sensor at flange or base would show without contact.

use super::geometry::{JOINTS, Pose};

/// What the flange carries.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Payload {
    /// Mass, kg.
    pub mass_kg: f64,
    /// Centre of mass in the flange's frame, m.
    pub centre_m: [f64; 3],
}

/// Forces in N and torques in Nm, X, Y, Z.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Loads {
    /// On the flange, in its frame: the payload's weight and inertia.
    pub flange: [f64; 6],
    /// On the base, in its frame: payload and links.
    pub base: [f64; 6],
}

impl Loads {
    /// The loads at these joint positions (rad) and this linear acceleration of the TCP (m/s²), which is taken for that
    /// of the payload. The inertia of the links is ignored.
    pub fn of(joints: &[f64; JOINTS], acceleration: [f64; 3], payload: &Payload) -> Self {
        let frames = Pose::along(joints);
        let flange = frames[JOINTS];
        let [ax, ay, az] = acceleration;
        let force = [-ax, -ay, -az - GRAVITY].map(|item| item * payload.mass_kg);
        let pull = flange.inverse().rotated(&force);
        let place = Pose::at(payload.centre_m);
        let [x, y, z] = pull;
        let on_flange = place.wrench_in_parent([x, y, z, 0.0, 0.0, 0.0]);
        let mut base = flange.wrench_in_parent(on_flange);
        for (pair, mass_kg) in frames.windows(2).zip(LINK_KG) {
            let [before, after] = pair else { continue };
            let middle = before.way_to(after).map(|item| item / 2.0);
            let weight = [0.0, 0.0, -GRAVITY * mass_kg, 0.0, 0.0, 0.0];
            let own = before.shifted(middle).wrench_in_parent(weight);
            base.iter_mut().zip(own).for_each(|(sum, item)| *sum += item);
        }
        Self { flange: on_flange, base }
    }
}

/// m/s².
const GRAVITY: f64 = 9.81;
/// Masses of the links of a generic arm of this reach, kg, each at the midpoint between its axes.
const LINK_KG: [f64; JOINTS] = [4.5, 7.5, 3.8, 1.4, 1.4, 0.4];

#[cfg(test)]
mod tests {
    use super::super::HOME;
    use super::*;

    #[test]
    fn weight_pulls_down_at_flange_and_base() {
        let payload = Payload { mass_kg: 2.0, centre_m: [0.0, 0.0, 0.1] };
        let joints = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1];
        let loads = Loads::of(&joints, [0.0; 3], &payload);
        let flange = Pose::along(&joints)[JOINTS];
        let [x, y, z, tx, ty, tz] = loads.flange;
        let down = flange.rotated(&[x, y, z]);
        assert!(down[0].abs() + down[1].abs() < 1e-9 && (down[2] + 19.62).abs() < 1e-9, "{loads:?}");
        // The torque is that of the lever, across the force.
        assert!(((tx * tx + ty * ty).sqrt() - 0.1 * (x * x + y * y).sqrt()).abs() < 1e-9 && tz == 0.0);
        let all: f64 = LINK_KG.iter().sum();
        let [x, y, z, ..] = loads.base;
        assert!(x.abs() + y.abs() < 1e-9 && (z + (all + 2.0) * GRAVITY).abs() < 1e-9, "{loads:?}");
        assert!(loads.base[4].abs() > 20.0, "the arm leans to one side: {loads:?}");
        let empty = Loads::of(&HOME, [0.0; 3], &Payload::default());
        assert_eq!(empty.flange, [0.0; 6]);
        // Upwards it is heavier, in free fall it weighs nothing.
        assert!(Loads::of(&joints, [0.0, 0.0, 1.0], &payload).base[2] < loads.base[2] - 1.9);
        assert!(
            Loads::of(&joints, [0.0, 0.0, -GRAVITY], &payload).flange.iter().all(|item| item.abs() < 1e-9)
        );
    }
}
