//! From a board and its configuration to running tasks.
//!
//! Each `#[task]` here is a shim around the library's function of the same name, because a task cannot
//! be generic.

use embassy_executor::Spawner;
use embassy_net::{Config, Runner, Stack, StackResources};
use embassy_time::{Duration, Timer};
use firmware::fmt::Text;
use firmware::gateway::Gateway;
use firmware::link::{Buffers, Endpoint};
use firmware::{can, error, info, link, serial, warn};
use proto_core::config::{Bus, GatewayConfig, image};
use proto_core::engine::{LinkId, LinkKind, PortCounters, PortId};
use proto_core::link::LinkState;
use static_cell::{ConstStaticCell, StaticCell};

use crate::board::{self, Board, CanDevice, Ethernet, SerialDevice};

/// Starts what the configuration asks for. Without a configuration that can run, the buses stay silent
/// and the log says why.
pub(crate) fn start(spawner: Spawner, mut board: Board) {
    info!("recipe gateway {}", env!("CARGO_PKG_VERSION"));
    let started =
        load(&mut board, idle_gateway()).and_then(|(gateway, plan)| run(spawner, board, gateway, plan));
    if let Err(reason) = started {
        spawner.spawn(idle(reason).expect("the first of its kind"));
    }
}

/// Why nothing runs.
#[derive(Debug, Clone, Copy)]
enum Refused {
    Storage(board::StorageError),
    Image(image::ImageError),
    Build(proto_core::engine::BuildError),
    NoDevice { port: u8, bus: &'static str, available: usize },
    Ethernet(board::EthernetError),
}

impl core::fmt::Display for Refused {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Storage(error) => error.fmt(f),
            Self::Image(error) => error.fmt(f),
            Self::Build(error) => error.fmt(f),
            Self::NoDevice { port, bus, available } => {
                write!(f, "port {}: this board has {available} {bus} ports", port + 1)
            }
            Self::Ethernet(error) => error.fmt(f),
        }
    }
}

/// What the tasks need of the configuration.
struct Wiring {
    ports: heapless::Vec<(PortId, Bus), { firmware::gateway::MAX_FIELD_PORTS }>,
    links: heapless::Vec<(LinkId, LinkKind, Endpoint), MAX_LINKS>,
}

/// Not inlined: an engine may pass over the stack here, and the configuration is not there yet.
#[inline(never)]
fn idle_gateway() -> &'static mut Gateway {
    static GATEWAY: StaticCell<Gateway> = StaticCell::new();
    GATEWAY.init_with(Gateway::idle)
}

/// Not inlined: the configuration is on the stack here, and nowhere else.
#[inline(never)]
fn load(board: &mut Board, gateway: &'static mut Gateway) -> Result<(&'static Gateway, Wiring), Refused> {
    let bytes = board.configuration().map_err(Refused::Storage)?;
    let mut config = GatewayConfig::empty();
    image::decode_into(bytes, &mut config).map_err(Refused::Image)?;
    gateway.configure(&config).map_err(Refused::Build)?;
    let gateway: &'static Gateway = gateway;
    let wiring = Wiring {
        ports: config.field_ports().map(|(index, port, _)| (PortId(index), port.bus.clone())).collect(),
        links: gateway.links().map(|(id, kind)| (id, kind, Endpoint::of(&config, kind))).collect(),
    };
    info!(
        "configuration: {} bytes; {} field ports, {} links; the engine takes {} bytes, its configuration {}",
        bytes.len(),
        wiring.ports.len(),
        wiring.links.len(),
        size_of::<Gateway>(),
        size_of::<GatewayConfig>(),
    );
    Ok((gateway, wiring))
}

