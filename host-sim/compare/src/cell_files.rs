//! Cells of one pseudoterminal, and the gateways that run them.

use std::fs::{File, OpenOptions};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use recipe_test_kit::HostSim;
use serde_json::Value;

use crate::programs;

/// The frame of a device: three values, each of which goes to a register.
pub(crate) fn frame(value: u8) -> [u8; 7] {
    [255, 255, value, value.wrapping_add(1), value.wrapping_add(2), 238, 238]
}

/// Length of the frames that a device gets.
pub(crate) const OUT_LEN: usize = 5;

/// A simulated controller, for command and state.
pub(crate) fn controller() -> HostSim {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    let mut command = programs::host_sim();
    command.arg("controller").arg("-c").arg(file.path()).args(recipe_test_kit::free_servers());
    HostSim::start(&mut command)
}

/// A gateway with a line at `folder/line`; `output` adds a frame to the device every 4 ms.
pub(crate) fn gateway(folder: &Path, robot: &HostSim, modbus: SocketAddr, output: bool) -> HostSim {
    let file = write(folder, "cell", robot, modbus, output);
    let mut command = programs::host_sim();
    command.args(["gateway", "--stats", "1s", "-c"]).arg(file);
    HostSim::start(command.arg("--bind").arg(format!("device=pty:{}", folder.join("line").display())))
}

/// The gateways of several cells in one process on so many threads. The file of each is `cellN.toml` in its folder.
pub(crate) fn gateways(folders: &[impl AsRef<Path>], files: &[PathBuf], threads: usize) -> HostSim {
    let mut command = programs::host_sim();
    command.args(["gateway", "--stats", "1s", "--threads", &threads.to_string()]);
    for ((nth, folder), file) in folders.iter().enumerate().zip(files) {
        command.arg("-c").arg(file);
        command.arg(format!("--bind=cell{nth}/device=pty:{}", folder.as_ref().join("line").display()));
    }
    HostSim::start(&mut command)
}

/// Writes the file of a cell.
pub(crate) fn write(folder: &Path, name: &str, robot: &HostSim, modbus: SocketAddr, output: bool) -> PathBuf {
    let (sent, cycle) = match output {
        true => {
            let fields = r#"[{ name = "lamp", type = "byte", value = 1 }]"#;
            (
                format!("[recipe.output]\nhead = [255, 255]\ntail = [254, 254]\nfields = {fields}\n"),
                "cycle_ms = 4\n",
            )
        }
        false => (String::new(), ""),
    };
    let field = |nth| format!(r#"{{ name = "input{nth}", type = "byte", to = "WordInputReg[{nth}]" }}"#);
    let text = format!(
        r#"[controller]
address = "127.0.0.1"
ports = {{ command = {}, state = {}, modbus = {} }}
[[recipe]]
name = "three-bytes"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [{}, {}, {}]
{sent}
[[port]]
name = "device"
bus = "rs485"
recipe = "three-bytes"
{cycle}"#,
        robot.at("command").port(),
        robot.at("state").port(),
        modbus.port(),
        field(1),
        field(2),
        field(3),
    );
    let file = folder.join(name).with_extension("toml");
    std::fs::write(&file, text).unwrap();
    file
}

/// Whether all links of a gateway are up.
pub(crate) fn is_connected(stats: &Value) -> bool {
    stats["links"].as_object().is_some_and(|links| links.values().all(|link| link["state"] == "up"))
}

/// A device's end of the line in a folder.
pub(crate) fn open(line: &Path) -> File {
    OpenOptions::new()
        .read(true)
        .write(true)
        .open(line)
        .unwrap_or_else(|error| panic!("{}: {error}", line.display()))
}
