//! Listening links among three hosts on one Ethernet: the gateway, its controller and a stranger.

use core::future::poll_fn;
use core::task::{Context, Poll};
use std::boxed::Box;
use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::vec;
use std::vec::Vec;

use embassy_futures::block_on;
use embassy_futures::join::{join, join3};
use embassy_net::driver::{Capabilities, Driver as Device, HardwareAddress, LinkState};
use embassy_net::{Config, Ipv4Cidr, StackResources, StaticConfigV4};
use embassy_time::Timer;
use proto_core::config::{
    Bus, Delimiter, FieldSpec, Name, OnStale, Parity, Parts, Port, Recipe, Rs485, SendOn, Span, StreamPart,
};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration as CoreDuration;

use super::*;
use crate::test_clock::{Clock, advance};
use crate::watchdog::{TaskName, Watch};

const GATEWAY: u8 = 1;
const CONTROLLER: u8 = 2;
const STRANGER: u8 = 3;
const PORT: u16 = 50_000;
const FRAME: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];

/// What waits for each host, and which one does not hear or speak any more.
#[derive(Default)]
struct Wire {
    waiting: RefCell<[VecDeque<Vec<u8>>; 3]>,
    deaf: Cell<u8>,
    mute: Cell<u8>,
    /// Frames of all so far.
    spoken: Cell<usize>,
}

/// A host's end of the wire. All hosts are polled all the time, so nobody has to be woken.
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
        if wire.mute.get() == *own {
            return result;
        }
        wire.spoken.set(wire.spoken.get() + 1);
        for (host, queue) in (GATEWAY..).zip(wire.waiting.borrow_mut().iter_mut()) {
            if host != *own && host != wire.deaf.get() {
                queue.push_back(frame.clone());
            }
        }
        result
    }
}

impl Device for End {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sends<'a>;

    fn receive(&mut self, _: &mut Context<'_>) -> Option<(Received, Sends<'_>)> {
        let frame = self.wire.waiting.borrow_mut()[usize::from(self.host - GATEWAY)].pop_front()?;
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

/// A field port, and a listening port that its frames go out by.
fn config(bus: Bus) -> GatewayConfig {
    let mut config = GatewayConfig::empty();
    let controller = &mut config.controller;
    controller.address = String::try_from("10.0.0.2").unwrap();
    controller.dialect = String::try_from("v2.3").unwrap();
    (controller.command_port, controller.state_port, controller.modbus_port) = (2000, 2001, 502);
    let var = SysVar::parse("DigitalOutputCommand[1]").unwrap();
    config.fields.push(FieldSpec::System(var)).unwrap();
    let delimiter = |bytes: &[u8]| Delimiter::from_slice(bytes).unwrap();
    let fields = Span { start: 0, len: 1 };
    let input = StreamPart { head: delimiter(&FRAME[..2]), tail: delimiter(&FRAME[3..]), fields };
    let parts = Parts::Stream { input: Some(input), output: None };
    let name = |name| Name::try_from(name).unwrap();
    let (on_stale, send) = (OnStale::Hold, SendOn::Period);
    config.recipes.push(Recipe { name: name("a"), mode: Mode::Realtime, parts, on_stale, send }).unwrap();
    let line = Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: CoreDuration::from_millis(50),
        turnaround: CoreDuration::ZERO,
    };
    let second = CoreDuration::from_secs(1);
    let (cycle, timeout, stale_after) = (second, second, second);
    let on_timeout = Span { start: 0, len: 0 };
    for (name, bus) in [(name("field"), Bus::Rs485(line)), (name("up"), bus)] {
        let port = Port { name, bus, recipe: 0, cycle, timeout, on_timeout, stale_after };
        config.ports.push(port).unwrap();
    }
    config
}

/// Runs what the controller and the stranger do beside the gateway, until they are done.
fn among(bus: Bus, act: impl AsyncFnOnce(&Gateway, Stack<'_>, Stack<'_>, &Wire)) {
    let _clock = Clock::take();
    let config = config(bus);
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&config).unwrap();
    let (link, kind) = gateway
        .links()
        .find(|(_, kind)| matches!(kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. }))
        .unwrap();
    let endpoint = Endpoint::of(&config, kind);
    let watch = Watch::<2>::new();
    let pulses = [TaskName::Engine, TaskName::Link(kind)].map(|name| watch.register(name).unwrap());
    let wire = Rc::new(Wire::default());
    let mut resources: [StackResources<3>; 3] = core::array::from_fn(|_| StackResources::new());
    let [of_gateway, of_controller, of_stranger] = &mut resources;
    let host = |host, resources| {
        let cidr = Ipv4Cidr::new(address(host), 24);
        let config = StaticConfigV4 { address: cidr, gateway: None, dns_servers: Default::default() };
        let end = End { wire: Rc::clone(&wire), host };
        embassy_net::new(end, Config::ipv4_static(config), resources, u64::from(host))
    };
    let (own, mut own_runner) = host(GATEWAY, of_gateway);
    let (controller, mut controller_runner) = host(CONTROLLER, of_controller);
    let (stranger, mut stranger_runner) = host(STRANGER, of_stranger);
    let mut memory = [0; Buffers::SIZE];
    let buffers = Buffers::take(&mut memory.as_mut_slice()).unwrap();
    let network = join3(own_runner.run(), controller_runner.run(), stranger_runner.run());
    let driven = join(gateway.keep_time(pulses[0]), run(&gateway, pulses[1], link, own, &endpoint, buffers));
    let act = async {
        with_timeout(Duration::from_secs(60), act(&gateway, controller, stranger, &wire))
            .await
            .expect("it hangs");
    };
    let time = poll_fn(|_| {
        advance(Duration::from_micros(200));
        Poll::<()>::Pending
    });
    block_on(select(pin!(act), pin!(join3(network, driven, time))));
}

