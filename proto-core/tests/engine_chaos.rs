//! An engine whose driver keeps no rule: wrong ids, reports of nothing that was started, bytes on
//! everything, clocks that jump, stand still and go back. It never panics, always comes to rest,
//! and does no more for one input than its size allows.

mod rig;

use proptest::prelude::*;
use proto_core::config::*;
use proto_core::engine::{BusState, Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;
use rig::*;

/// Every kind of port, link, binding and trigger.
fn cell() -> GatewayConfig {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..2]", "WordInputReg[30..32]"], &["RobotState[26..29]"]);
    cell.recipe_link(up);
    let system = cell.stream(
        &["DigitalOutputCommand[1..3]", "WordInputReg[1..4]"],
        &["RobotState[8..11]", "WordOutputReg[1]", "BitOutputReg[3]", "RobotState[26]"],
    );
    cell.rs485(system);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let commands = ["run(pick.jspf,50)", "stop", "state", "getlasterror", "pause", "disable", "poweroff"];
    let entries: Vec<_> = (1..).zip(commands).collect();
    let table = cell.commands(&entries);
    let when = [CommandWhen::Change, CommandWhen::Frame];
    let [change, frame] = when.map(|when| user_in(ScalarType::Byte, InputBinding::Commands { table, when }));
    let word = InputBinding::Variable { var: var("WordInputReg[30]"), scale: 2.0, offset: -1.0 };
    let fields = cell.fields([change, frame, user_in(ScalarType::Byte, word)]);
    let input = cell.part(&[255], &[], fields);
    let shown = [
        user_out(ScalarType::Byte, OutputBinding::Reply),
        user_out(ScalarType::Word, OutputBinding::Counter),
    ];
    let fields = cell.fields(shown);
    let output = cell.part(&[254], &[], fields);
    let panel = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().send = SendOn::Frame;
    cell.rs485(panel);
    let bus = cell.can(
        &[(1, &["BitInputReg[1]"]), (2, &["BitInputReg[2]", "ForceEnd[1]"])],
        &[(3, &["RobotState[1..2]"]), (4, &["DigitalSignalStatus[1]"])],
    );
    cell.last_recipe().on_stale = OnStale::Stop;
    cell.can_port(bus);
    let fields = cell.fields(shown);
    let output = cell.part(&[], &[9], fields);
    let lamp = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.last_recipe().send = SendOn::Rising { var: var("DigitalOutputCommand[1]"), bit: 0 };
    cell.rs485(lamp);
    let fields = cell.system(&["ForceEnd[2]"]);
    let input = cell.part(&[1, 1], &[2], fields);
    let sensor = cell.recipe(Mode::Realtime, Parts::Stream { input, output: None });
    cell.rs485(sensor);
    let listen = |port: u16| heapless::String::try_from(format!("0.0.0.0:{port}").as_str()).unwrap();
    let client = cell.stream(&["FloatInputReg[1]"], &["RobotState[30]"]);
    cell.port(Bus::TcpListen { listen: listen(50_000) }, client);
    cell.port(Bus::UdpListen { listen: listen(50_001) }, client);
    let hand = cell.stream(&["FloatInputReg[1]"], &["RobotState[30]"]);
    cell.rs485(hand);
    cell.0
}

/// One call, owned.
#[derive(Debug, Clone)]
enum Call {
    PortUp(u8),
    PortDown(u8),
    PortBytes(u8, Vec<u8>),
    PortCan(u8, u16, usize, bool),
    PortSent(u8),
    PortBus(u8, bool),
    LinkUp(u8),
    LinkDown(u8),
    LinkBytes(u8, Vec<u8>),
    LinkSent(u8),
    LinkAcked(u8, u32),
    Tick,
}

/// What the clock does before a call, µs.
#[derive(Debug, Clone, Copy)]
enum Clock {
    On(u64),
    Back(u64),
    To(u64),
}

