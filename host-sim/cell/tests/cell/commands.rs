//! A panel whose start and stop are bits of one byte, before the simulated controller.

use proto_core::config::{
    CommandEntry, CommandWhen, FieldSpec, GatewayConfig, InputBinding, Port, Recipe, Span,
};
use proto_core::device::{Bits, ByteOrder, Encoding, Kind, Overflow};
use proto_core::time::Duration;
use recipe_cell::Cell;

use crate::kit::*;

const START: u8 = 1;
const STOP: u8 = 2;

/// The panel sends 0xA5 and its byte, and is silent between events.
fn panel(when: CommandWhen) -> Cell {
    let mut gateway = GatewayConfig::empty();
    gateway.set_controller("127.0.0.1").unwrap();
    let mut fields = Vec::new();
    for (first, text) in [(0, "run(pick.jspf)"), (1, "stop")] {
        let kind = Kind::Bits(Bits { bytes: 1, first, count: 1, signed: false });
        let encoding = Encoding { kind, order: ByteOrder::Little, shared: first > 0 };
        let table = Span { start: gateway.commands.len() as u16, len: 1 };
        gateway.commands.push(CommandEntry::new(1, text.try_into().unwrap())).unwrap();
        let to = InputBinding::Commands { table, when };
        fields.push(FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to });
    }
    gateway.add_recipe(&Recipe::user("panel").stream_input(&[0xA5], &[], fields.as_slice())).unwrap();
    gateway.add_port(&Port::rs485("panel", "panel").timeout(Duration::from_millis(200))).unwrap();
    let (_, controller) = files("request-response");
    let mut cell = Cell::new(&gateway, &controller, 1).unwrap();
    cell.run_ms(500);
    cell
}

/// The panel's byte changes, and a program starts or stops within the time that its commands take.
fn press(cell: &mut Cell, byte: u8) -> bool {
    let line = cell.line_of("panel");
    cell.send(line, &[0xA5, byte]);
    cell.run_ms(60);
    cell.send_command("isprogfinish").trim() == "0"
}

#[test]
fn stop_ends_the_program_while_start_is_held() {
    let mut cell = panel(CommandWhen::Change);
    assert!(!press(&mut cell, 0));
    assert!(press(&mut cell, START), "pick runs");
    assert!(!press(&mut cell, START | STOP), "it ends 100 ms before its time");
    assert!(!press(&mut cell, START));
    assert_eq!(cell.controller().counters().programs_started, 1);
    let port = cell.port("panel");
    assert_eq!((port.commands, port.commands_dropped, port.commands_unknown), (2, 0, 0));
}

#[test]
fn start_and_stop_at_once_start_nothing() {
    let mut cell = panel(CommandWhen::Change);
    press(&mut cell, 0);
    assert!(!press(&mut cell, START | STOP));
    cell.run_ms(1_000);
    assert_eq!(cell.controller().counters().programs_started, 0);
    assert_eq!(cell.port("panel").commands_dropped, 1);
}

#[test]
fn a_panel_that_is_silent_between_events_starts_and_stops() {
    for (when, started, based) in [(CommandWhen::Change, 0, 1), (CommandWhen::Kept, 1, 0)] {
        let mut cell = panel(when);
        press(&mut cell, 0);
        cell.run_ms(5_000);
        assert_eq!(cell.port("panel").timeouts, 1);
        assert_eq!(press(&mut cell, START), when == CommandWhen::Kept);
        assert_eq!(cell.controller().counters().programs_started, started);
        assert_eq!(cell.port("panel").commands_based, based);
    }
}
