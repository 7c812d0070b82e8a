//! Functions of functional inputs, and states on functional outputs (D27).

use super::*;

/// Buttons on inputs of every kind, LEDs on outputs of every kind.
const CELL: &str = r#"
[robot]
power = "on"
[functions]
start = "work.jspf"
inputs = { "FDI[1]" = "start", "FDI[2]" = "stop", "BitInputReg[1].0" = "pause", "BitInputReg[2].7" = "resume", "ToolButton[1]" = "enable", "ToolButton[2]" = "disable", "FDI[8]" = "reset" }
outputs = { "FDO[1]" = "powered", "FDO[2]" = "enabled", "FDO[8]" = "running", "BitOutputReg[1].0" = "paused", "BitOutputReg[1].7" = "error", "BitOutputReg[2].0" = "emergency_stop", "BitOutputReg[2].7" = "remote" }
[[program]]
name = "work.jspf"
script = "loop { wait_ms(10); }"
"#;

/// The same LEDs as coils.
const LEDS: [(u8, &str); 7] = [
    (168, "powered"),
    (169, "enabled"),
    (175, "running"),
    (16, "paused"),
    (23, "error"),
    (24, "emergency_stop"),
    (31, "remote"),
];

/// The LEDs that are on, over Modbus and in the state stream, which must be the same.
#[track_caller]
fn leds(cell: &mut TestController) -> Vec<&'static str> {
    let on: Vec<_> = LEDS.iter().filter(|led| cell.coil(led.0)).map(|led| led.1).collect();
    let state = cell.state_client();
    cell.run_ms(100);
    let packet = cell.packets.last().unwrap().1;
    cell.close(state);
    let (io, registers) = (packet.functional_outputs, packet.functional_bool_outputs);
    let shown = |address: u8| match address {
        168.. => io[usize::from(address - 168)],
        _ => registers[usize::from(address - 16)],
    };
    let streamed: Vec<_> = LEDS.iter().filter(|led| shown(led.0) == 1).map(|led| led.1).collect();
    assert_eq!(on, streamed);
    on
}

fn press(cell: &mut TestController, name: &str) {
    cell.set_value(name, 1.0);
    cell.run_ms(400);
    cell.set_value(name, 0.0);
    cell.run_ms(100);
}

#[test]
fn inputs_trigger_functions_and_outputs_show_states() {
    let mut cell = TestController::from_toml(CELL).unwrap();
    let c = cell.command_client();
    assert_eq!(leds(&mut cell), ["powered", "remote"]);
    press(&mut cell, "ToolButton[1]");
    assert_eq!(leds(&mut cell), ["powered", "enabled", "remote"]);
    press(&mut cell, "FDI[1]");
    assert_eq!(cell.controller.program_name(), Some("work.jspf"));
    assert_eq!(leds(&mut cell), ["powered", "enabled", "running", "remote"]);
    // Registers are written over Modbus: coils 0 and 15.
    let m = cell.modbus_client();
    assert_eq!(cell.modbus(m, &[5, 0, 0, 0xFF, 0]), [5, 0, 0, 0xFF, 0]);
    cell.run_ms(100);
    assert_eq!(leds(&mut cell), ["powered", "enabled", "paused", "remote"]);
    cell.modbus(m, &[5, 0, 15, 0xFF, 0]);
    assert_eq!(leds(&mut cell), ["powered", "enabled", "running", "remote"]);
    press(&mut cell, "FDI[2]");
    assert_eq!(leds(&mut cell), ["powered", "enabled", "remote"]);
    cell.controller.set_mode(proto_core::wire::state::OperationMode::Manual);
    press(&mut cell, "ToolButton[2]");
    assert_eq!(leds(&mut cell), ["powered"]);
    assert_eq!(cell.order(c, "poweroff"), "poweroff success");
    assert_eq!(leds(&mut cell), [""; 0]);
}

