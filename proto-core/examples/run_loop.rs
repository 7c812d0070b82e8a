//! A gateway from configuration to the first output, on a board that is made of variables: what a
//! driver has to do, in full. Run it with `cargo run -p proto-core --example run_loop`.
//!
//! A device on a serial line sends the frame of worked example 2 (docs/wire/recipes.md section 8),
//! the gateway writes DO1 by Modbus, and sends the outputs as the controller shows them back to the
//! device.

use std::collections::VecDeque;

use proto_core::config::{
    Bus, ControllerLink, FieldSpec, GatewayConfig, OnStale, Parity, Parts, Port, Recipe, Rs485, SendOn, Span,
    StreamPart,
};
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

type Failure = Box<dyn std::error::Error>;
type Gateway = Engine<1, 1, 1>;

fn main() -> Result<(), Failure> {
    // Boxed because a host's stack is small for unoptimised copies; a board has it in a static.
    let mut gateway = Box::new(Gateway::new(&configuration()?)?);
    for link in gateway.links() {
        println!("needs the link {} ({})", link.kind.name(), link.id.0);
    }
    let mut board = Board::new();
    board.happens(0, Event::PortUp);
    board.happens(10_000, Event::PortBytes(vec![0xFF, 0xFF, 0x01, 0xEE]));
    board.happens(10_100, Event::PortBytes(vec![0xEE]));

    let mut out = [0; OUTPUT_BUFFER];
    while board.now < Instant::from_millis(20) {
        let until = loop {
            match gateway.poll_output(board.now, &mut out) {
                Output::Sleep { until } => break until,
                output => board.carry_out(output),
            }
        };
        match board.next_event(until) {
            Some(event) => gateway.handle(board.now, event.input()),
            // All that has happened was told: now deadlines may pass.
            None => gateway.handle(board.now, Input::Tick),
        }
    }

    let counters = gateway.port_counters(PORT).ok_or("no such port")?;
    println!("frames in {}, frames out {}", counters.frames_in, counters.frames_out);
    assert!(board.coils.0[192], "DO1 was switched");
    assert_eq!(board.shown.last(), Some(&vec![0xFF, 0xFF, 0x01, 0xFE, 0xFE]), "and shown to the device");
    Ok(())
}

const PORT: PortId = PortId(0);

/// On a host such a configuration comes from TOML, on a board from flash by postcard.
fn configuration() -> Result<GatewayConfig, Failure> {
    let field = |name| SysVar::parse(name).map(FieldSpec::System);
    let bytes = |bytes: &[u8]| heapless::Vec::from_slice(bytes).map_err(|_| "more than eight bytes");
    let part = |head: &[u8], tail: &[u8], start| -> Result<StreamPart, Failure> {
        Ok(StreamPart { head: bytes(head)?, tail: bytes(tail)?, fields: Span { start, len: 1 } })
    };
    let line = Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: Duration::from_millis(50),
        turnaround: Duration::from_micros(100),
    };
    let parts = Parts::Stream {
        input: Some(part(&[0xFF, 0xFF], &[0xEE, 0xEE], 0)?),
        output: Some(part(&[0xFF, 0xFF], &[0xFE, 0xFE], 1)?),
    };
    let recipe = Recipe {
        name: "system".try_into().map_err(|_| "too long")?,
        mode: Mode::Realtime,
        parts,
        on_stale: OnStale::Stop,
        send: SendOn::Period,
    };
    let port = Port {
        name: "rs485-1".try_into().map_err(|_| "too long")?,
        bus: Bus::Rs485(line),
        recipe: 0,
        cycle: Duration::from_millis(4),
        timeout: Duration::from_millis(100),
        on_timeout: Span::default(),
        stale_after: Duration::from_millis(500),
    };
    Ok(GatewayConfig {
        controller: ControllerLink {
            address: "192.168.12.138".try_into().map_err(|_| "too long")?,
            dialect: "v2.3".try_into().map_err(|_| "too long")?,
            command_port: 2000,
            state_port: 2001,
            modbus_port: 502,
            recipe_link: None,
        },
        network: None,
        recipes: [recipe].into_iter().collect(),
        ports: [port].into_iter().collect(),
        fields: [field("DigitalOutputCommand[1]")?, field("DigitalSignalStatus[4]")?].into_iter().collect(),
        commands: heapless::Vec::new(),
        safe_values: heapless::Vec::new(),
    })
}

