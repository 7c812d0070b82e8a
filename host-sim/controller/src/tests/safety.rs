//! Safety states: what each forbids, and reduced speed. Speeds of programs, and the controller's start.

use proto_core::wire::state::{RobotState, SafetyState};

use super::machine::SafetyHold;
use super::*;

const LOOP: &str = "loop { wait_ms(10); }";

fn config() -> SimConfig {
    with_program(SimConfig::default(), "loop.jspf", LOOP)
}

fn hold(hold: SafetyHold) -> impl Fn(&mut TestController) {
    move |cell| cell.controller.hold_safety(cell.now, hold)
}

/// What brings the robot into a safety state.
type Cause = Box<dyn Fn(&mut TestController)>;

/// Each safety state with its cause, its code, the commands that it allows while the robot is on, enabled and
/// off, and whether it disables the robot.
fn states() -> Vec<(&'static str, Cause, u8, [bool; 4])> {
    let stop = |cell: &mut TestController| cell.controller.emergency_stop(cell.now);
    let recover = |cell: &mut TestController| {
        cell.controller.collide(cell.now, 1);
        cell.controller.clear_stop(cell.now);
    };
    vec![
        //                                                  code  [poweron, enable, run and resume, keeps enabled]
        ("run", Box::new(|_: &mut TestController| ()) as Cause, 5, [true, true, true, true]),
        ("reduce", Box::new(|cell| cell.controller.enter_reduced(cell.now)), 12, [true, true, true, true]),
        ("recovery", Box::new(recover), 6, [true, false, false, true]),
        ("stop 2", Box::new(|cell| cell.controller.collide(cell.now, 1)), 7, [true, false, false, true]),
        (
            "stop 1",
            Box::new(|cell| cell.controller.protective_stop(cell.now)),
            8,
            [true, false, false, false],
        ),
        ("stop 0", Box::new(stop), 9, [true, false, false, false]),
        ("wait", Box::new(hold(SafetyHold::Wait)), 2, [true, false, false, false]),
        ("config", Box::new(hold(SafetyHold::Config)), 3, [true, false, false, false]),
        ("model", Box::new(hold(SafetyHold::Model)), 10, [true, false, false, false]),
        ("update", Box::new(hold(SafetyHold::Update)), 15, [false, false, false, false]),
        ("fail", Box::new(hold(SafetyHold::Fail)), 14, [false, false, false, false]),
    ]
}

#[test]
fn each_safety_state_forbids_what_it_should() {
    for (name, cause, code, [poweron, enable, run, stays]) in states() {
        // Before the command, and without time for a recovery to end.
        let tried = |power: Power, program: &str, command: &str| {
            let mut cell = robot(&with_power(config(), power));
            let (c, d) = (cell.command_client(), cell.command_client());
            if !program.is_empty() {
                assert_eq!(cell.ask(c, "run(loop.jspf)"), "run start");
                assert_eq!(cell.order(c, "pause"), "pause success");
            }
            cause(&mut cell);
            let state = cell.ask(d, "state");
            let before = cell.now;
            let reply = cell.order(c, command);
            assert!(cell.now.saturating_since(before) < Duration::from_secs(1));
            (state, reply, cell)
        };
        let good = |good: bool| if good { "success" } else { "fail" };
        let (_, reply, _) = tried(Power::Off, "", "poweron");
        assert_eq!(reply, format!("poweron {}", good(poweron)), "{name}");
        let (_, reply, mut cell) = tried(Power::On, "", "enable");
        assert_eq!(reply, format!("enable {}", good(enable)), "{name}");
        if !enable {
            let c = cell.command_client();
            let error = cell.ask(c, "getlasterror");
            assert!(
                error.starts_with("2001:enable: a safety stop")
                    || error.starts_with("2001:enable: the safety")
            );
        }
        let (state, reply, _) = tried(Power::Enabled, "", "run(loop.jspf)");
        assert_eq!(state.split(':').nth(2), Some(code.to_string().as_str()), "{name}: {state}");
        assert_eq!(reply, if run { "run start" } else { "run fail" }, "{name}");
        let (_, reply, mut cell) = tried(Power::Enabled, "paused", "resume");
        assert_eq!(reply, format!("resume {}", good(run)), "{name}");
        cell.run_ms(1_000);
        let enabled = cell.controller.machine().robot() == RobotState::Enable;
        assert_eq!(enabled, stays, "{name}");
        // What takes power and motion away is allowed in every state.
        for (power, program, command) in [
            (Power::Enabled, "paused", "stop"),
            (Power::Enabled, "", "poweroff"),
            (Power::On, "", "poweroff"),
        ] {
            let (state, reply, _) = tried(power, program, command);
            let over = command == "stop" && state.split(':').nth(1) == Some("1");
            assert_eq!(reply, format!("{command} {}", good(!over)), "{name}");
        }
    }
}