#[test]
fn only_a_rising_edge_triggers() {
    let toml = CELL
        .replace("power = \"on\"", "power = \"enabled\"")
        .replace("[functions]", "[initial]\n\"FDI[1]\" = true\n[functions]");
    let mut cell = TestController::from_toml(&toml).unwrap();
    cell.run_ms(100);
    assert_eq!(cell.controller.program_name(), None, "on from the start: no edge");
    cell.set_value("FDI[1]", 0.0);
    cell.run_ms(100);
    assert_eq!(cell.controller.program_name(), None, "a falling edge does nothing");
    // A pulse that is over before the controller is asked again is seen.
    cell.set_value("FDI[1]", 1.0);
    cell.set_value("FDI[1]", 0.0);
    cell.run_ms(1);
    assert_eq!(cell.controller.program_name(), Some("work.jspf"));
    cell.set_value("FDI[2]", 1.0);
    cell.run_ms(100);
    assert_eq!(cell.controller.program_name(), None);
    press(&mut cell, "FDI[1]");
    assert_eq!(cell.controller.program_name(), Some("work.jspf"), "the stop is still on, but has no edge");
    // Nor does writing the same value again.
    cell.set_value("FDI[2]", 1.0);
    cell.run_ms(100);
    assert_eq!(cell.controller.program_name(), Some("work.jspf"));
    // A restart brings the initial value back, without an edge.
    cell.controller.restart(cell.now);
    cell.run_ms(2_000);
    assert_eq!((cell.value("FDI[1]"), cell.controller.program_name()), (1.0, None));
    assert_eq!(cell.controller.machine().error(), None);
}

#[test]
fn a_recipes_frame_triggers_and_shows_as_well() {
    let recipe = stream_recipe(Mode::Realtime, system(&["BitInputReg[1]"]), system(&["BitOutputReg[1]"]));
    let mut config = one_port(rs485(), recipe);
    let toml = recipe_config::file::parse_controller(
        recipe_config::file::Text { name: "cell", toml: &CELL.replace("\"on\"", "\"enabled\"") },
        &[],
    );
    let own = toml.unwrap();
    config.functions = own.functions;
    config.programs = own.programs;
    let mut cell = robot(&config);
    press(&mut cell, "FDI[1]");
    cell.sent.clear();
    cell.port_bytes(0, &[0xFF, 0xFF, 1, 0xEE, 0xEE]);
    cell.run_ms(100);
    assert_eq!(cell.controller.machine().program(), proto_core::wire::state::ProgramState::Paused);
    assert_eq!(cell.sent.last().unwrap().2, Out::Bytes(vec![0xFF, 0xFF, 1, 0xFE, 0xFE]), "paused is bit 0");
}

#[test]
fn a_reset_clears_a_stop_and_the_error() {
    let mut cell = TestController::from_toml(&CELL.replace("\"on\"", "\"enabled\"")).unwrap();
    let c = cell.command_client();
    cell.controller.emergency_stop(cell.now);
    cell.run_ms(200);
    assert_eq!(leds(&mut cell), ["powered", "error", "emergency_stop", "remote"]);
    press(&mut cell, "ToolButton[1]");
    assert_eq!(cell.ask(c, "getlasterror"), "2001:ToolButton[1]: enable: a safety stop is active\n");
    cell.set_value("FDI[8]", 1.0);
    cell.set_value("FDI[8]", 0.0);
    cell.run_ms(1);
    assert_eq!(cell.ask(c, "state"), "5:0:6:2", "it recovers");
    assert_eq!(cell.ask(c, "getlasterror"), "0:no error\n");
    cell.run_ms(200);
    assert_eq!(leds(&mut cell), ["powered", "remote"]);
    assert_eq!(cell.packets.last().unwrap().1.error_code, 0);
    press(&mut cell, "ToolButton[1]");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
    // A collision pauses the program; after the reset it can go on.
    press(&mut cell, "FDI[1]");
    cell.controller.collide(cell.now, 3);
    cell.run_ms(100);
    press(&mut cell, "FDI[8]");
    cell.run_ms(200);
    assert_eq!(leds(&mut cell), ["powered", "enabled", "paused", "remote"]);
    assert_eq!(cell.ask(c, "resume"), "resume success");
}

#[test]
fn a_refused_function_is_an_error_with_its_input() {
    let mut cell = TestController::from_toml(CELL).unwrap();
    let c = cell.command_client();
    for (input, error) in [
        ("FDI[1]", "2001:FDI[1]: run: the robot is not enabled\n"),
        ("FDI[2]", "2001:FDI[2]: stop: no program is running\n"),
        ("BitInputReg[1].0", "2001:BitInputReg[1].0: pause: no program is running\n"),
        ("BitInputReg[2].7", "2001:BitInputReg[2].7: resume: no program is paused\n"),
        ("ToolButton[2]", "2001:ToolButton[2]: disable: the robot is not enabled\n"),
    ] {
        press(&mut cell, input);
        assert_eq!(cell.ask(c, "getlasterror"), error);
    }
    assert_eq!(leds(&mut cell), ["powered", "remote"], "a refused function is no error of the robot");
    // Several at one instant: what stops comes first.
    let mut cell = TestController::from_toml(&CELL.replace("\"on\"", "\"enabled\"")).unwrap();
    for input in ["FDI[1]", "ToolButton[2]"] {
        cell.set_value(input, 1.0);
    }
    cell.run_ms(200);
    assert_eq!(leds(&mut cell), ["powered", "remote"]);
    let error = cell.controller.machine().error().unwrap().message.clone();
    assert_eq!(error, "FDI[1]: run: the robot is not enabled");
}

