//! Data that TCP does not deliver in time is never delivered.

use embassy_futures::select::Either;
use embassy_net::tcp::TcpSocket;
use embassy_time::{Instant, Timer};
use proto_core::config::{CommandEntry, CommandWhen, InputBinding};
use proto_core::wire::scalar::ScalarType;

use super::*;
use crate::tasks::led::Condition;

/// Of a connection for frames.
const TX: usize = TX_FRAMES;

/// The controller's client, connected.
async fn connected<'a>(net: &Net<'a>, rx: &'a mut [u8], tx: &'a mut [u8]) -> TcpSocket<'a> {
    let mut own = TcpSocket::new(net.controller, rx, tx);
    own.connect(gateway_port()).await.unwrap();
    net.seen(1, 0).await;
    own
}

/// The outputs that the next frame of the gateway switches.
async fn next(own: &mut TcpSocket<'_>) -> u8 {
    let mut frame = [0; LEN];
    let mut len = 0;
    while len < frame.len() {
        len += own.read(&mut frame[len..]).await.unwrap();
    }
    assert_eq!(frame, switching(frame[2]));
    frame[2]
}

#[test]
fn what_was_acknowledged_is_told_in_time_and_before_the_answer() {
    let config = config(tcp_listen(), FirstSpeaker::Frames);
    among(&config, listens, async |net| {
        let mut buffers = [[0; 512]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = connected(&net, rx, tx).await;
        let watching = async {
            let mut before = 0;
            until(|| {
                let received = net.link().2.received;
                if core::mem::replace(&mut before, received) != received {
                    assert_eq!(net.control().unacknowledged(), 0, "the answer was told first");
                }
                false
            })
            .await;
        };
        let talking = async {
            for round in 1..=50 {
                net.hear(&switching(round));
                assert_eq!(net.control().unacknowledged() as usize, LEN);
                assert_eq!(next(&mut own).await, round);
                assert!(own.write(&FRAME).await.is_ok());
                until(|| net.link().2.received == u32::from(round)).await;
            }
            // Without an answer the acknowledgement itself is seen.
            for outputs in 51..=100 {
                net.hear(&switching(outputs));
                assert_eq!(next(&mut own).await, outputs);
                let begin = Instant::now();
                until(|| net.control().unacknowledged() == 0).await;
                let delay = Instant::now() - begin;
                // The peer's delayed acknowledgement, and the interval of checking.
                assert!(delay <= Duration::from_millis(21), "{delay}");
            }
        };
        select(watching, talking).await;
        let (connects, is_up, counters) = net.link();
        assert_eq!((connects, is_up, counters.sent, counters.unacknowledged), (1, true, 100, 0));
    });
}

#[test]
fn a_peer_that_acknowledges_late_slows_nothing() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let (mut rx, mut tx) = ([0; 8192], [0; 256]);
        let mut own = connected(&net, &mut rx, &mut tx).await;
        for _ in 0..5 {
            net.wire.no_send.set(CONTROLLER);
            for outputs in 1..=30 {
                let begin = Instant::now();
                net.hear(&switching(outputs));
                assert_eq!(next(&mut own).await, outputs);
                let time = Instant::now() - begin;
                assert!(time <= Duration::from_millis(1), "{time}");
                Timer::at(begin + Duration::from_millis(4)).await;
            }
            // One acknowledgement covers all.
            net.wire.no_send.set(0);
            net.hear(&switching(31));
            assert_eq!(next(&mut own).await, 31);
            until(|| net.control().unacknowledged() == 0).await;
        }
        assert_eq!((net.link().0, net.link().2.sent), (1, 155));
    });
}

