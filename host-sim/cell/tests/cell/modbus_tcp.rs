//! A device behind a TCP connection: how the gateway gets to it, loses it, and gets to it again.

use std::cell::RefCell;
use std::rc::Rc;

use proto_core::engine::{LinkId, PortId};
use proto_core::time::{Duration, Instant};
use recipe_cell::{Cell, Served, Server, SlaveDone, Way};
use recipe_config::file;
use recipe_test_kit::{example, toml};

const GATEWAY: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "rack"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 1
function = "read-holding-registers"
address = 0
every_ms = 20
timeout_ms = 50
retries = 0
read = [{ name = "value", type = "word", to = "WordInputReg[1]" }]

[[port]]
name = "rack"
bus = "modbus-tcp"
to = "192.168.12.50"
recipe = "rack"
timeout_ms = 200
on_timeout = { "WordInputReg[1]" = 7 }
"#;

const LINK: LinkId = LinkId::of_port(PortId(0));

/// What a test sees and says of the device.
#[derive(Debug, Default)]
struct Desk {
    value: u16,
    /// It is done instead of the next reply.
    instead: Option<Served>,
    is_silent: bool,
    /// Connections that it had, and requests.
    opened: u32,
    asked: u32,
    is_open: bool,
}

/// Answers each request with the value.
struct Rack {
    desk: Rc<RefCell<Desk>>,
    came: Vec<u8>,
    says: Vec<Served>,
}

impl Server for Rack {
    fn opened(&mut self, _: Instant) {
        let mut desk = self.desk.borrow_mut();
        assert!(!std::mem::replace(&mut desk.is_open, true), "one connection at a time");
        desk.opened += 1;
        self.came.clear();
    }

    fn closed(&mut self, _: Instant) {
        assert!(std::mem::replace(&mut self.desk.borrow_mut().is_open, false));
        self.says.clear();
    }

    fn receive(&mut self, _: Instant, bytes: &[u8]) {
        let mut desk = self.desk.borrow_mut();
        assert!(desk.is_open);
        self.came.extend_from_slice(bytes);
        while self.came.len() >= 12 {
            let request: Vec<u8> = self.came.drain(..12).collect();
            assert_eq!(request[2..], [0, 0, 0, 6, 1, 3, 0, 0, 0, 1]);
            desk.asked += 1;
            if desk.is_silent {
                continue;
            }
            let [high, low] = desk.value.to_be_bytes();
            let reply = vec![request[0], request[1], 0, 0, 0, 5, 1, 3, 2, high, low];
            self.says.push(desk.instead.take().unwrap_or(Served::Bytes(reply, None)));
        }
    }

    fn deadline(&self) -> Instant {
        if self.says.is_empty() { Instant::NEVER } else { Instant::ZERO }
    }

    fn poll(&mut self, _: Instant) -> Vec<Served> {
        std::mem::take(&mut self.says)
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        Vec::new()
    }
}

fn cell() -> (Cell, Rc<RefCell<Desk>>) {
    let controller = file::load_controller(&example("rs485-system-controller.toml"), &[]).unwrap();
    let mut cell = Cell::new(&toml::gateway(GATEWAY), &controller, 7).unwrap();
    let desk = Rc::<RefCell<Desk>>::default();
    desk.borrow_mut().value = 100;
    cell.attach_server(LINK, Rack { desk: Rc::clone(&desk), came: Vec::new(), says: Vec::new() });
    (cell, desk)
}

#[track_caller]
fn reaches(cell: &mut Cell, desk: &RefCell<Desk>, value: u16, within_ms: u64) {
    desk.borrow_mut().value = value;
    let limit = Duration::from_millis(within_ms);
    let done = cell.run_until(limit, |cell| cell.value("WordInputReg[1]") == f64::from(value));
    assert!(done, "{value} does not reach the controller: {:?}", desk.borrow());
}

#[track_caller]
fn is_up(cell: &Cell) -> bool {
    cell.link(LINK).state.name() == "up"
}

