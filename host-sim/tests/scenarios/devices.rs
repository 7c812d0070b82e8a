//! What reaches a device is fresh or not sent at all, and what comes from it is what was asked
//! (proto-core/docs/engine.md section 13): judged by what devices carried out, and at the robot's registers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::{Gateway, Link};
use super::modbus_device::{Act, ModbusDevice, Request};
use super::robot::Robot;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("an_axis_moves_once_for_a_pulse", axis),
        Scenario::new("a_late_reply_is_no_other_registers_value", late),
        Scenario::new("an_echo_is_no_reply", echo),
        Scenario::new("a_device_is_started_once_beside_a_register_without_replies", started),
        Scenario::new("a_device_on_modbus_tcp_moves_once_and_is_found_again", tcp),
    ]
}

/// A robot whose programs pulse two bits until an event has ended, with a target that is allowed and one that is not. A
/// gateway that lags misses a shorter pulse.
const ROBOT: &str = r#"
[initial]
"WordOutputReg[1]" = 1200

[[program]]
name = "pulse.jspf"
script = '''
let ended = get("WordInputReg[3]");
set("BitOutputReg[3]", 3);
while get("WordInputReg[3]") == ended { wait_ms(100); }
set("BitOutputReg[3]", 0);
wait_ms(1000);
'''

[[program]]
name = "wrong.jspf"
script = '''
set("WordOutputReg[1]", 9000);
call("pulse.jspf");
set("WordOutputReg[1]", 1300);
'''
"#;