#[test]
fn what_is_not_acknowledged_in_time_ends_in_a_reset_and_is_never_delivered() {
    for (no_receive, no_send) in [(CONTROLLER, 0), (0, CONTROLLER)] {
        among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
            let mut buffers = [[0; 512]; 2];
            let [rx, tx] = &mut buffers;
            let mut own = connected(&net, rx, tx).await;
            net.hear(&switching(1));
            assert_eq!(next(&mut own).await, 1);
            until(|| net.control().unacknowledged() == 0).await;
            let wire = net.wire;
            wire.cut_off(no_receive, no_send);
            wire.log.borrow_mut().clear();
            let begin = Instant::now();
            net.hear(&switching(2));
            until(|| wire.has(RST)).await;
            let time = Instant::now() - begin;
            assert!((TIMEOUT..TIMEOUT + Duration::from_millis(5)).contains(&time), "reset after {time}");
            assert_eq!(net.link().2.unacknowledged, 1);
            let sent = wire.segments();
            let (reset, before) = sent.split_last().unwrap();
            assert_eq!((reset.flags & RST, reset.payload.len()), (RST, 0));
            assert!(before.iter().any(|segment| segment.payload == switching(2)));
            // It is connected again, and does not receive it any more.
            if no_send == CONTROLLER {
                assert_eq!(next(&mut own).await, 2);
            }
            wire.cut_off(0, 0);
            wire.log.borrow_mut().clear();
            Timer::after(Duration::from_secs(20)).await;
            assert!(wire.segments().iter().all(|segment| segment.payload.is_empty()));
            assert_eq!(own.recv_queue(), 0);
            // A peer that missed the reset gets one when it sends.
            let _ = own.write(&[0]).await;
            assert!(own.read(&mut [0; 8]).await.is_err());
        });
    }
}

#[test]
fn a_link_whose_task_waits_for_room_is_reset_all_the_same() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let mut buffers = [[0; 256]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = connected(&net, rx, tx).await;
        net.hear(&switching(0));
        assert_eq!(next(&mut own).await, 0);
        until(|| net.control().unacknowledged() == 0).await;
        let wire = net.wire;
        wire.no_send.set(CONTROLLER);
        wire.log.borrow_mut().clear();
        let begin = Instant::now();
        for outputs in 1..=40 {
            net.hear(&switching(outputs));
            Timer::after(Duration::from_millis(4)).await;
        }
        let left = net.control().unacknowledged() as usize;
        assert!((TX + 1..=TX + 2 * LEN).contains(&left), "{left} bytes: it does not wait for room");
        until(|| wire.has(RST)).await;
        let time = Instant::now() - begin;
        assert!((TIMEOUT..TIMEOUT + Duration::from_millis(5)).contains(&time), "reset after {time}");
        wire.log.borrow_mut().clear();
        wire.no_send.set(0);
        Timer::after(Duration::from_secs(10)).await;
        assert!(wire.segments().iter().all(|segment| segment.payload.is_empty()));
        // And the port is free for the next connection.
        own.abort();
        while own.connect(gateway_port()).await.is_err() {
            own.abort();
        }
        net.seen(2, 0).await;
        net.hear(&switching(50));
        assert_eq!(next(&mut own).await, 50);
    });
}

#[test]
fn a_connection_that_the_peer_closes_is_closed_politely() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let mut buffers = [[0; 256]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = connected(&net, rx, tx).await;
        net.hear(&switching(1));
        own.close();
        until(|| !net.link().1).await;
        assert!(net.wire.has(FIN) && !net.wire.has(RST));
        assert_eq!(next(&mut own).await, 1);
        assert_eq!(own.read(&mut [0; 8]).await, Ok(0));
    });
}

#[test]
fn what_must_not_be_delivered_any_more_ends_a_polite_close() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let mut buffers = [[0; 256]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = connected(&net, rx, tx).await;
        net.wire.no_receive.set(CONTROLLER);
        let begin = Instant::now();
        net.hear(&switching(1));
        Timer::at(begin + TIMEOUT - Duration::from_millis(30)).await;
        own.close();
        until(|| net.wire.has(RST)).await;
        let time = Instant::now() - begin;
        assert!((TIMEOUT..TIMEOUT + Duration::from_millis(5)).contains(&time), "reset after {time}");
        assert!(net.wire.has(FIN), "it was not on its way");
    });
}

