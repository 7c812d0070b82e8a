//! UTC from an SNTP server, for the edge node (docs/fleet.md section 6).
//!
//! In: datagrams of one server. Out: UTC. `recipe_sparkplug::sntp` decides which datagrams are accepted and when the
//! server is queried. The engine does not use UTC.

use core::cell::Cell;
use core::pin::pin;

use embassy_futures::select::{Either, select};
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{IpEndpoint, Stack};
use embassy_time::{Duration, Instant, Timer};
use proto_core::time::Instant as Time;
use recipe_sparkplug::sntp::{PACKET, Sntp};

use super::link::resolve;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::fmt::DisplayText;
use crate::{info, warn};

/// UTC, known after the first reply of a server.
#[derive(Debug)]
pub struct WallClock(Cell<Option<(Time, u64)>>);

impl WallClock {
    /// UTC is unknown.
    pub const fn unknown() -> Self {
        Self(Cell::new(None))
    }

    /// Milliseconds since 1970 at this instant.
    pub fn utc_ms(&self, at: Time) -> Option<u64> {
        let (then, utc_ms) = self.0.get()?;
        Some(utc_ms.saturating_add(at.saturating_since(then).as_millis()))
    }

    /// Whether UTC is known.
    pub fn is_known(&self) -> bool {
        self.0.get().is_some()
    }
}

/// Queries the server forever.
pub async fn run(
    pulse: &Pulse,
    stack: Stack<'_>,
    (host, port): (&str, u16),
    clock: &WallClock,
    seed: u64,
) -> ! {
    let mut sntp = Sntp::new(seed);
    let mut told = None;
    let (mut received, mut waiting) = ([PacketMetadata::EMPTY; 4], [PacketMetadata::EMPTY; 1]);
    let (mut rx, mut tx) = ([0; 4 * PACKET], [0; PACKET]);
    let mut socket = UdpSocket::new(stack, &mut received, &mut rx, &mut waiting, &mut tx);
    loop {
        let until = Instant::from_micros(sntp.deadline().as_micros());
        pulse.idle(pin!(Timer::at(until))).await;
        pulse.idle(pin!(stack.wait_config_up())).await;
        // Resolve first: the request contains the time, from which the round trip is measured.
        let address = pulse.idle(pin!(resolve(stack, host))).await;
        let Some(request) = sntp.poll(now()) else { continue };
        let Some(address) = address else {
            warn!("time server: {} is not found", host);
            continue;
        };
        // An unpredictable source port for each request.
        socket.close();
        if socket.bind(0).is_err() {
            continue;
        }
        let server = IpEndpoint::new(address, port);
        if pulse.idle(pin!(socket.send_to(&request, server))).await.is_err() {
            continue;
        }
        let until = Instant::now() + ANSWER_TIME;
        let mut datagram = [0; 2 * PACKET];
        loop {
            let reading = select(socket.recv_from(&mut datagram), Timer::at(until));
            let next = pulse.idle(pin!(reading)).await;
            let reply = match next {
                Either::First(Ok((len, from))) if from.endpoint == server => {
                    datagram.get(..len).unwrap_or(&[])
                }
                Either::First(_) => continue,
                Either::Second(()) => break,
            };
            let at = now();
            match sntp.receive(at, reply) {
                Ok(utc_ms) => {
                    if !clock.is_known() {
                        info!("time server: UTC is known");
                    }
                    (told, _) = (None, clock.0.set(Some((at, utc_ms))));
                    break;
                }
                Err(error) => {
                    if told.replace(error) != Some(error) {
                        warn!("time server: {}", DisplayText(&error));
                    }
                    // Other hosts may send without limit.
                    if sntp.deadline() > at + LONG {
                        break;
                    }
                    pulse.idle(pin!(embassy_futures::yield_now())).await;
                }
            }
        }
    }
}

/// Timeout of a reply; a later one is too imprecise.
const ANSWER_TIME: Duration = Duration::from_secs(2);
/// Longer intervals mean that the server has asked to be left alone (kiss-o'-death).
const LONG: proto_core::time::Duration = proto_core::time::Duration::from_secs(1_800);
