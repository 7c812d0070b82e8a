//! The whole controller in virtual time.

mod any_order;
mod commands;
mod displacement;

mod examples;
mod faults;
mod functions;
mod interface;
mod modbus;
mod operations;
mod packet;
mod ports;
mod programs;
mod safety;
mod scripts;
mod slices;
mod stream;
mod when_done;

use std::net::{Ipv4Addr, SocketAddr};

use proto_core::config::{Parity, Rs485};
use proto_core::recipe::model::{Field, Mode};
use proto_core::sysvar::VarRange;
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;

use super::test_controller::CLIENT_ADDRESS;
use super::*;
use recipe_config::{
    Initial, InitialTarget, SimBus, SimCanFrame, SimField, SimParts, SimPort, SimProgram, SimRecipe,
    SimStreamPart,
};

/// The runtime may keep it in any task.
const _: fn() = || {
    fn is_send<T: Send>() {}
    is_send::<Controller>();
};

#[track_caller]
pub(super) fn robot(config: &SimConfig) -> TestController {
    TestController::new(config).unwrap_or_else(|error| panic!("{error}"))
}

impl TestController {
    pub(super) fn run_ms(&mut self, millis: u64) {
        self.run(Duration::from_millis(millis));
    }

    pub(super) fn command_client(&mut self) -> ConnId {
        self.connect(Link::Command)
    }

    pub(super) fn modbus_client(&mut self) -> ConnId {
        self.connect(Link::Modbus)
    }

    pub(super) fn state_client(&mut self) -> ConnId {
        self.connect(Link::State)
    }

    /// Sends a command with a line end and returns the reply.
    pub(super) fn ask(&mut self, conn: ConnId, text: &str) -> String {
        let line = format!("{text}\r\n");
        self.input(ControllerInput::CommandBytes { conn, bytes: line.as_bytes() });
        String::from_utf8(self.take(conn)).unwrap()
    }

    /// Sends a command and advances the clock until it is answered.
    #[track_caller]
    pub(super) fn order(&mut self, conn: ConnId, text: &str) -> String {
        let asked = self.now;
        let mut reply = self.ask(conn, text);
        while reply.is_empty() {
            assert!(self.now < asked + Duration::from_secs(60), "{text} is never answered");
            self.run_ms(1);
            reply = String::from_utf8(self.take(conn)).unwrap();
        }
        reply
    }

    /// Sends a Modbus PDU and returns that of the answer, with its function code.
    #[track_caller]
    pub(super) fn modbus(&mut self, conn: ConnId, pdu: &[u8]) -> Vec<u8> {
        let mut adu = vec![0x12, 0x34, 0, 0, 0, pdu.len() as u8 + 1, 9];
        adu.extend_from_slice(pdu);
        self.input(ControllerInput::ModbusBytes { conn, bytes: &adu });
        let answer = self.take(conn);
        assert_eq!(answer[..4], [0x12, 0x34, 0, 0], "{answer:02x?}");
        assert_eq!(usize::from(answer[5]) + 6, answer.len());
        assert_eq!(answer[6], 9, "the unit is echoed");
        answer[7..].to_vec()
    }

    /// Reads one coil over Modbus.
    #[track_caller]
    pub(super) fn coil(&mut self, address: u8) -> bool {
        let conn = self.modbus_client();
        let answer = self.modbus(conn, &[1, 0, address, 0, 1]);
        self.input(ControllerInput::ModbusClosed { conn });
        assert_eq!(answer[..2], [1, 1], "{answer:02x?}");
        answer[2] == 1
    }

    pub(super) fn counters(&self, port: &str) -> RecipePortCounters {
        self.controller.counters().ports[port]
    }
}

pub(super) fn peer(port: u16) -> SocketAddr {
    (Ipv4Addr::LOCALHOST, port).into()
}

pub(super) fn rs485() -> SimBus {
    SimBus::Rs485(Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: Duration::from_millis(50),
        turnaround: Duration::from_micros(300),
        echo: proto_core::config::Echo::No,
    })
}

pub(super) fn system(names: &[&str]) -> Vec<SimField> {
    let vars = names.iter().flat_map(|name| VarRange::parse(name).unwrap().iter());
    vars.map(|var| SimField { name: var.to_string(), field: Field::System(var) }).collect()
}

pub(super) fn user(types: &[ScalarType]) -> Vec<SimField> {
    let field =
        |(nth, ty): (usize, &ScalarType)| SimField { name: format!("f{nth}"), field: Field::User(*ty) };
    types.iter().enumerate().map(field).collect()
}

pub(super) fn part(head: &[u8], tail: &[u8], fields: Vec<SimField>) -> Option<SimStreamPart> {
    Some(SimStreamPart { head: head.to_vec(), tail: tail.to_vec(), fields })
}

pub(super) fn can(id: u16, fields: Vec<SimField>) -> SimCanFrame {
    SimCanFrame { id: CanId::Standard(id), fields }
}

/// A stream recipe with the delimiters of the worked examples.
pub(super) fn stream_recipe(mode: Mode, input: Vec<SimField>, output: Vec<SimField>) -> SimRecipe {
    let parts = SimParts::Stream {
        input: part(&[255, 255], &[238, 238], input),
        output: part(&[255, 255], &[254, 254], output),
    };
    SimRecipe { name: "r".to_owned(), mode, parts }
}

pub(super) fn can_recipe(mode: Mode, input: Vec<SimCanFrame>, output: Vec<SimCanFrame>) -> SimRecipe {
    SimRecipe { name: "r".to_owned(), mode, parts: SimParts::Can { input, output } }
}

/// A configuration with one port `p` and one recipe.
pub(super) fn one_port(bus: SimBus, recipe: SimRecipe) -> SimConfig {
    let port = SimPort { name: "p".to_owned(), bus, recipe: Some(0), cycle: Duration::from_millis(4) };
    SimConfig { recipes: vec![recipe], ports: vec![port], ..SimConfig::default() }
}

pub(super) fn with_program(mut config: SimConfig, name: &str, script: &str) -> SimConfig {
    config.programs.push(SimProgram { name: name.to_owned(), script: script.to_owned() });
    config
}

pub(super) fn with_initial(mut config: SimConfig, values: &[(&str, f64)]) -> SimConfig {
    for (name, value) in values {
        let target = target(name);
        config.initial.push(Initial { target, value: *value });
    }
    config
}

pub(super) fn with_power(mut config: SimConfig, power: Power) -> SimConfig {
    config.robot.power = power;
    config
}

pub(super) fn with_dialect(mut config: SimConfig, name: &str) -> SimConfig {
    config.robot.dialect = name.to_owned();
    config
}

pub(super) fn target(name: &str) -> InitialTarget {
    name.parse().unwrap()
}