/// Waits until the link was up so often and so many were turned away.
async fn seen(gateway: &Gateway, connects: u32, strangers: u32) {
    poll_fn(|_| {
        let mut ups = 0;
        gateway.report(
            |link| {
                if link.kind.name().ends_with("-listen") {
                    ups = link.history.connects;
                }
            },
            |_, _| {},
        );
        let turned_away = gateway.strangers().map(|(_, count)| count).max();
        if (u64::from(ups), turned_away) == (u64::from(connects), Some(strangers)) {
            Poll::Ready(())
        } else {
            Poll::Pending
        }
    })
    .await;
}

#[test]
fn a_tcp_listener_takes_the_controller_only() {
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    among(Bus::TcpListen { listen }, async |gateway, controller, stranger, _| {
        let at = IpEndpoint::new(address(GATEWAY).into(), PORT);
        let mut buffers = [[0; 256]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let mut other = TcpSocket::new(stranger, other_rx, other_tx);
        for round in 1..=3 {
            // The listener may be busy with turning the one before away.
            while other.connect(at).await.is_err() {
                other.abort();
            }
            assert!(!matches!(other.read(&mut [0; 8]).await, Ok(1..)));
            other.abort();
            seen(gateway, 0, round).await;
        }
        let mut own = TcpSocket::new(controller, rx, tx);
        while own.connect(at).await.is_err() {
            own.abort();
        }
        seen(gateway, 1, 3).await;
        // A controller that has nothing to say is no less there.
        Timer::after(VANISHED * 2).await;
        seen(gateway, 1, 3).await;
        // There is one socket, and it is taken.
        assert!(other.connect(at).await.is_err());
        own.abort();
        let _ = own.flush().await;
    });
}

#[test]
fn a_connection_that_never_comes_about_does_not_keep_the_listener() {
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    among(Bus::TcpListen { listen }, async |gateway, controller, stranger, wire| {
        let at = IpEndpoint::new(address(GATEWAY).into(), PORT);
        let mut buffers = [[0; 256]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let mut other = TcpSocket::new(stranger, other_rx, other_tx);
        other.connect(at).await.unwrap();
        seen(gateway, 0, 1).await;
        other.abort();
        other.flush().await.unwrap();
        // Now the hosts know each other. It asks for a connection and is gone before it is answered.
        wire.deaf.set(STRANGER);
        let before = wire.spoken.get();
        let asked = poll_fn(|_| if wire.spoken.get() == before { Poll::Pending } else { Poll::Ready(()) });
        assert!(matches!(select(other.connect(at), asked).await, Either::Second(())));
        wire.mute.set(STRANGER);
        let mut own = TcpSocket::new(controller, rx, tx);
        let mut refused = 0;
        while own.connect(at).await.is_err() {
            own.abort();
            refused += 1;
        }
        assert!(refused > 0, "nothing was in its way");
        seen(gateway, 1, 1).await;
    });
}

#[test]
fn a_controller_that_was_switched_off_finds_the_listener_free_again() {
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    among(Bus::TcpListen { listen }, async |gateway, controller, _, wire| {
        let at = IpEndpoint::new(address(GATEWAY).into(), PORT);
        let mut buffers = [[0; 256]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = TcpSocket::new(controller, rx, tx);
        own.connect(at).await.unwrap();
        seen(gateway, 1, 0).await;
        // Nobody hears that it goes.
        wire.mute.set(CONTROLLER);
        own.abort();
        own.flush().await.unwrap();
        wire.mute.set(0);
        let mut refused = 0;
        while own.connect(at).await.is_err() {
            own.abort();
            refused += 1;
        }
        assert!(refused > 0, "nothing was in its way");
        seen(gateway, 2, 0).await;
    });
}

#[test]
fn a_udp_listener_takes_the_controller_only() {
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    among(Bus::UdpListen { listen }, async |gateway, controller, stranger, _| {
        let at = IpEndpoint::new(address(GATEWAY).into(), PORT);
        let mut buffers = [[0; 256]; 4];
        let mut metadata = [[PacketMetadata::EMPTY; 4]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let [rx_meta, tx_meta, other_rx_meta, other_tx_meta] = &mut metadata;
        let mut other = UdpSocket::new(stranger, other_rx_meta, other_rx, other_tx_meta, other_tx);
        other.bind(1).unwrap();
        for round in 1..=3 {
            other.send_to(&FRAME, at).await.unwrap();
            seen(gateway, 0, round).await;
        }
        let mut own = UdpSocket::new(controller, rx_meta, rx, tx_meta, tx);
        own.bind(1).unwrap();
        own.send_to(&FRAME, at).await.unwrap();
        seen(gateway, 1, 3).await;
        other.send_to(&FRAME, at).await.unwrap();
        seen(gateway, 1, 4).await;
    });
}