/// A bit of the robot starts an axis, which is switched on once; its position is read.
const AXIS: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "axis"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 3
function = "write-registers"
address = 44
on = ["start"]
timeout_ms = 300
write = [{ name = "servo", type = "word", value = 1 }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 16
every_ms = 50
timeout_ms = 300
read = [{ name = "actual", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
slave = 3
function = "write-registers"
address = 40
on = ["rising:BitOutputReg[3].0"]
timeout_ms = 300
trigger_ms = 1000
outcome = { to = "WordInputReg[2]", count_to = "WordInputReg[3]", code_to = "WordInputReg[4]" }
write = [{ name = "target", type = "word", from = "WordOutputReg[1]", max = 2000 }]

[[port]]
name = "axis"
bus = "modbus-rtu"
baud = 115200
recipe = "axis"
timeout_ms = 1000
absent_ms = 600000
on_timeout = { "WordInputReg[1]" = 65000 }
"#;
const UNIT: u8 = 3;
const ACTUAL: u16 = 16;
const TARGET: u16 = 40;
const SERVO: u16 = 44;
const SAFE: f64 = 65_000.0;

/// Outcomes of events (docs/configuration.md).
const DONE: f64 = 2.0;
const REFUSED: f64 = 3.0;
const UNKNOWN: f64 = 5.0;
const EXPIRED: f64 = 6.0;
const OUT_OF_LIMITS: f64 = 7.0;
const AWAY: f64 = 9.0;

/// Modbus exceptions.
const ILLEGAL_ADDRESS: u8 = 2;
const BUSY: u8 = 6;

/// The robot's pulses, and what it is told of them.
struct Pulses<'a> {
    robot: &'a Robot,
    count: f64,
}

impl<'a> Pulses<'a> {
    fn of(robot: &'a Robot) -> Self {
        Self { robot, count: 0.0 }
    }

    /// Runs a program to its end; the outcome must be this.
    #[track_caller]
    fn run(&mut self, gateway: &mut dyn Gateway, program: &str, outcome: f64) {
        self.count += 1.0;
        self.robot.command(&format!("run({program})"), "run start");
        self.robot.until("WordInputReg[3]", self.count);
        self.robot.until("WordInputReg[2]", outcome);
        until("the program ends", || {
            gateway.must_run();
            (!self.robot.is_running()).then_some(())
        });
    }
}

/// A write is carried out or not; reads are answered.
fn of_writes(act: Act) -> impl FnMut(&Request, &mut [u16; 64]) -> Act + Send + 'static {
    move |request, _| if request.is_read() { Act::Well } else { act }
}

fn axis(case: &Case) {
    let robot = case.robot_of(ROBOT).start();
    let mut gateway = case.gateway_of(AXIS).robot(&robot).start();
    let axis = ModbusDevice::on_line(gateway.line("axis"), UNIT);
    axis.set(ACTUAL, 900);
    gateway.until_up(Link::Modbus, 1);
    robot.until("WordInputReg[1]", 900.0);
    let gateway = &mut *gateway;
    let mut pulses = Pulses::of(&robot);
    pulses.run(gateway, "pulse.jspf", DONE);
    assert_eq!(axis.written(), [(SERVO, 1), (TARGET, 1200)]);

    // It moves, and its reply is lost: nothing is sent again, also when it answers well.
    axis.decide(of_writes(Act::Lost));
    pulses.run(gateway, "pulse.jspf", UNKNOWN);
    axis.decide(of_writes(Act::Well));
    axis.until_read(ACTUAL, 40);
    assert_eq!(axis.written(), [(TARGET, 1200)]);

    // It refuses, or is busy for longer than the pulse may take: it does not move when it could again.
    axis.decide(of_writes(Act::Refused(ILLEGAL_ADDRESS)));
    pulses.run(gateway, "pulse.jspf", REFUSED);
    robot.until("WordInputReg[4]", f64::from(ILLEGAL_ADDRESS));
    axis.decide(of_writes(Act::Refused(BUSY)));
    pulses.run(gateway, "pulse.jspf", EXPIRED);
    axis.decide(of_writes(Act::Well));

    // Neither does it for a target that is not allowed, when another one is.
    pulses.run(gateway, "wrong.jspf", OUT_OF_LIMITS);
    axis.until_read(ACTUAL, 40);
    assert_eq!(axis.written(), []);

    // It is away: it neither moves nor is switched on again when it is back.
    axis.decide(|_, _| Act::Unheard);
    robot.until("WordInputReg[1]", SAFE);
    pulses.run(gateway, "pulse.jspf", AWAY);
    axis.set(ACTUAL, 901);
    axis.decide(of_writes(Act::Well));
    robot.until("WordInputReg[1]", 901.0);
    axis.until_read(ACTUAL, 40);
    assert_eq!(axis.written(), []);
    pulses.run(gateway, "pulse.jspf", DONE);
    assert_eq!(axis.written(), [(TARGET, 1300)]);
}

/// Three registers whose replies are told apart by nothing.
const METERS: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "meters"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 10
every_ms = 50
timeout_ms = 300
late_ms = 3000
read = [{ name = "a", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 20
every_ms = 50
timeout_ms = 300
late_ms = 3000
read = [{ name = "b", type = "word", to = "WordInputReg[2]" }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 30
every_ms = 50
timeout_ms = 300
late_ms = 3000
read = [{ name = "c", type = "word", to = "WordInputReg[3]" }]

[[port]]
name = "meters"
bus = "modbus-rtu"
baud = 115200
recipe = "meters"
timeout_ms = 20000
"#;

/// A device that counts in each register from another number on, and is slow at times: it answers one request after the
/// other, also those that came meanwhile. The robot never has a value of another register, nor an old one again.
fn late(case: &Case) {
    const REGISTERS: [(&str, u16); 3] =
        [("WordInputReg[1]", 10), ("WordInputReg[2]", 20), ("WordInputReg[3]", 30)];
    /// Beyond the timeout, and far below the time that a late reply is awaited.
    const LATE: Duration = Duration::from_millis(800);
    const TIMES: usize = 4;
    let first = |address: u16| 1_000 * (address / 10);
    let robot = case.robot_of(ROBOT).start();
    let mut gateway = case.gateway_of(METERS).robot(&robot).start();
    let device = ModbusDevice::on_line(gateway.line("meters"), UNIT);
    let is_slow = Arc::new(AtomicBool::new(true));
    let (slow, mut nth) = (Arc::clone(&is_slow), 0);
    REGISTERS.iter().for_each(|(_, address)| device.set(*address, first(*address)));
    device.decide(move |request, registers| {
        registers[usize::from(request.address)] += 1;
        nth += 1;
        if nth % 7 == 0 && slow.load(Ordering::SeqCst) { Act::Late(LATE) } else { Act::Well }
    });
    gateway.until_up(Link::Modbus, 1);
    let mut shown = [0.0; 3];
    let mut look = || {
        gateway.must_run();
        for ((name, address), before) in REGISTERS.iter().zip(&mut shown) {
            let value = robot.newest(name);
            let own = f64::from(first(*address));
            let is_own = (own..own + 1_000.0).contains(&value) && value >= *before;
            assert!(is_own || (value == 0.0 && *before == 0.0), "{name} is {value}, and was {before}");
            *before = value;
        }
        shown
    };
    for times in 1..=TIMES {
        until(&format!("{times} late replies"), || {
            look();
            (device.count(|_, act| act != Act::Well) >= times).then_some(())
        });
    }
    // The newest values come.
    is_slow.store(false, Ordering::SeqCst);
    let newest = REGISTERS.map(|(_, address)| f64::from(device.register(address)));
    until(&format!("{newest:?} or more at the robot"), || {
        look().iter().zip(&newest).all(|(shown, newest)| shown >= newest).then_some(())
    });
    assert_eq!(device.overtaking(), [], "asked while a reply was awaited that could be taken for its own");
}

/// A valve is read and written with a function whose good reply equals its request, and a lamp is written alone so.
const ECHOED: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "valve"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 16
every_ms = 50
timeout_ms = 300
read = [{ name = "actual", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
slave = 3
function = "write-register"
address = 40
on = ["rising:BitOutputReg[3].0"]
timeout_ms = 300
trigger_ms = 1000
outcome = { to = "WordInputReg[2]", count_to = "WordInputReg[3]", code_to = "WordInputReg[4]" }
write = [{ name = "open", type = "word", from = "WordOutputReg[1]" }]

[[recipe]]
name = "lamp"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 9
function = "write-register"
address = 1
on = ["rising:BitOutputReg[3].1"]
timeout_ms = 300
trigger_ms = 1000
outcome = { to = "WordInputReg[5]", count_to = "WordInputReg[6]" }
write = [{ name = "on", type = "word", value = 1 }]

[[port]]
name = "valve"
bus = "modbus-rtu"
baud = 115200
recipe = "valve"
timeout_ms = 1000

[[port]]
name = "lamp"
bus = "modbus-rtu"
baud = 115200
recipe = "lamp"
timeout_ms = 1000
"#;

/// Both adapters give back what is sent, and the file does not say so.
fn echo(case: &Case) {
    let robot = case.robot_of(ROBOT).start();
    let mut gateway = case.gateway_of(ECHOED).robot(&robot).start();
    let valve = ModbusDevice::on_line(gateway.line("valve"), UNIT);
    let lamp = ModbusDevice::on_line(gateway.line("lamp"), 9);
    for device in [&valve, &lamp] {
        device.decide(|_, _| Act::Unheard);
        device.echo();
    }
    valve.set(ACTUAL, 900);
    gateway.until_up(Link::Modbus, 1);
    let gateway = &mut *gateway;
    let mut pulses = Pulses::of(&robot);
    // There is no slave: nothing is read, and nothing was done.
    valve.until_count("requests without a reply", 3, |_, _| true);
    pulses.run(gateway, "pulse.jspf", AWAY);
    robot.until("WordInputReg[6]", 1.0);
    robot.until("WordInputReg[5]", UNKNOWN);
    // The valve is there and refuses, behind the echo of the request.
    valve.decide(of_writes(Act::Refused(ILLEGAL_ADDRESS)));
    robot.until("WordInputReg[1]", 900.0);
    pulses.run(gateway, "pulse.jspf", REFUSED);
    robot.until("WordInputReg[4]", f64::from(ILLEGAL_ADDRESS));
    assert_eq!(valve.written(), []);
    // Its good reply is the second copy of the request.
    valve.decide(of_writes(Act::Well));
    pulses.run(gateway, "pulse.jspf", DONE);
    assert_eq!(valve.written(), [(TARGET, 1200)]);
    robot.until("WordInputReg[6]", 3.0);
    assert_ne!(robot.variable("WordInputReg[5]"), DONE, "nobody is there who could have switched the lamp");
}

/// A drive that must be switched on, with a register that it does not have and says nothing about.
const DRIVE: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "drive"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 3
function = "write-registers"
address = 44
on = ["start"]
timeout_ms = 200
write = [{ name = "servo", type = "word", value = 1 }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 16
every_ms = 50
timeout_ms = 200
late_ms = 300
read = [{ name = "actual", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 32
every_ms = 50
timeout_ms = 200
read = [{ name = "missing", type = "dword", to = "WordInputReg[2]" }]

[[port]]
name = "drive"
bus = "modbus-rtu"
baud = 115200
recipe = "drive"
timeout_ms = 5000
"#;

fn started(case: &Case) {
    const MISSING: u16 = 32;
    let robot = case.robot_of(ROBOT).start();
    let mut gateway = case.gateway_of(DRIVE).robot(&robot).start();
    let drive = ModbusDevice::on_line(gateway.line("drive"), UNIT);
    drive.set(ACTUAL, 900);
    // Some replies to the other one are lost, too.
    let mut nth = 0;
    drive.decide(move |request, _| {
        nth += u32::from(request.is_read_at(ACTUAL));
        match request.address {
            MISSING => Act::Unheard,
            ACTUAL if nth % 9 == 0 => Act::Lost,
            _ => Act::Well,
        }
    });
    gateway.until_up(Link::Modbus, 1);
    robot.until("WordInputReg[1]", 900.0);
    drive.until_count("requests that it never answers", 4, |request, _| request.is_read_at(MISSING));
    drive.until_count("lost replies", 4, |_, act| act == Act::Lost);
    drive.set(ACTUAL, 901);
    robot.until("WordInputReg[1]", 901.0);
    gateway.must_run();
    assert_eq!(drive.written(), [(SERVO, 1)]);
    assert_eq!(robot.variable("WordInputReg[2]"), 0.0, "what was never read is shown");
}

/// The axis as a TCP server.
fn tcp(case: &Case) {
    let toml = AXIS
        .replace("bus = \"modbus-rtu\"\nbaud = 115200\n", "bus = \"modbus-tcp\"\nto = \"127.0.0.1:502\"\n");
    let robot = case.robot_of(ROBOT).start();
    let (axis, address) = ModbusDevice::on_tcp(UNIT);
    axis.set(ACTUAL, 900);
    let mut gateway = case.gateway_of(&toml).robot(&robot).device_at("axis", address).start();
    gateway.until_up(Link::Modbus, 1);
    robot.until("WordInputReg[1]", 900.0);
    let gateway = &mut *gateway;
    let mut pulses = Pulses::of(&robot);
    pulses.run(gateway, "pulse.jspf", DONE);
    assert_eq!(axis.written(), [(SERVO, 1), (TARGET, 1200)]);
    assert_eq!(axis.connections(), 1);

    // It moves, and hangs up instead of saying so: nothing is sent again over the next connection.
    axis.decide(of_writes(Act::Lost));
    pulses.run(gateway, "pulse.jspf", UNKNOWN);
    axis.decide(of_writes(Act::Well));
    axis.set(ACTUAL, 901);
    robot.until("WordInputReg[1]", 901.0);
    axis.until_read(ACTUAL, 40);
    assert_eq!(axis.written(), [(TARGET, 1200)]);
    assert_eq!(axis.connections(), 2);

    // It has no power for a while. Neither the pulse of meanwhile nor its start is carried out behind that.
    axis.off(true);
    robot.until("WordInputReg[1]", SAFE);
    pulses.run(gateway, "pulse.jspf", AWAY);
    axis.set(ACTUAL, 902);
    axis.off(false);
    robot.until("WordInputReg[1]", 902.0);
    axis.until_read(ACTUAL, 40);
    assert_eq!(axis.written(), []);
    pulses.run(gateway, "pulse.jspf", DONE);
    assert_eq!(axis.written(), [(TARGET, 1200)]);
}