/// What a driver reports; a real one has UARTs and sockets instead of this queue.
#[derive(Debug)]
enum Event {
    PortUp,
    PortBytes(Vec<u8>),
    PortSent,
    LinkUp(LinkId),
    LinkBytes(LinkId, Vec<u8>),
    LinkSent(LinkId),
    LinkAcked(LinkId, u32),
}

impl Event {
    fn input(&self) -> Input<'_> {
        match self {
            Self::PortUp => Input::PortUp { port: PORT },
            Self::PortBytes(bytes) => Input::PortBytes { port: PORT, bytes },
            Self::PortSent => Input::PortSent { port: PORT },
            Self::LinkUp(link) => Input::LinkUp { link: *link },
            Self::LinkBytes(link, bytes) => Input::LinkBytes { link: *link, bytes },
            Self::LinkSent(link) => Input::LinkSent { link: *link },
            Self::LinkAcked(link, left) => Input::LinkAcked { link: *link, left: *left },
        }
    }
}

/// The board, the device on its line and the controller behind its network.
struct Board {
    now: Instant,
    events: VecDeque<(Instant, Event)>,
    modbus: Server,
    coils: CoilMap,
    shown: Vec<Vec<u8>>,
}

impl Board {
    fn new() -> Self {
        let (events, shown) = (VecDeque::new(), Vec::new());
        Self { now: Instant::ZERO, events, modbus: Server::new(), coils: CoilMap([false; 232]), shown }
    }

    fn happens(&mut self, in_micros: u64, event: Event) {
        let at = self.now + Duration::from_micros(in_micros);
        let place = self.events.partition_point(|(other, _)| *other <= at);
        self.events.insert(place, (at, event));
    }

    /// Waits: the clock jumps to what happens next. What waits comes before the deadline, even one that
    /// has passed: a driver that was busy tells what arrived meanwhile, and then that it is late.
    fn next_event(&mut self, until: Instant) -> Option<Event> {
        let next = self.events.front().map_or(Instant::NEVER, |(at, _)| *at);
        self.now = self.now.max(next.min(until));
        if next > self.now {
            return None;
        }
        self.events.pop_front().map(|(_, event)| event)
    }

    fn carry_out(&mut self, output: Output<'_>) {
        match output {
            Output::PortSend { bytes, .. } => {
                println!("{:>6} us  device <  {bytes:02X?}", self.now.as_micros());
                self.shown.push(bytes.to_vec());
                // 10 bits a byte at 115200 baud.
                self.happens(bytes.len() as u64 * 87, Event::PortSent);
            }
            Output::LinkOpen { link, .. } => self.happens(300, Event::LinkUp(link)),
            Output::LinkSend { link, bytes } => {
                println!("{:>6} us  modbus >  {bytes:02X?}", self.now.as_micros());
                // The socket has room again; the controller's TCP acknowledges before its answer comes.
                self.happens(20, Event::LinkSent(link));
                self.happens(300, Event::LinkAcked(link, 0));
                let (mut request, mut answer) = (bytes, [0; MAX_ADU]);
                while let Some(Ok(len)) = self.modbus.receive(&mut request, &mut self.coils, &mut answer) {
                    self.happens(400, Event::LinkBytes(link, answer[..len].to_vec()));
                }
            }
            // One serial port, and a link that nobody closes.
            _ => {}
        }
    }
}

/// As much of the controller's Modbus map as this takes.
struct CoilMap([bool; 232]);

impl RegisterBank for CoilMap {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let coils = self.0.get(usize::from(address)..usize::from(address) + usize::from(count));
        for (nth, &on) in coils.ok_or(Exception::IllegalDataAddress)?.iter().enumerate() {
            packed[nth / 8] |= u8::from(on) << (nth % 8);
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let first = usize::from(address);
        let place = self.0.get_mut(first..first + usize::from(coils.count()));
        let place = place.ok_or(Exception::IllegalDataAddress)?;
        for (coil, on) in place.iter_mut().zip(coils.iter()) {
            *coil = on;
        }
        Ok(())
    }

    fn read_holding(&self, _: u16, _: &mut [[u8; 2]]) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }
}

#[test]
fn the_example_runs() -> Result<(), Failure> {
    main()
}
