//! The command line: texts, exit codes, pipes.

use std::io::Write;
use std::process::{Output, Stdio};

use recipe_test_kit::{HostSim, example};

use super::BINARY;

fn host_sim(args: &[&str], stdin: &str) -> Output {
    let mut child = BINARY.command().args(args).stdin(Stdio::piped()).spawn().unwrap();
    // If the arguments are refused, nobody reads this; the test checks the exit code.
    let _ = child.stdin.take().unwrap().write_all(stdin.as_bytes());
    child.wait_with_output().unwrap()
}

#[track_caller]
fn ok(args: &[&str], stdin: &str) -> String {
    let output = host_sim(args, stdin);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Checks for exit code 2 and an empty stdout; returns stderr.
#[track_caller]
fn refused(args: &[&str]) -> String {
    let output = host_sim(args, "");
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(output.stdout.is_empty(), "{}", String::from_utf8_lossy(&output.stdout));
    message
}

fn path(name: &str) -> String {
    example(name).to_str().unwrap().to_owned()
}

/// The output of `check` below the file's name.
#[track_caller]
fn checked(name: &str, more: &[&str]) -> String {
    let report = ok(&[&["check", &path(name)], more].concat(), "");
    report.split_once(": ").expect("a file name").1.to_owned()
}

#[test]
fn check_says_how_full_lines_are_which_way_variables_go_and_what_goes_on_the_pendant() {
    insta::assert_snapshot!("check_force_sensor", checked("force-sensor.toml", &[]));
    insta::assert_snapshot!("check_request_response", checked("request-response.toml", &[]));
    insta::assert_snapshot!("check_client", checked("client.toml", &[]));
    insta::assert_snapshot!("check_can_system_controller", checked("can-system-controller.toml", &[]));
    let slow = checked("rs485-system.toml", &["--set", "port.rs485-1.baud=9600"]);
    insta::assert_snapshot!("check_slow_line", slow);
}

#[test]
fn check_says_what_functional_inputs_do() {
    let set = [
        "functions.start=echo.jspf",
        "functions.inputs.FDI[1]=start",
        "functions.inputs.BitInputReg[1].0=stop",
        "functions.outputs.FDO[1]=running",
    ];
    let report = checked("rs485-user-controller.toml", &set.map(|key| ["--set", key]).concat());
    let functions =
        "functions\n  FDI[1] -> start echo.jspf\n  BitInputReg[1].0 -> stop\n  running -> FDO[1]\n";
    assert!(report.contains(&format!("programs: echo.jspf\n\n{functions}\nwarnings\n")), "{report}");
}

#[test]
fn check_draws_the_frames_of_a_device() {
    insta::assert_snapshot!("check_gripper", checked("gripper.toml", &[]));
    insta::assert_snapshot!("check_modbus_tcp", checked("modbus-tcp.toml", &[]));
    insta::assert_snapshot!("check_modbus_line", checked("modbus-line.toml", &[]));
    insta::assert_snapshot!("check_force_sensor_crc", checked("force-sensor-crc.toml", &[]));
    insta::assert_snapshot!("check_scale", checked("scale.toml", &[]));
    insta::assert_snapshot!("check_can_panel", checked("can-panel.toml", &[]));
    insta::assert_snapshot!("check_two_panels", checked("two-panels.toml", &[]));
}

#[test]
fn decode_says_what_the_checksum_should_be() {
    let stdin = "09 17 06 F9 00 00 DC D0 1F 4E 11\n";
    let output = host_sim(&["decode", &path("gripper.toml"), "--part", "reply"], stdin);
    let notes = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{notes}");
    assert!(notes.contains("the checksum is 4E 11 instead of 8F D1"), "{notes}");
}

#[test]
fn wrong_files_and_arguments_start_nothing() {
    let file = path("rs485-system.toml");
    let baud = "port.rs485-1.baud=1";
    let expected =
        "--set port.rs485-1.baud=1: port.rs485-1.baud: 1 is out of range; allowed: 1200..=4000000\n";
    assert_eq!(refused(&["check", &file, "--set", baud]), expected);
    assert_eq!(refused(&["gateway", "-c", &file, "--set", baud]), expected);
    assert!(refused(&["controller", "-c", &file]).contains("this is a gateway file"));
    assert!(
        refused(&["gateway", "-c", "no-such-file.toml"]).starts_with("no-such-file.toml: cannot be read")
    );
    assert!(refused(&["gateway", "-c", &file, "--bind", "rs485-1"]).contains("NAME=DEVICE"));
    assert!(refused(&["gateway", "-c", &file, "--stats", "1"]).contains("write 1s, 200ms or 2m"));
    assert!(refused(&["gateway"]).contains("--config"));
    assert!(refused(&["nonsense"]).contains("nonsense"));
    let which = refused(&["encode", &file, "1"]);
    assert!(
        which.contains("has both parts; choose one: --part input (user to robot) or --part output"),
        "{which}"
    );
}

#[test]
fn what_only_the_controller_can_refuse_has_its_place_too() {
    let file = path("rs485-user-controller.toml");
    let script = "program.\"echo.jspf\".script=let = 1;";
    for command in [&["check", &file][..], &["controller", "-c", &file]] {
        let message = refused(&[command, &["--set", script]].concat());
        let place = format!("--set {script}: program.echo.jspf.script: ");
        assert!(message.starts_with(&place) && message.contains("line 1"), "{message}");
        assert_eq!(message.lines().count(), 1);
    }
    let joint = refused(&["check", &file, "--set", "initial.RobotState[1]=100"]);
    assert!(joint.contains("initial.RobotState[1]: a joint position is within"), "{joint}");
}

#[test]
fn frames_and_values_convert_both_ways() {
    let stream = path("rs485-system.toml");
    assert_eq!(ok(&["encode", &stream, "--part", "input", "1"], ""), "FF FF 01 EE EE\n");
    let decoded = ok(&["decode", &stream, "--part", "input", "FFFF01EEEE"], "");
    assert_eq!(decoded, "DigitalOutputCommand[1]=1\n");

    let can = path("can-system.toml");
    let log =
        "(1436509052.249713) can0 002#EF54EF3EA7E7D13E\n(1436509052.250100) can0 003#0000803F000000C0\n";
    let decoded = ok(&["decode", &can, "--part", "output"], log);
    assert_eq!(
        decoded.lines().next(),
        Some("(1436509052.249713) can0 id=0x002 RobotState[8]=0.46744487 m RobotState[9]=0.4099705 m")
    );
    assert_eq!(ok(&["encode", &can, "--part", "output"], &decoded), log);
}

#[test]
fn an_image_is_what_a_board_takes() {
    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("cell.img");
    let image = image.to_str().unwrap();
    let file = path("force-sensor.toml");
    let set = "controller.address=10.0.2.2";
    let output = ok(&["image", &file, "--set", set, "-o", image], "");
    let bytes = std::fs::read(image).unwrap();
    assert_eq!(output, format!("{image}: {} bytes, version 4\n", bytes.len()));
    let config = proto_core::config::image::decode(&bytes).unwrap();
    assert_eq!(config.controller.address, "10.0.2.2");
    assert_eq!(config.ports[0].name, "force");
    // No image is made of an invalid file.
    std::fs::remove_file(image).unwrap();
    refused(&["image", &file, "--set", "port.force.cycle_ms=3", "-o", image]);
    refused(&["image", &path("force-sensor-controller.toml"), "-o", image]);
    assert!(!std::path::Path::new(image).exists());
}

#[test]
fn an_image_replaces_nothing_but_images() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let names = || {
        let names = std::fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> =
            names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    let (file, image) = (at("cell.toml"), at("cell.img"));
    std::fs::copy(example("rs485-system.toml"), &file).unwrap();
    let toml = std::fs::read(&file).unwrap();

    // The input file is never replaced, by any name and with any option.
    std::os::unix::fs::symlink(&file, at("link")).unwrap();
    for output in [&file, &at("link")] {
        for force in [&["--force"][..], &[]] {
            let message = refused(&[&["image", &file, "-o", output], force].concat());
            assert!(
                message.starts_with(&format!("{output}: this is the file that the image is made from")),
                "{message}"
            );
            assert_eq!(message.lines().count(), 1);
        }
    }
    // Other files are replaced only with --force.
    std::fs::write(&image, "precious").unwrap();
    let message = refused(&["image", &file, "-o", &image]);
    assert!(
        message.contains("this file exists and is not an image; give another name or --force"),
        "{message}"
    );
    assert_eq!(std::fs::read(&image).unwrap(), b"precious");
    ok(&["image", &file, "-o", &image, "--force"], "");
    let first = std::fs::read(&image).unwrap();
    assert!(first.starts_with(b"RGCI"));
    // An image is replaced, even one of another version.
    std::fs::write(&image, [b"RGCI", &[0; 30][..]].concat()).unwrap();
    ok(&["image", &file, "-o", &image], "");
    assert_eq!(std::fs::read(&image).unwrap(), first);

    std::fs::create_dir(at("folder")).unwrap();
    let message = refused(&["image", &file, "-o", &at("folder"), "--force"]);
    assert!(message.contains("a folder; give the name of a file in it"), "{message}");
    std::os::unix::fs::symlink(at("nothing"), at("dangling")).unwrap();
    refused(&["image", &file, "-o", &at("dangling")]);
    refused(&["image", &file, "-o", &at("no-such-folder/cell.img")]);
    assert_eq!(std::fs::read(&file).unwrap(), toml);
    assert_eq!(names(), ["cell.img", "cell.toml", "dangling", "folder", "link"]);
    // The image can be written to a pipe.
    ok(&["image", &file, "-o", "/dev/null"], "");
    assert!(!std::path::Path::new("/dev/null").is_file());
}

#[test]
fn check_shows_a_boards_own_address() {
    let sets =
        ["network.address=192.168.12.20/24", "network.router=192.168.12.1", "network.dns=192.168.12.2"];
    let file = path("rs485-system.toml");
    let arguments = ["check", &file].into_iter().chain(sets.iter().flat_map(|set| ["--set", *set]));
    let output = ok(&arguments.collect::<Vec<_>>(), "");
    let line = "a board's address is 192.168.12.20/24, router 192.168.12.1, name server 192.168.12.2; a host has its own\n";
    assert!(output.contains(line), "{output}");
    assert!(!ok(&["check", &file], "").contains("a board's address"));
}

#[test]
fn an_image_that_no_board_takes_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let (file, image) = (folder.path().join("cell.toml"), folder.path().join("cell.img"));
    let mut text = String::from("[controller]\naddress = \"192.168.12.138\"\n");
    for recipe in 0..16 {
        text += &format!(
            "[[recipe]]\nname = \"a-recipe-whose-name-is-long-{recipe}\"\nkind = \"can\"\nmode = \"user\"\n"
        );
        for (part, value) in [("input", ""), ("output", ", from = \"RobotState[8]\", scale = 0.5")] {
            for id in 0x1000_0000..0x1000_0020 {
                text += &format!("[[recipe.{part}.frame]]\nextended = true\nid = {id}\n");
                text += &format!("fields = [{{ name = \"value\", type = \"byte\"{value} }}]\n");
            }
        }
    }
    text += "[[port]]\nname = \"bus\"\nbus = \"can\"\nbitrate = 1000000\ncycle_ms = 100\n";
    text += "recipe = \"a-recipe-whose-name-is-long-0\"\n";
    std::fs::write(&file, text).unwrap();
    ok(&["check", file.to_str().unwrap()], "");
    let message = refused(&["image", file.to_str().unwrap(), "-o", image.to_str().unwrap()]);
    assert!(message.contains("16384 bytes"), "{message}");
    assert!(!image.exists());
    // A gateway on this host needs none.
    let mut gateway = BINARY.run("gateway", &file);
    let bus = "--bind=bus=slcan-tcp:127.0.0.1:0";
    HostSim::start(gateway.args(["--set", "controller.address=127.0.0.1", bus])).end();
}

#[test]
fn the_help_teaches() {
    for command in ["controller", "gateway", "new", "check", "export", "encode", "decode"] {
        let help = ok(&[command, "--help"], "");
        assert!(help.contains("Examples:") && help.contains(&format!("host-sim {command}")), "{help}");
    }
    assert!(ok(&["--help"], "").contains("Exit codes:"));
}

#[test]
fn help_of_all_commands() {
    let mut waiting = vec![vec![]];
    let mut all = String::new();
    while let Some(command) = waiting.pop() {
        let help = ok(&[&command[..], &["--help"]].concat(), "");
        let commands = help.split_once("\nCommands:\n").map_or("", |(_, behind)| behind);
        let commands =
            commands.lines().map_while(|line| line.split_whitespace().next().map(|name| (line, name)));
        let commands = commands.filter(|(line, name)| !line.starts_with("   ") && *name != "help");
        let names: Vec<&str> = commands.map(|(_, name)| &*name.to_owned().leak()).collect();
        waiting.extend(names.iter().rev().map(|name| [&command[..], &[name]].concat()));
        all += &format!("$ host-sim {} --help\n{help}\n", command.join(" "));
    }
    insta::assert_snapshot!("help", all.replace("host-sim  --help", "host-sim --help"));
}