fn run(spawner: Spawner, mut board: Board, gateway: &'static Gateway, wiring: Wiring) -> Result<(), Refused> {
    // All devices are claimed before anything moves.
    let mut serial_ports: heapless::Vec<_, { board::SERIAL_PORTS }> = heapless::Vec::new();
    let mut can_ports: heapless::Vec<_, { board::CAN_PORTS }> = heapless::Vec::new();
    for (id, bus) in &wiring.ports {
        match bus {
            Bus::Rs485(settings) => {
                let line = board.serial(settings);
                let missing = Refused::NoDevice { port: id.0, bus: "RS-485", available: board::SERIAL_PORTS };
                let line = line.ok_or(missing)?;
                let _ = serial_ports.push((*id, line, settings.baud));
            }
            Bus::Can { bitrate } => {
                let missing = Refused::NoDevice { port: id.0, bus: "CAN", available: board::CAN_PORTS };
                let _ = can_ports.push((*id, board.can(*bitrate).ok_or(missing)?));
            }
            Bus::TcpListen { .. } | Bus::UdpListen { .. } => {}
        }
    }
    spawner.spawn(engine(gateway).expect("the first of its kind"));
    for (id, line, baud) in serial_ports {
        spawner.spawn(serial_port(gateway, id, line, baud).expect("as many as the board has"));
    }
    for (id, can) in can_ports {
        spawner.spawn(can_port(gateway, id, can).expect("as many as the board has"));
    }
    spawner.spawn(status(gateway).expect("the first of its kind"));
    // The network is last: a missing PHY does not keep the field buses from running.
    let ethernet = board.ethernet().map_err(Refused::Ethernet)?;
    static RESOURCES: StaticCell<StackResources<SOCKETS>> = StaticCell::new();
    let resources = RESOURCES.init(StackResources::new());
    let (stack, runner) =
        embassy_net::new(ethernet, Config::dhcpv4(Default::default()), resources, board::seed());
    info!("stack: {} bytes while the engine was made", board::stack_used());
    spawner.spawn(network(runner).expect("the first of its kind"));
    spawner.spawn(address(stack).expect("the first of its kind"));
    static BUFFERS: [ConstStaticCell<Buffers<RX, TX>>; MAX_LINKS] =
        [const { ConstStaticCell::new(Buffers::new()) }; MAX_LINKS];
    for ((id, _, endpoint), buffers) in wiring.links.into_iter().zip(&BUFFERS) {
        let buffers = buffers.take();
        spawner.spawn(controller_link(gateway, id, stack, endpoint, buffers).expect("one for each link"));
    }
    Ok(())
}

#[embassy_executor::task]
async fn engine(gateway: &'static Gateway) -> ! {
    gateway.keep_time().await
}

#[embassy_executor::task(pool_size = board::SERIAL_PORTS)]
async fn serial_port(gateway: &'static Gateway, id: PortId, line: SerialDevice, baud: u32) -> ! {
    serial::run(gateway, id, line, baud).await
}

#[embassy_executor::task(pool_size = board::CAN_PORTS)]
async fn can_port(gateway: &'static Gateway, id: PortId, device: CanDevice) -> ! {
    can::run(gateway, id, device).await
}

#[embassy_executor::task(pool_size = MAX_LINKS)]
async fn controller_link(
    gateway: &'static Gateway,
    id: LinkId,
    stack: Stack<'static>,
    endpoint: Endpoint,
    buffers: &'static mut Buffers<RX, TX>,
) -> ! {
    link::run(gateway, id, stack, &endpoint, buffers).await
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, Ethernet>) -> ! {
    runner.run().await
}

/// Tells the board's address whenever it changes.
#[embassy_executor::task]
async fn address(stack: Stack<'static>) -> ! {
    loop {
        stack.wait_config_up().await;
        if let Some(config) = stack.config_v4() {
            info!("address {}", Text(&config.address));
        }
        stack.wait_config_down().await;
        warn!("no address");
    }
}

/// Says what came of every link, and what went through every port, when it is another than before.
#[embassy_executor::task]
async fn status(gateway: &'static Gateway) -> ! {
    let mut links = [(0, false); MAX_LINKS];
    let mut ports = [PortCounters::default(); firmware::gateway::MAX_FIELD_PORTS];
    loop {
        for _ in 0..4 {
            let mut known = links.iter_mut();
            gateway.report(
                |link| {
                    let Some((connects, was_up)) = known.next() else { return };
                    let is_up = matches!(link.state, LinkState::Up { .. });
                    let name = link.kind.name();
                    if *connects != link.history.connects {
                        *connects = link.history.connects;
                        info!("link {}: up ({})", name, connects);
                    } else if *was_up && !is_up {
                        warn!("link {}: lost", name);
                    }
                    *was_up = is_up;
                },
                |_, _| {},
            );
            Timer::after(Duration::from_millis(250)).await;
        }
        let mut known = ports.iter_mut();
        gateway.report(
            |_| {},
            |port, now| {
                if let Some(before) = known.next()
                    && before != now
                {
                    *before = *now;
                    info!(
                        "port {}: in {} frames, {} bytes; out {} frames, {} bytes; {} bytes skipped, {} cycles",
                        port.0,
                        now.frames_in,
                        now.bytes_in,
                        now.frames_out,
                        now.bytes_out,
                        now.resync_bytes,
                        now.skipped_cycles,
                    );
                }
            },
        );
    }
}

/// The buses stay silent.
#[embassy_executor::task]
async fn idle(reason: Refused) -> ! {
    loop {
        error!("nothing runs: {}", Text(&reason));
        Timer::after(Duration::from_secs(10)).await;
    }
}

/// Command, state, Modbus and the recipe links.
const MAX_LINKS: usize = firmware::gateway::MAX_UPLINKS + 3;
/// One for each link, DHCP and DNS.
const SOCKETS: usize = MAX_LINKS + 2;
/// A state packet, and a receive window that a burst cannot overrun the Ethernet controller with.
const RX: usize = 1536;
/// The longest frame or request, and another.
const TX: usize = 1024;
