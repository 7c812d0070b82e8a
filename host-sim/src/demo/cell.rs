//! The cell of the demo: a simulated controller and a gateway on this host, from the example files, on free
//! port numbers.

use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{Request, Response};
use serde_json::Value;

use super::device::{FieldStream, PATIENCE};
use recipe_config::file::{self, Text};
use recipe_io::bind::Bind;
use recipe_runtime::Handle;

/// An example file, embedded.
#[derive(Clone, Copy)]
pub(super) struct Example {
    pub(super) name: &'static str,
    pub(super) toml: &'static str,
}

/// The simulated controller.
pub(super) struct Robot(Handle);

/// The gateway.
pub(super) struct Gateway(Handle);

impl Robot {
    /// Starts one from an example file on free port numbers.
    pub(super) fn start(example: Example, overrides: &[String], binds: &[String]) -> io::Result<Self> {
        let mut set: Vec<String> =
            ["command", "state", "modbus", "udp2011"].map(|port| format!("listen.{port}=0")).to_vec();
        set.extend_from_slice(overrides);
        let config = file::parse_controller(Text { name: example.name, toml: example.toml }, &set);
        let config = config.map_err(io::Error::other)?;
        recipe_runtime::controller::start(config, parse_binds(binds)?).map(Self).map_err(io::Error::other)
    }

    /// The address called `name` in the ready line.
    pub(super) fn address(&self, name: &str) -> io::Result<SocketAddr> {
        address(&self.0, name)
    }

    /// Sends a command to port 2000 and waits for this reply.
    pub(super) fn command(&self, command: &str, reply: &str) -> io::Result<()> {
        let mut line = FieldStream::connect(self.address("command")?)?;
        line.send(command.as_bytes())?;
        line.wait_for(|received| (received == reply.as_bytes()).then_some(((), received.len())))
    }

    /// Waits until the program's variable has this value.
    pub(super) fn variable(&self, name: &str, value: &Value) -> io::Result<()> {
        until(|| Ok(self.0.stats().is_some_and(|stats| stats["variables"][name] == *value)))
    }

    /// Waits until a Modbus client reads this value of the coil.
    pub(super) fn coil(&self, address: u16, on: bool) -> io::Result<()> {
        let mut modbus = Modbus::connect(self.address("modbus")?)?;
        until(|| {
            modbus.request(Request::ReadCoils { address, count: 1 }, |response| match response {
                Response::Coils(coils) => coils.coil(0) == Some(on),
                _ => false,
            })
        })
    }

    /// Waits until a Modbus client reads these values of the holding registers.
    pub(super) fn registers(&self, address: u16, values: &[u16]) -> io::Result<()> {
        let mut modbus = Modbus::connect(self.address("modbus")?)?;
        let count = values.len() as u16;
        until(|| {
            modbus.request(Request::ReadHolding { address, count }, |response| match response {
                Response::Registers(registers) => registers.iter().eq(values.iter().copied()),
                _ => false,
            })
        })
    }
}

impl Gateway {
    /// Starts one from an example file; `robot` is the controller, if it is running already.
    pub(super) fn start(
        example: Example,
        robot: Option<&Robot>,
        overrides: &[String],
        binds: &[String],
    ) -> io::Result<Self> {
        let mut set = overrides.to_vec();
        for port in robot.map_or(&[][..], |_| &["command", "state", "modbus", "udp2011"]) {
            let Some(robot) = robot else { break };
            set.push(format!("controller.ports.{port}={}", robot.address(port)?.port()));
        }
        let config = file::parse_gateway(Text { name: example.name, toml: example.toml }, &set);
        let config = config.map_err(io::Error::other)?;
        recipe_runtime::gateway::start(*config, parse_binds(binds)?).map(Self).map_err(io::Error::other)
    }

    pub(super) fn address(&self, name: &str) -> io::Result<SocketAddr> {
        address(&self.0, name)
    }

    /// Waits until every link to the controller is up.
    pub(super) fn linked(&self) -> io::Result<()> {
        until(|| {
            let stats = self.0.stats().ok_or_else(|| io::Error::other("the gateway ended"))?;
            let links = stats["links"].as_object();
            Ok(links.is_some_and(|links| links.values().all(|link| link["state"] == "up")))
        })
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        let sleeps = self.0.stats().and_then(|stats| stats["sleeps"].as_u64()).unwrap_or(0);
        HELD_UP.fetch_add(usize::from(sleeps > 0), Ordering::Relaxed);
    }
}

/// How many gateways of this process were kept from the processor for so long that they discarded input.
pub(super) fn gateways_held_up() -> usize {
    HELD_UP.load(Ordering::Relaxed)
}

static HELD_UP: AtomicUsize = AtomicUsize::new(0);

/// Opens the device end of a bound pseudoterminal.
pub(super) fn serial(path: &Path) -> io::Result<FieldStream<std::fs::File>> {
    FieldStream::open(path)
}

/// A Modbus client that reads the controller.
struct Modbus {
    line: FieldStream<std::net::TcpStream>,
    client: Client,
}

impl Modbus {
    fn connect(address: SocketAddr) -> io::Result<Self> {
        Ok(Self { line: FieldStream::connect(address)?, client: Client::new(1) })
    }

    fn request(&mut self, request: Request<'_>, is_so: impl Fn(Response<'_>) -> bool) -> io::Result<bool> {
        let mut frame = [0; MAX_ADU];
        let len = self.client.start(request, &mut frame).map_err(io::Error::other)?;
        self.line.send(&frame[..len])?;
        let client = &mut self.client;
        self.line.wait_for(|received| {
            let mut rest = received;
            let answer = match client.receive(&mut rest)? {
                ClientEvent::Response(response) => is_so(response),
                _ => false,
            };
            Some((answer, received.len()))
        })
    }
}

/// Calls `is_so` repeatedly until it returns true.
fn until(mut is_so: impl FnMut() -> io::Result<bool>) -> io::Result<()> {
    let deadline = Instant::now() + PATIENCE;
    while !is_so()? {
        if Instant::now() > deadline {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "it did not happen in time"));
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    Ok(())
}

/// Polling without a pause would keep the processor from kernel threads that pass on what was written to a
/// pseudoterminal, and sometimes to a socket.
const POLL_INTERVAL: Duration = Duration::from_millis(2);

fn address(handle: &Handle, name: &str) -> io::Result<SocketAddr> {
    handle.place(name).parse().map_err(|_| io::Error::other(format!("no address called {name}")))
}

fn parse_binds(binds: &[String]) -> io::Result<Vec<Bind>> {
    binds.iter().map(|bind| bind.parse().map_err(io::Error::other)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waiting_does_not_occupy_the_processor() {
        let begun = Instant::now();
        let mut calls = 0;
        until(|| {
            calls += 1;
            Ok(begun.elapsed() >= 25 * POLL_INTERVAL)
        })
        .unwrap();
        let most = begun.elapsed().as_micros() / POLL_INTERVAL.as_micros() + 1;
        assert!(calls <= most, "{calls} calls in {:?}", begun.elapsed());
    }
}