#[test]
fn a_device_is_asked_over_one_connection_whatever_its_pieces() {
    let (mut cell, desk) = cell();
    cell.network(LINK).longest_segment = Some(3);
    reaches(&mut cell, &desk, 1, 500);
    reaches(&mut cell, &desk, 2, 100);
    cell.run_ms(200);
    assert_eq!(desk.borrow().opened, 1);
    assert!(desk.borrow().asked > 5);
    assert_eq!(cell.port("rack").unanswered, 0);
}

#[test]
fn a_connection_that_is_refused_swallowed_reset_or_cut_is_there_again() {
    let (mut cell, desk) = cell();
    reaches(&mut cell, &desk, 1, 500);
    type Fault = fn(&mut Cell);
    let faults: [(Fault, Fault); 5] = [
        (|cell| (cell.refuse(LINK), cell.reset(LINK)).1, |cell| cell.admit(LINK)),
        (|cell| (cell.black_hole(LINK), cell.half_open(LINK)).1, |cell| cell.admit(LINK)),
        (|cell| cell.cut_cable(LINK), |cell| cell.repair_cable(LINK)),
        (|cell| cell.hold(LINK, Way::Down), |cell| cell.release(LINK, Way::Down)),
        (|cell| cell.reset_after(LINK, Way::Up, 5), |_| ()),
    ];
    for (value, (begin, end)) in (10..).zip(faults) {
        let opened = desk.borrow().opened;
        begin(&mut cell);
        // Its own value goes away with it, unless it is there again at once.
        cell.run_ms(1_000);
        end(&mut cell);
        reaches(&mut cell, &desk, value, 8_000);
        assert!(desk.borrow().opened > opened, "another connection");
    }
}

#[test]
fn a_device_that_hangs_up_is_connected_again() {
    for (value, how) in (20..).zip([Served::Close, Served::HalfClose, Served::Reset]) {
        let (mut cell, desk) = cell();
        reaches(&mut cell, &desk, 1, 500);
        desk.borrow_mut().instead = Some(how.clone());
        cell.run_ms(60);
        assert!(!is_up(&cell), "{how:?}");
        assert!(!desk.borrow().is_open, "{how:?}");
        reaches(&mut cell, &desk, value, 500);
        assert_eq!(desk.borrow().opened, 2);
    }
}

#[test]
fn a_device_without_power_says_nothing_and_is_found_again() {
    let (mut cell, desk) = cell();
    reaches(&mut cell, &desk, 1, 500);
    desk.borrow_mut().instead = Some(Served::PowerOff);
    cell.run_ms(100);
    assert!(is_up(&cell), "nobody was told");
    assert!(!desk.borrow().is_open);
    cell.run_ms(900);
    assert!(!is_up(&cell), "a request was not acknowledged");
    assert_eq!(cell.value("WordInputReg[1]"), 7.0, "its safe value");
    let asked = desk.borrow().asked;
    cell.run_ms(5_000);
    assert_eq!(desk.borrow().asked, asked, "nothing gets there");
}

#[test]
fn the_controllers_power_is_not_the_devices() {
    let (mut cell, desk) = cell();
    reaches(&mut cell, &desk, 1, 500);
    cell.power_cut();
    let asked = desk.borrow().asked;
    cell.run_ms(1_000);
    assert!(is_up(&cell) && desk.borrow().asked > asked + 20);
    cell.power_up();
    reaches(&mut cell, &desk, 2, 8_000);
    assert_eq!(desk.borrow().opened, 1);
}

#[test]
fn a_device_that_answers_nothing_keeps_its_connection() {
    let (mut cell, desk) = cell();
    reaches(&mut cell, &desk, 1, 500);
    desk.borrow_mut().is_silent = true;
    cell.run_ms(2_000);
    assert!(is_up(&cell));
    assert!(cell.port("rack").unanswered > 2);
    desk.borrow_mut().is_silent = false;
    reaches(&mut cell, &desk, 3, 3_000);
    assert_eq!(desk.borrow().opened, 1);
}