fn calls() -> impl Strategy<Value = Vec<(Clock, Call)>> {
    let port = || 0..10_u8;
    let link = || 0..14_u8;
    let byte = prop_oneof![prop::sample::select(vec![255_u8, 254, 238, 0, 1, 2, 3, 9]), any::<u8>(),];
    // Pieces of what a controller sends, and of what it never would.
    let text = prop::sample::select(vec![
        "run start",
        "stop success\r\n",
        "6:0:5:2",
        "pause success",
        "script finish",
        "1f:x\n",
    ]);
    let bytes = || {
        prop_oneof![
            prop::collection::vec(byte.clone(), 0..60),
            text.clone().prop_map(|text| text.as_bytes().to_vec()),
            Just(vec![0; 1468]),
            (0..4_u8, any::<u8>()).prop_map(|(id, len)| vec![0, id, 0, 0, 0, len, 1, 3, 2, 0, 7]),
            prop::collection::vec(0..8_u8, 0..20).prop_map(|fields| {
                fields.chunks(3).flat_map(|fields| [&[255], fields].concat()).collect()
            }),
        ]
    };
    let call = prop_oneof![
        1 => port().prop_map(Call::PortUp),
        1 => port().prop_map(Call::PortDown),
        6 => (port(), bytes()).prop_map(|(port, bytes)| Call::PortBytes(port, bytes)),
        3 => (port(), 0..6_u16, 0..9_usize, any::<bool>())
            .prop_map(|(port, id, len, remote)| Call::PortCan(port, id, len, remote)),
        2 => port().prop_map(Call::PortSent),
        1 => (port(), any::<bool>()).prop_map(|(port, off)| Call::PortBus(port, off)),
        4 => link().prop_map(Call::LinkUp),
        1 => link().prop_map(Call::LinkDown),
        6 => (link(), bytes()).prop_map(|(link, bytes)| Call::LinkBytes(link, bytes)),
        2 => link().prop_map(Call::LinkSent),
        2 => (link(), prop_oneof![Just(0), 0..100_u32, any::<u32>()])
            .prop_map(|(link, left)| Call::LinkAcked(link, left)),
        6 => Just(Call::Tick),
    ];
    let clock = prop_oneof![
        10 => (0..5_000_u64).prop_map(Clock::On),
        4 => (0..500_000_u64).prop_map(Clock::On),
        1 => (0..3_000_000_u64).prop_map(Clock::On),
        1 => (0..10_000_u64).prop_map(Clock::Back),
        1 => prop_oneof![any::<u64>(), (u64::MAX - 20_000_000)..=u64::MAX].prop_map(Clock::To),
    ];
    prop::collection::vec((clock, call), 1..150)
}

/// More than all ports and links can have to say at once.
const MOST_OUTPUTS: usize = 64;

fn call(engine: &mut Engine, now: Instant, call: &Call) {
    let frame;
    let input = match call {
        Call::PortUp(port) => Input::PortUp { port: PortId(*port) },
        Call::PortDown(port) => Input::PortDown { port: PortId(*port) },
        Call::PortBytes(port, bytes) => Input::PortBytes { port: PortId(*port), bytes },
        Call::PortCan(port, id, len, remote) => {
            let id = CanId::Standard(*id);
            let data = [1, 0, 0, 128, 63, 3, 4, 5];
            frame = if *remote { CanFrame::remote(id, *len) } else { CanFrame::new(id, &data[..*len]) };
            Input::PortCan { port: PortId(*port), frame: frame.unwrap() }
        }
        Call::PortSent(port) => Input::PortSent { port: PortId(*port) },
        Call::PortBus(port, off) => {
            let state = if *off { BusState::BusOff } else { BusState::Active };
            Input::PortBus { port: PortId(*port), state }
        }
        Call::LinkUp(link) => Input::LinkUp { link: LinkId(*link) },
        Call::LinkDown(link) => Input::LinkDown { link: LinkId(*link) },
        Call::LinkBytes(link, bytes) => Input::LinkBytes { link: LinkId(*link), bytes },
        Call::LinkSent(link) => Input::LinkSent { link: LinkId(*link) },
        Call::LinkAcked(link, left) => Input::LinkAcked { link: LinkId(*link), left: *left },
        Call::Tick => Input::Tick,
    };
    engine.handle(now, input);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn no_driver_can_break_it(calls in calls()) {
        let mut engine: Box<Engine> = Box::new(Engine::new(&cell()).unwrap());
        let mut now = Instant::from_millis(5_000);
        let mut newest = now;
        let mut out = [0; OUTPUT_BUFFER];
        for (clock, next) in &calls {
            now = match *clock {
                Clock::On(micros) => now + Duration::from_micros(micros),
                Clock::Back(micros) => now - Duration::from_micros(micros),
                Clock::To(micros) => Instant::from_micros(micros),
            };
            call(&mut engine, now, next);
            let mut outputs = 0;
            let until = loop {
                match engine.poll_output(now, &mut out) {
                    Output::Sleep { until } => break until,
                    Output::PortSend { bytes, .. } | Output::LinkSend { bytes, .. } => {
                        prop_assert!(!bytes.is_empty());
                    }
                    _ => {}
                }
                outputs += 1;
                prop_assert!(outputs <= MOST_OUTPUTS, "{next:?} leads to no end of outputs");
            };
            newest = newest.max(now);
            // What is due already waits for the tick that is late.
            prop_assert!(until <= engine.deadline().max(newest), "{next:?} at {now:?}: would sleep through a deadline");
            // Only a tick lets deadlines pass: before it, they may lie in the past.
            let ticked = matches!(next, Call::Tick);
            prop_assert!(
                !ticked || until > now || now == Instant::NEVER,
                "{next:?} at {now:?}: asked for {until:?}"
            );
            let heartbeat = newest + Duration::from_millis(250);
            prop_assert!(until <= heartbeat, "{next:?} at {now:?}: would sleep until {until:?}");
            if let Call::LinkBytes(link, bytes) = next {
                engine.is_frame(LinkId(*link), bytes);
            }
        }
    }
}
