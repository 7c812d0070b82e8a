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
    arm.observe(now, &Pose::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]), 1.5)
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
    let tool = Pose::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]);
    arm.calibrate(wanted.map(|item| Some(f64::from(item))), &tool);
    assert_eq!(observe(&arm, ms(0)).pose, wanted);
}

#[test]
fn poses_survive_conversion_to_frames_and_back() {
    let pose = [0.1, -0.2, 0.3, -2.0, 0.7, 3.0];
    for (there, back) in pose.iter().zip(Pose::from_pose(&pose).pose()) {
        assert!((there - back).abs() < 1e-12, "{there} {back}");
    }
}

/// In front of the base, so that lines lead in all directions.
const WORK: [f64; 6] = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1];

#[test]
fn a_line_is_straight_and_as_fast_as_asked() {
    let tool = Pose::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]);
    let mut arm = Arm::at(WORK);
    let begin = observe(&arm, ms(0)).pose.map(f64::from);
    let way = [0.15, -0.2, 0.1];
    let mut target = begin;
    for (item, way) in target.iter_mut().zip(way) {
        *item += way;
    }
    target[5] += 0.6;
    arm.move_along(ms(0), target, 0.25, &tool, 1.0).unwrap();
    let end = arm.arrival().unwrap();
    let length = way.iter().map(|item| item * item).sum::<f64>().sqrt();
    let mut fastest = 0.0_f64;
    for at in (0..=end.as_micros()).step_by(5_000).chain([end.as_micros()]) {
        let state = observe(&arm, Instant::from_micros(at));
        let gone: [f64; 3] = std::array::from_fn(|nth| f64::from(state.pose[nth]) - begin[nth]);
        let along: f64 = gone.iter().zip(way).map(|(a, b)| a * b).sum::<f64>() / length;
        let aside: f64 = (gone.iter().map(|item| item * item).sum::<f64>() - along * along).max(0.0).sqrt();
        assert!(aside < 1e-3 * length, "{aside} m beside the line at {at} µs");
        let speed = state.tcp_velocity[..3].iter().map(|item| f64::from(*item).powi(2)).sum::<f64>().sqrt();
        fastest = fastest.max(speed);
        assert!(state.acceleration.iter().all(|item| item.abs() <= 12.1), "{state:?}");
    }
    assert!((0.249..0.2501).contains(&fastest), "{fastest} m/s");
    let state = observe(&arm, end);
    for (there, wanted) in state.pose.iter().zip(target) {
        assert!((f64::from(*there) - wanted).abs() < 1e-5, "{:?} {target:?}", state.pose);
    }
    assert_eq!((state.velocity, state.acceleration), ([0.0; 7], [0.0; 7]));
    arm.settle(end);
    assert_eq!(observe(&arm, end + proto_core::time::Duration::from_secs(9)), state);
}

#[test]
fn speeds_on_a_line_are_the_derivatives_of_its_positions() {
    for at in [150_u64, 390, 430, 465, 700, 930] {
        let mut arm = Arm::at(WORK);
        let mut target = observe(&arm, ms(0)).pose.map(f64::from);
        target[0] += 0.2;
        target[2] -= 0.1;
        target[4] += 0.4;
        let tool = Pose::from_pose(&[0.0, 0.02, 0.1, 0.1, 0.0, 0.3]);
        arm.move_along(ms(0), target, 0.3, &tool, 1.0).unwrap();
        if at > 400 {
            arm.set_rate(ms(400), 0.3, Braking::Normal);
        }
        let (before, state, after) =
            (observe(&arm, ms(at - 1)), observe(&arm, ms(at)), observe(&arm, ms(at + 1)));
        for nth in 0..6 {
            let speed = (after.position[nth] - before.position[nth]) / 0.002;
            assert!((speed - state.velocity[nth]).abs() < 1e-3, "{nth} at {at}: {speed} {state:?}");
            let acceleration = (after.velocity[nth] - before.velocity[nth]) / 0.002;
            let difference = (acceleration - state.acceleration[nth]).abs();
            assert!(difference < 0.02 + 0.02 * acceleration.abs(), "{nth} at {at}: {acceleration} {state:?}");
        }
    }
}

#[test]
fn a_line_that_cannot_be_followed_is_refused() {
    let tool = Pose::IDENTITY;
    let mut arm = Arm::at(WORK);
    let here = arm.observe(ms(0), &tool, 0.0).pose.map(f64::from);
    let to = |nth: usize, by: f64| {
        let mut pose = here;
        pose[nth] += by;
        pose
    };
    let mut refused = |pose, speed| arm.move_along(ms(0), pose, speed, &tool, 1.0).unwrap_err();
    let far = refused(to(0, 3.0), 0.5);
    assert!(matches!(far, MoveError::OutOfReach { way_m } if (0.05..1.5).contains(&way_m)), "{far}");
    for speed in [0.0, -1.0, 2.1, f64::NAN] {
        assert!(matches!(refused(to(0, 0.1), speed), MoveError::LineSpeed { .. }), "{speed}");
    }
    assert_eq!(refused(to(3, f64::INFINITY), 0.1), MoveError::Pose);
    assert_eq!(observe(&arm, ms(500)), observe(&Arm::at(WORK), ms(0)), "nothing has changed");

    // Joint 5 straight: joints 4 and 6 turn about the same axis.
    let mut straight = WORK;
    straight[4] = 0.0;
    let mut arm = Arm::at(straight);
    let mut pose = arm.observe(ms(0), &tool, 0.0).pose.map(f64::from);
    pose[2] += 0.05;
    assert_eq!(arm.move_along(ms(0), pose, 0.1, &tool, 1.0), Err(MoveError::Singular { way_m: 0.0 }));
    // Near it, joints become too fast.
    straight[4] = 0.02;
    let mut arm = Arm::at(straight);
    let mut pose = arm.observe(ms(0), &tool, 0.0).pose.map(f64::from);
    pose[3] += 0.8;
    pose[4] += 0.8;
    let fast = arm.move_along(ms(0), pose, 1.0, &tool, 1.0).unwrap_err();
    assert!(matches!(fast, MoveError::JointSpeed { .. } | MoveError::Singular { .. }), "{fast}");
    // A joint at the end of its range.
    let mut wound = WORK;
    wound[5] = JOINT_RANGE_RAD - 0.01;
    let mut arm = Arm::at(wound);
    let turns: Vec<_> = [0.5, -0.5]
        .map(|by| {
            let flange = arm.observe(ms(0), &tool, 0.0).pose.map(f64::from);
            let pose = Pose::from_pose(&flange).then(&Pose::from_pose(&[0.0, 0.0, 0.0, 0.0, 0.0, by])).pose();
            arm.clone().move_along(ms(0), pose, 0.5, &tool, 1.0).err()
        })
        .into();
    assert!(matches!(turns[0], Some(MoveError::JointRange { joint: 6, .. })), "{turns:?}");
    assert_eq!(turns[1], None);
    // A line to where the arm is takes no time.
    let here = arm.observe(ms(0), &tool, 0.0).pose.map(f64::from);
    arm.move_along(ms(0), here, 0.5, &tool, 1.0).unwrap();
    assert!(arm.arrival().unwrap() < ms(50), "{:?}", arm.arrival());
}