/// A field port whose first byte selects commands.
fn commanding() -> GatewayConfig {
    let mut config = controller_only();
    config.commands.push(CommandEntry::new(1, "stop".try_into().unwrap())).unwrap();
    let table = Span { start: 0, len: 1 };
    let to = InputBinding::Commands { table, when: CommandWhen::Frame };
    config.fields.push(FieldSpec::UserInput { ty: ScalarType::Byte, to }).unwrap();
    add_recipe(&mut config, Mode::User, Some(Span { start: 0, len: 1 }), None);
    add_port(&mut config, "field", rs485(), 0);
    config.validate().unwrap();
    config
}

#[test]
fn urgent_commands_have_a_connection_of_their_own_to_the_command_port() {
    let config = commanding();
    assert!(matches!(
        Endpoint::of(&config, LinkKind::Urgent),
        Endpoint::Tcp { host, port: 2000 } if host == "10.0.0.2"
    ));
    among(
        &config,
        |kind| kind == LinkKind::Urgent,
        async |net| {
            assert_eq!(net.link, LinkId::URGENT);
            let mut buffers = [[0; 256]; 2];
            let [rx, tx] = &mut buffers;
            let mut own = TcpSocket::new(net.controller, rx, tx);
            own.accept(2000).await.unwrap();
            net.seen(1, 0).await;
            net.hear(&FRAME);
            let mut text = [0; 64];
            let len = own.read(&mut text).await.unwrap();
            assert!(text[..len].starts_with(b"stop"), "{:?}", &text[..len]);
            until(|| net.control().unacknowledged() == 0).await;
        },
    );
}

#[test]
fn a_controller_that_takes_one_connection_is_no_fault() {
    let _clock = TestClock::take();
    let mut gateway = Box::new(Gateway::idle());
    gateway.configure(&commanding()).unwrap();
    let wait = |gateway: &Gateway| {
        advance(Duration::from_millis(200));
        gateway.input(Input::Tick);
        gateway.input(Input::PortBytes { port: FIELD, bytes: &[0xFF, 0xFF, 0, 0xEE, 0xEE] });
    };
    gateway.input(Input::PortUp { port: FIELD });
    wait(&gateway);
    gateway.input(Input::LinkUp { link: LinkId::COMMAND });
    gateway.input(Input::LinkUp { link: LinkId::URGENT });
    assert_eq!(gateway.condition(), Condition::Running);
    gateway.input(Input::LinkDown { link: LinkId::URGENT });
    assert_eq!(gateway.condition(), Condition::NoController);
    wait(&gateway);
    gateway.input(Input::LinkDown { link: LinkId::URGENT });
    let states =
        gateway.report(|status| status.links().map(|link| (link.kind, link.state)).collect::<Vec<_>>());
    let [(LinkKind::Command, _), (LinkKind::Urgent, state)] = states[..] else { panic!("{states:?}") };
    assert_eq!(state, proto_core::link::LinkState::Shared);
    assert_eq!(gateway.condition(), Condition::Running);
}

#[test]
fn a_link_that_is_given_up_while_it_opens_begins_anew() {
    among(
        &commanding(),
        |kind| kind == LinkKind::Urgent,
        async |net| {
            let wire = net.wire;
            // Refused, but ARP is done.
            until(|| wire.has(SYN)).await;
            until(|| net.control().is_turn(2)).await;
            wire.no_receive.set(CONTROLLER);
            wire.log.borrow_mut().clear();
            let ports = || {
                let sent = wire.segments().into_iter().filter(|segment| segment.flags & SYN != 0);
                let mut ports: Vec<u16> = sent.map(|segment| segment.from).collect();
                ports.dedup();
                ports
            };
            until(|| ports().len() == 3).await;
            let mut different = ports();
            different.sort_unstable();
            different.dedup();
            assert_eq!(different.len(), 3, "an attempt goes on behind the next");
            wire.no_receive.set(0);
            let mut buffers = [[0; 256]; 2];
            let [rx, tx] = &mut buffers;
            let mut own = TcpSocket::new(net.controller, rx, tx);
            let accepted = select(own.accept(2000), Timer::after(Duration::from_secs(10))).await;
            assert!(matches!(accepted, Either::First(Ok(()))));
            net.seen(1, 0).await;
        },
    );
}
