use super::*;

const TARGET: [f64; 6] = [1.0, -1.2, -1.0, 0.3, 0.9, -0.5];

fn ms(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn moving() -> Arm {
    let mut arm = Arm::at(HOME);
    arm.move_to(ms(0), TARGET, 1.0, 1.0).unwrap();
    arm
}

fn observe(arm: &Arm, now: Instant) -> ArmState {
    arm.observe(now, &Frame::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]), 1.5)
}

#[test]
fn a_move_starts_and_ends_at_rest_exactly_where_it_should() {
    let arm = moving();
    let end = arm.arrival().unwrap();
    assert_eq!(observe(&arm, ms(0)).position[1], HOME[1] as f32);
    assert_eq!(observe(&arm, ms(0)).velocity, [0.0; 7]);
    let state = observe(&arm, end);
    for (nth, &target) in TARGET.iter().enumerate() {
        assert!((f64::from(state.position[nth]) - target).abs() < 1e-6, "joint {nth}: {state:?}");
    }
    assert_eq!((state.velocity, state.acceleration), ([0.0; 7], [0.0; 7]));
    assert_eq!(state.tcp_velocity, [0.0; 6]);
    assert_eq!(state.position[6], 0.0);
}

#[test]
fn speeds_are_the_derivatives_of_positions_at_every_rate() {
    for at in [150_u64, 390, 430, 465, 700, 930, 1_200] {
        let mut arm = moving();
        for (change, rate) in [(400, 0.3), (900, 1.0)] {
            if at > change {
                arm.set_rate(ms(change), rate, Braking::Normal);
            }
        }
        let h = 0.002;
        let (before, state, after) =
            (observe(&arm, ms(at - 1)), observe(&arm, ms(at)), observe(&arm, ms(at + 1)));
        let near = |a: f32, b: f32, what: &str| {
            assert!((a - b).abs() < 0.02 + 0.02 * a.abs(), "{what} at {at} ms: {a} and {b}");
        };
        for nth in 0..6 {
            near(state.velocity[nth], (after.position[nth] - before.position[nth]) / h, "joint speed");
            near(
                state.acceleration[nth],
                (after.velocity[nth] - before.velocity[nth]) / h,
                "joint acceleration",
            );
            let by_difference = (after.tcp_velocity[nth] - before.tcp_velocity[nth]) / h;
            near(state.tcp_acceleration[nth], by_difference, "TCP acceleration");
        }
        for nth in 0..3 {
            near(state.tcp_velocity[nth], (after.pose[nth] - before.pose[nth]) / h, "TCP speed");
        }
        assert!(state.velocity.iter().all(|v| v.abs() <= 1.001), "{state:?}");
    }
}

#[test]
fn rate_zero_stops_on_the_path_and_the_rest_is_kept() {
    let mut arm = moving();
    let unhindered = arm.arrival().unwrap();
    arm.set_rate(ms(700), 0.0, Braking::Normal);
    assert_eq!((arm.arrival(), arm.rest()), (None, Some(ms(800))));
    let held = observe(&arm, ms(800));
    assert_eq!(held.velocity, [0.0; 7]);
    assert_eq!(observe(&arm, ms(60_000)), held);
    arm.set_rate(ms(60_000), 1.0, Braking::Normal);
    // The ramps down and up add up to full speed: only the time of the pause is lost.
    let expected = unhindered + ms(60_000).saturating_since(ms(700));
    let difference = arm.arrival().unwrap().as_micros().abs_diff(expected.as_micros());
    assert!(difference <= 2, "{difference} µs");
}

#[test]
fn a_hard_stop_takes_a_quarter_of_the_time() {
    let mut arm = moving();
    arm.set_rate(ms(700), 0.0, Braking::Hard);
    assert_eq!(arm.rest(), Some(ms(725)));
    arm.settle(ms(725));
    assert_eq!(arm.arrival().map(|_| ()), Some(()));
    assert_eq!(observe(&arm, ms(725)).velocity, [0.0; 7]);
}

#[test]
fn impossible_moves_change_nothing() {
    let mut arm = Arm::at(HOME);
    let mut target = TARGET;
    target[3] = 6.4;
    let refused = arm.move_to(ms(0), target, 1.0, 1.0);
    assert_eq!(refused, Err(MoveError::JointRange { joint: 4, position_rad: 6.4 }));
    for speed in [0.0, -1.0, 3.2, f64::NAN, f64::INFINITY] {
        assert!(matches!(arm.move_to(ms(0), TARGET, speed, 1.0), Err(MoveError::Speed { .. })), "{speed}");
    }
    target[3] = f64::NAN;
    assert!(arm.move_to(ms(0), target, 1.0, 1.0).is_err());
    assert_eq!(observe(&arm, ms(500)), observe(&Arm::at(HOME), ms(0)));
}

#[test]
fn a_configured_start_pose_is_exact() {
    let wanted = [-0.543_689, 0.576_287, 1.232_353, -1.570_197, -0.607_912, -0.458_957_f32];
    let mut arm = Arm::at(HOME);
    let tool = Frame::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]);
    arm.calibrate(wanted.map(|item| Some(f64::from(item))), &tool);
    assert_eq!(observe(&arm, ms(0)).pose, wanted);
}

#[test]
fn poses_survive_conversion_to_frames_and_back() {
    let pose = [0.1, -0.2, 0.3, -2.0, 0.7, 3.0];
    for (there, back) in pose.iter().zip(Frame::from_pose(&pose).pose()) {
        assert!((there - back).abs() < 1e-12, "{there} {back}");
    }
}