#[test]
fn a_weaker_stop_does_not_replace_a_stronger_one() {
    let mut cell = robot(&config());
    let c = cell.command_client();
    let code = |cell: &TestController| cell.controller.machine().safety();
    cell.controller.collide(cell.now, 2);
    assert_eq!(code(&cell), SafetyState::Stop2);
    cell.controller.protective_stop(cell.now);
    assert_eq!(code(&cell), SafetyState::Stop1);
    cell.controller.emergency_stop(cell.now);
    cell.controller.collide(cell.now, 3);
    cell.controller.protective_stop(cell.now);
    assert_eq!(code(&cell), SafetyState::Stop0);
    assert_eq!(cell.ask(c, "getlasterror"), "3002:protective stop\n", "each is told");
    // The safety controller fails meanwhile, which shows once the stop is cleared.
    cell.controller.hold_safety(cell.now, SafetyHold::Fail);
    assert_eq!(code(&cell), SafetyState::Stop0);
    assert_eq!(cell.ask(c, "getlasterror"), "3004:the safety controller has failed\n");
    cell.controller.clear_stop(cell.now);
    cell.run_ms(300);
    assert_eq!(code(&cell), SafetyState::Fail);
    assert_eq!(cell.order(c, "poweroff"), "poweroff success");
    assert_eq!((cell.ask(c, "poweron").as_str(), code(&cell)), ("poweron fail", SafetyState::Fail));
    cell.controller.release_safety();
    assert_eq!((cell.order(c, "poweron").as_str(), code(&cell)), ("poweron success", SafetyState::Run));
}

#[test]
fn a_failure_of_the_safety_controller_stops_a_moving_arm() {
    let mut cell = robot(&with_program(config(), "m", "movej([1.0, 0, 0, 0, 0, 0], 1.0);"));
    let c = cell.command_client();
    cell.ask(c, "run(m)");
    cell.run_ms(1_000);
    assert_eq!(cell.ask(c, "disable"), "");
    cell.controller.hold_safety(cell.now, SafetyHold::Fail);
    cell.run_ms(25);
    assert_eq!(cell.controller.registers().arm().velocity, [0.0; 7]);
    cell.run_ms(100);
    assert_eq!(cell.take(c), b"disable success");
    assert_eq!(cell.ask(c, "state"), "5:0:14:2");
    assert_eq!(cell.controller.machine().robot_error().map(|id| id.code()), Some(0x3004));
    cell.controller.restart(cell.now);
    cell.run_ms(1_000);
    assert_eq!(cell.controller.machine().safety(), SafetyState::PowerOff, "a restart ends it");
}

#[test]
fn reduced_speed_outlasts_a_stop() {
    let mut cell = robot(&config());
    let safety = |cell: &TestController| cell.controller.machine().safety();
    cell.controller.collide(cell.now, 1);
    cell.controller.enter_reduced(cell.now);
    assert_eq!(safety(&cell), SafetyState::Stop2);
    cell.controller.clear_stop(cell.now);
    assert_eq!(safety(&cell), SafetyState::Recovery);
    cell.run_ms(200);
    assert_eq!((safety(&cell), cell.controller.machine().rate()), (SafetyState::Reduce, 0.25));
    cell.controller.emergency_stop(cell.now);
    cell.controller.leave_reduced(cell.now);
    cell.controller.clear_stop(cell.now);
    cell.run_ms(200);
    assert_eq!((safety(&cell), cell.controller.machine().rate()), (SafetyState::Run, 1.0));
}

