//! Links among three hosts on one Ethernet: the gateway, its controller and another host.

mod datagrams;
mod delivery;
mod listening;
mod order;

use core::cell::{Cell, RefCell};
use core::future::poll_fn;
use core::task::{Context, Poll, Waker};
use std::boxed::Box;
use std::collections::VecDeque;
use std::rc::Rc;
use std::vec;
use std::vec::Vec;

use embassy_futures::block_on;
use embassy_futures::join::{join, join3};
use embassy_futures::select::select;
use embassy_net::driver::{Capabilities, Driver as Device, HardwareAddress, LinkState};
use embassy_net::{Config, IpEndpoint, Ipv4Cidr, Runner, StackResources, StaticConfigV4};
use embassy_time::{Duration, with_timeout};
use proto_core::config::{
    Bus, Delimiter, FieldSpec, Name, Parity, Parts, Port, Recipe, Rs485, Span, StreamPart,
};
use proto_core::engine::{LinkCounters, PortId};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration as CoreDuration;

use super::*;
use crate::tasks::test_clock::{TestClock, advance};
use crate::tasks::watchdog::{TaskName, TaskWatch};

const GATEWAY: u8 = 1;
const CONTROLLER: u8 = 2;
const OTHER: u8 = 3;
const PORT: u16 = 50_000;
const FIELD: PortId = PortId(0);
/// Maximum age of a delivered frame.
const TIMEOUT: Duration = Duration::from_secs(1);
const FRAME: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];

/// Frames that wait for each host, and which hosts are cut off.
struct Wire {
    waiting: RefCell<[VecDeque<Vec<u8>>; 3]>,
    wakers: RefCell<[Option<Waker>; 3]>,
    no_receive: Cell<u8>,
    no_send: Cell<u8>,
    /// Number of frames sent by hosts that can send.
    frames_sent: Cell<usize>,
    /// Sender and contents of all frames, also of those not delivered.
    log: RefCell<Vec<(u8, Vec<u8>)>>,
    step: Cell<Duration>,
}

impl Wire {
    fn new() -> Self {
        Self {
            waiting: RefCell::default(),
            wakers: RefCell::default(),
            no_receive: Cell::new(0),
            no_send: Cell::new(0),
            frames_sent: Cell::new(0),
            log: RefCell::default(),
            step: Cell::new(Duration::from_micros(200)),
        }
    }

    /// From now on one host receives nothing and one sends nothing; 0 is none.
    fn cut_off(&self, no_receive: u8, no_send: u8) {
        self.no_receive.set(no_receive);
        self.no_send.set(no_send);
    }

    /// The TCP segments of the gateway since the log was cleared.
    fn segments(&self) -> Vec<Segment> {
        let log = self.log.borrow();
        log.iter().filter(|(host, _)| *host == GATEWAY).filter_map(|(_, frame)| Segment::of(frame)).collect()
    }

    fn has(&self, flag: u8) -> bool {
        self.segments().iter().any(|segment| segment.flags & flag != 0)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Segment {
    from: u16,
    flags: u8,
    payload: Vec<u8>,
}

const FIN: u8 = 1;
const SYN: u8 = 2;
const RST: u8 = 4;

impl Segment {
    fn of(frame: &[u8]) -> Option<Self> {
        let ip = frame.get(14..).filter(|ip| frame[12..14] == [8, 0] && ip[9] == 6)?;
        let tcp = &ip[usize::from(ip[0] & 0xF) * 4..usize::from(u16::from_be_bytes([ip[2], ip[3]]))];
        let payload = tcp[usize::from(tcp[12] >> 4) * 4..].to_vec();
        Some(Self { from: u16::from_be_bytes([tcp[0], tcp[1]]), flags: tcp[13], payload })
    }
}

/// A host's network interface.
struct End {
    wire: Rc<Wire>,
    host: u8,
}

struct Received(Vec<u8>);

impl embassy_net::driver::RxToken for Received {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(mut self, take: F) -> R {
        take(&mut self.0)
    }
}

struct Sends<'a>(&'a End);

impl embassy_net::driver::TxToken for Sends<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, fill: F) -> R {
        let mut frame = vec![0; len];
        let result = fill(&mut frame);
        let End { wire, host: own } = self.0;
        wire.log.borrow_mut().push((*own, frame.clone()));
        if wire.no_send.get() == *own {
            return result;
        }
        wire.frames_sent.set(wire.frames_sent.get() + 1);
        let mut wakers = wire.wakers.borrow_mut();
        for ((host, queue), waker) in (GATEWAY..).zip(wire.waiting.borrow_mut().iter_mut()).zip(&mut *wakers)
        {
            if host != *own && host != wire.no_receive.get() {
                queue.push_back(frame.clone());
                if let Some(waker) = waker.take() {
                    waker.wake();
                }
            }
        }
        result
    }
}