#[test]
fn an_output_that_shows_a_state_is_written_by_nothing_else() {
    let script = r#"
        for name in ["FDO[1]", "DigitalSignalStatus[8].0", "BitOutputReg[1].0"] {
            try { set(name, 1); log("written " + name); } catch (e) { log(e); }
        }
        set("FDO[3]", true);
        set("BitOutputReg[1]", 255);
        if get("BitOutputReg[1]") != 0b0111_1110 { log("the byte was written whole"); }
        set("DigitalSignalStatus[8]", 0);
    "#;
    let toml = CELL
        .replace("\"on\"", "\"enabled\"")
        .replace("\"loop { wait_ms(10); }\"", &format!("'''{script}'''"));
    let mut cell = TestController::from_toml(&toml).unwrap();
    press(&mut cell, "FDI[1]");
    assert_eq!(cell.controller.machine().error(), None);
    let log: Vec<_> = cell.controller.program_log().collect();
    assert_eq!(
        log,
        [
            "FDO[1] shows a state; nothing else can write it",
            "DigitalSignalStatus[8].0 shows a state; nothing else can write it",
            "BitOutputReg[1].0 shows a state; nothing else can write it",
        ]
    );
    // Of a whole byte the other bits are written: all of the register, none of the outputs.
    assert_eq!(cell.value("BitOutputReg[1]"), f64::from(0b0111_1110));
    assert_eq!(cell.value("DigitalSignalStatus[8]"), f64::from(0b0000_0011), "powered and enabled");
    assert!(cell.controller.force(target("FDO[8]"), 1.0).is_err());
    let m = cell.modbus_client();
    for coil in [16, 31, 168, 175] {
        assert_eq!(cell.modbus(m, &[5, 0, coil, 0xFF, 0]), [0x85, 2], "coil {coil} is read-only");
    }
    // Lost registers do not lose the states.
    cell.controller.restart_cleared(cell.now);
    cell.run_ms(1_000);
    assert_eq!(leds(&mut cell), ["remote"]);
}

#[test]
fn functions_of_a_configuration_that_was_not_read_from_a_file_are_checked() {
    use recipe_config::{Function, FunctionInput, FunctionOutput, ShownState};
    let refused = |change: &dyn Fn(&mut SimConfig)| {
        let mut config = SimConfig::default();
        change(&mut config);
        Controller::new(&config).unwrap_err().to_string()
    };
    let start = FunctionInput { item: target("FDI[1]"), function: Function::Start };
    let texts = [
        refused(&|config| config.functions.inputs.push(FunctionInput { item: target("DI[1]"), ..start })),
        refused(&|config| {
            let output = FunctionOutput { item: target("FDI[1]"), state: ShownState::Running };
            config.functions.outputs.push(output);
        }),
        refused(&|config| config.functions.inputs.push(start)),
        refused(&|config| config.functions.start = Some("a".to_owned())),
        refused(&|config| {
            let output = FunctionOutput { item: target("FDO[1]"), state: ShownState::Running };
            config.functions.outputs.push(output);
            config.initial.push(Initial { target: target("FDO[1]"), value: 1.0 });
        }),
    ];
    assert_eq!(
        texts,
        [
            "functions: DI[1]: it cannot trigger a function",
            "functions: FDI[1]: it cannot show a state",
            "functions: start: no program to start",
            "functions: start: there is no program a",
            "FDO[1]: FDO[1] shows a state; nothing else can write it",
        ]
    );
}

#[test]
fn without_functions_the_same_bits_are_registers_only() {
    let config = with_program(SimConfig::default(), "t", "loop { wait_ms(10); }");
    let mut cell = robot(&config);
    for name in ["FDI[1]", "BitInputReg[1].0", "ToolButton[1]", "FDO[1]", "BitOutputReg[1].0"] {
        press(&mut cell, name);
    }
    assert_eq!((cell.controller.program_name(), cell.controller.machine().error()), (None, None));
    assert_eq!(leds(&mut cell), [""; 0]);
}