#[test]
fn speed_and_reduced_speed_act_on_every_move_and_on_nothing_else() {
    let joints = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1];
    let start: Vec<_> = (1..).zip(joints).map(|(nth, value)| (format!("RobotState[{nth}]"), value)).collect();
    let start: Vec<_> = start.iter().map(|(name, value)| (name.as_str(), *value)).collect();
    let line = "let p = []; for n in 8..14 { p.push(get(`RobotState[${n}]`)); } p[2] += 0.2; movel(p, 0.8);";
    let turn = "movej([0.9, -1.2, 1.9, 0.7, 1.5, -0.1], 2.5);";
    let millis = |script: &str, run: &str, before: &dyn Fn(&mut TestController, ConnId)| {
        let config = with_initial(SimConfig::default(), &start);
        let mut cell = robot(&with_program(config, "t", script));
        let c = cell.command_client();
        before(&mut cell, c);
        assert_eq!(cell.ask(c, run), "run start");
        let begin = cell.now;
        while cell.ask(c, "isprogfinish") == "0" {
            cell.run_ms(1);
            assert!(cell.now < begin + Duration::from_secs(60), "it never ends");
        }
        cell.now.saturating_since(begin).as_millis()
    };
    let nothing = |_: &mut TestController, _: ConnId| ();
    for script in [line, turn] {
        let whole = millis(script, "run(t)", &nothing);
        let near = |slow: u64, times: u64| assert!(slow.abs_diff(times * whole) <= times, "{slow} {whole}");
        near(millis(script, "run(t,50)", &nothing), 2);
        near(millis(script, "run(t)", &|cell, c| assert_eq!(cell.ask(c, "speed(25)"), "set success")), 4);
        near(millis(script, "run(t)", &|cell, _| cell.controller.enter_reduced(cell.now)), 4);
        near(millis(script, "run(t,50)", &|cell, _| cell.controller.enter_reduced(cell.now)), 8);
        // An invalid speed leaves the present one.
        near(millis(script, "run(t,0)", &|cell, c| assert_eq!(cell.ask(c, "speed(50)"), "set success")), 2);
        // The speed of an earlier program stays.
        let earlier = |cell: &mut TestController, c: ConnId| {
            assert_eq!(cell.ask(c, "run(t,50)"), "run start");
            cell.run_ms(10);
            assert_eq!(cell.order(c, "stop"), "stop success");
        };
        assert!(millis(script, "run(t)", &earlier) > 19 * whole / 10);
    }
    assert_eq!(millis("wait_ms(500);", "run(t,10)", &nothing), 500, "waits are as long as they are");
}

#[test]
fn a_controller_boots_at_its_start_where_asked() {
    let toml = "[robot]\npower = \"boot\"\nmode = \"auto\"\n";
    let mut cell = TestController::from_toml(toml).unwrap();
    let c = cell.command_client();
    let mut states = Vec::new();
    for _ in 0..80 {
        let state = cell.ask(c, "state");
        if states.last() != Some(&state) {
            states.push(state);
        }
        cell.run_ms(10);
    }
    assert_eq!(states, ["0:0:13:1", "1:0:0:1", "2:0:0:1", "3:0:0:1", "4:0:4:1"]);
    assert_eq!(cell.order(c, "poweron"), "poweron success");
    // Commands fail until then, and the first call of the controller is its start.
    let mut config = with_power(SimConfig::default(), Power::Boot);
    config.robot.dialect = "v2.3".to_owned();
    let mut controller = Controller::new(&config).unwrap();
    assert_eq!(controller.machine().robot(), RobotState::Start);
    let late = Instant::from_millis(90_000);
    assert_eq!(
        controller.poll_output(late),
        ControllerOutput::Sleep { until: late + Duration::from_millis(200) }
    );
    let mut cell = robot(&config);
    let c = cell.command_client();
    for command in ["poweron", "poweroff", "enable", "shutdown"] {
        assert_eq!(cell.ask(c, command), format!("{command} fail"));
    }
}