impl Device for End {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sends<'a>;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Received, Sends<'_>)> {
        let place = usize::from(self.host - GATEWAY);
        self.wire.wakers.borrow_mut()[place] = Some(cx.waker().clone());
        let frame = self.wire.waiting.borrow_mut()[place].pop_front()?;
        Some((Received(frame), Sends(self)))
    }

    fn transmit(&mut self, _: &mut Context<'_>) -> Option<Sends<'_>> {
        Some(Sends(self))
    }

    fn link_state(&mut self, _: &mut Context<'_>) -> LinkState {
        LinkState::Up
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = 1514;
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet([2, 0, 0, 0, 0, self.host])
    }
}

fn address(host: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 0, 0, host)
}

type Resources = StackResources<3>;

fn host<'d>(wire: &Rc<Wire>, host: u8, resources: &'d mut Resources) -> (Stack<'d>, Runner<'d, End>) {
    let cidr = Ipv4Cidr::new(address(host), 24);
    let config = StaticConfigV4 { address: cidr, gateway: None, dns_servers: Default::default() };
    let end = End { wire: Rc::clone(wire), host };
    embassy_net::new(end, Config::ipv4_static(config), resources, u64::from(host))
}

/// A controller, and nothing else.
fn controller_only() -> GatewayConfig {
    let mut config = GatewayConfig::empty();
    config.set_controller("10.0.0.2").unwrap();
    config
}

fn add_port(config: &mut GatewayConfig, name: &str, bus: Bus, recipe: u8) {
    let mut port = Port::new(Name::try_from(name).unwrap(), bus, recipe);
    port.timeout = CoreDuration::from_micros(TIMEOUT.as_micros());
    (port.cycle, port.stale_after) = (CoreDuration::from_secs(1), CoreDuration::from_secs(1));
    config.ports.push(port).unwrap();
}

fn add_recipe(config: &mut GatewayConfig, mode: Mode, input: Option<Span>, output: Option<Span>) {
    let delimiter = |bytes: &[u8]| Delimiter::from_slice(bytes).unwrap();
    let part = |fields| StreamPart::new(delimiter(&FRAME[..2]), delimiter(&FRAME[3..]), fields);
    let parts = Parts::Stream { input: input.map(part), output: output.map(part) };
    let name = Name::try_from(["a", "b"][config.recipes.len()]).unwrap();
    config.recipes.push(Recipe::new(name, mode, parts)).unwrap();
}

fn rs485() -> Bus {
    Bus::Rs485(Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: CoreDuration::from_millis(50),
        turnaround: CoreDuration::ZERO,
        echo: proto_core::config::Echo::No,
    })
}

/// A field port, and the listening port to which its frames are forwarded.
fn config(bus: Bus, controller: FirstSpeaker) -> GatewayConfig {
    let mut config = controller_only();
    let mut field = |name: &str| {
        config.fields.push(FieldSpec::System(SysVar::parse(name).unwrap())).unwrap();
    };
    field("DigitalOutputCommand[1]");
    for number in 1..=32 {
        field(&std::format!("WordInputReg[{number}]"));
    }
    for number in 1..=16 {
        field(&std::format!("FloatInputReg[{number}]"));
    }
    field("DigitalSignalStatus[1]");
    let (up, down) = (Span { start: 0, len: 49 }, Span { start: 49, len: 1 });
    add_recipe(&mut config, Mode::Realtime, Some(up), None);
    add_recipe(&mut config, Mode::Realtime, Some(up), (controller == FirstSpeaker::Frames).then_some(down));
    add_port(&mut config, "field", rs485(), 0);
    add_port(&mut config, "up", bus, 1);
    config.validate().unwrap();
    config
}

/// Whether the controller's client sends frames of its own.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FirstSpeaker {
    Nothing,
    Frames,
}

fn tcp_listen() -> Bus {
    Bus::TcpListen { listen: "0.0.0.0:50000".try_into().unwrap() }
}

fn udp_listen() -> Bus {
    Bus::UdpListen { listen: "0.0.0.0:50000".try_into().unwrap() }
}

fn listens(kind: LinkKind) -> bool {
    matches!(kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. })
}

/// Of a frame of the field.
const LEN: usize = 2 + 1 + 32 * 2 + 16 * 4 + 2;

/// A field frame that switches these outputs; it is forwarded to the controller unchanged.
fn switching(outputs: u8) -> [u8; LEN] {
    let mut frame = [0; LEN];
    (frame[0], frame[1], frame[2]) = (0xFF, 0xFF, outputs);
    (frame[LEN - 2], frame[LEN - 1]) = (0xEE, 0xEE);
    frame
}

/// What a test works with.
#[derive(Clone, Copy)]
struct Net<'a> {
    gateway: &'a Gateway,
    link: LinkId,
    controller: Stack<'a>,
    other_host: Stack<'a>,
    wire: &'a Wire,
}

impl Net<'_> {
    fn control(&self) -> &LinkControl {
        self.gateway.link(self.link).unwrap()
    }

    fn hear(&self, bytes: &[u8]) {
        self.gateway.input(Input::PortBytes { port: FIELD, bytes });
    }

    /// How often the link was up, whether it is, and its counters.
    fn link(&self) -> (u32, bool, LinkCounters) {
        self.gateway.report(|status| {
            let link = status.links().find(|link| link.id == self.link).unwrap();
            let is_up = matches!(link.state, proto_core::link::LinkState::Up { .. });
            (link.history.connects, is_up, *link.counters)
        })
    }

    /// Waits until the link was up so often and so many peers were refused.
    async fn seen(&self, connects: u32, refused_peers: u32) {
        let turned_away = || self.gateway.refused_peers().map(|(_, count)| count).max();
        until(|| (self.link().0, turned_away()) == (connects, Some(refused_peers))).await;
    }
}

/// Waits. All futures are polled all the time, so no waker is needed.
async fn until(mut is_so: impl FnMut() -> bool) {
    poll_fn(|_| if is_so() { Poll::Ready(()) } else { Poll::Pending }).await;
}

/// The gateway's listening address.
fn gateway_port() -> IpEndpoint {
    IpEndpoint::new(address(GATEWAY).into(), PORT)
}

/// Runs the controller and the other host beside the gateway's link, until they are done.
fn among(config: &GatewayConfig, which: impl Fn(LinkKind) -> bool, act: impl AsyncFnOnce(Net<'_>)) {
    let _clock = TestClock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(config).unwrap();
    let (link, kind) = gateway.links().find(|(_, kind)| which(*kind)).unwrap();
    let endpoint = Endpoint::of(config, kind);
    let watch = TaskWatch::<2>::new();
    let pulses = [TaskName::Engine, TaskName::Link(kind)].map(|name| watch.register(name).unwrap());
    let wire = Rc::new(Wire::new());
    let mut resources: [Resources; 3] = core::array::from_fn(|_| StackResources::new());
    let [of_gateway, of_controller, of_other] = &mut resources;
    let (own, mut own_runner) = host(&wire, GATEWAY, of_gateway);
    let (controller, mut controller_runner) = host(&wire, CONTROLLER, of_controller);
    let (other_host, mut other_runner) = host(&wire, OTHER, of_other);
    let mut memory = [0; LinkBuffers::ALL];
    let buffers = LinkBuffers::take(&mut memory.as_mut_slice(), &endpoint).unwrap();
    let network = join3(own_runner.run(), controller_runner.run(), other_runner.run());
    let driven = join(gateway.keep_time(pulses[0]), run(&gateway, pulses[1], link, own, &endpoint, buffers));
    let net = Net { gateway: &gateway, link, controller, other_host, wire: &wire };
    let act = async {
        gateway.input(Input::PortUp { port: FIELD });
        with_timeout(Duration::from_secs(200), act(net)).await.expect("it hangs");
    };
    let time = poll_fn(|_| {
        advance(wire.step.get());
        Poll::<()>::Pending
    });
    block_on(select(pin!(act), pin!(join3(network, driven, time))));
}
