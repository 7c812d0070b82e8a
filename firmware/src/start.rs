//! From a board and its configuration to running tasks.
//!
//! Each `#[task]` here wraps a generic function of the library, because a task cannot be generic.

use core::pin::pin;

use embassy_executor::{SpawnError, SpawnToken, Spawner};
use embassy_net::{Config, Ipv4Cidr, Runner, Stack, StackResources, StaticConfigV4};
use embassy_time::{Duration, Timer};
use firmware::fmt::Text;
use firmware::kept::{self, Kept, RoleName};
use firmware::platform::{self, FeedWatchdog as _, StatusLed as _};
use firmware::tasks::fair::Fair;
use firmware::tasks::gateway::{Gateway, MAX_LINKS};
use firmware::tasks::led::Condition;
use firmware::tasks::link::{Buffers, Endpoint};
use firmware::tasks::watchdog::{Pulse, TaskName};
use firmware::tasks::{can, led, link, serial, watchdog};
use firmware::{error, info, warn};
use proto_core::config::{Bus, GatewayConfig, Network, image};
use proto_core::engine::{LinkId, LinkKind, PortId};
use static_cell::{ConstStaticCell, StaticCell};

use crate::board::Board;
use firmware::platform::Board as _;

// The devices of the chosen board.
type SerialDevice = <Board as platform::Board>::Serial;
type CanDevice = <Board as platform::Board>::Can;
type Ethernet = <Board as platform::Board>::Ethernet;
type Watchdog = <Board as platform::Board>::Watchdog;
type Led = <Board as platform::Board>::Led;
type Flash = <Board as platform::Board>::Flash;
const SERIAL_PORTS: usize = <Board as platform::Board>::SERIAL_PORTS;
const CAN_PORTS: usize = <Board as platform::Board>::CAN_PORTS;
const WATCHDOG_PERIOD: Duration = <Board as platform::Board>::WATCHDOG_PERIOD;

/// Starts the tasks of the configuration, and returns what a board needs to start tasks of its own.
/// Without a configuration that can run, the buses stay silent and the log says why.
pub(crate) fn start(spawner: Spawner, mut board: Board) -> Tasks {
    info!("recipe gateway {}", env!("CARGO_PKG_VERSION"));
    let mut led = board.led();
    led.set(true);
    static WATCH: StaticCell<Watch> = StaticCell::new();
    let tasks = Tasks { spawner, watch: WATCH.init_with(Watch::new) };
    // First of all, so that the watchdog resets the board if anything later hangs.
    spawner.spawn(feeder(tasks.watch, board.watchdog()).expect("it is spawned once"));
    // Both are all zeros, so they take no flash, and are not built on the stack.
    static GATEWAY: ConstStaticCell<Gateway> = ConstStaticCell::new(Gateway::idle());
    static OVERLAY: ConstStaticCell<Overlay> = ConstStaticCell::new(Overlay::ZEROED);
    let overlay = OVERLAY.take();
    let loaded = load(&mut board, GATEWAY.take(), overlay.configuration());
    let gateway = loaded.as_ref().ok().map(|loaded| loaded.gateway);
    let started = loaded.and_then(|loaded| {
        if let Some((kept, work)) = loaded.keeper {
            tasks.spawn(TaskName::Keeper, |pulse| keeper(pulse, kept, work));
        }
        run(&tasks, board, loaded.gateway, loaded.wiring, overlay.links())
    });
    tasks.spawn(TaskName::Led, |pulse| status_led(pulse, gateway.filter(|_| started.is_ok()), led));
    if let Err(reason) = started {
        tasks.spawn(TaskName::Refused, |pulse| refused(pulse, reason));
    }
    tasks
}

/// Starts tasks. All tasks are started through it, so the watchdog knows all of them.
#[derive(Clone, Copy)]
pub(crate) struct Tasks {
    spawner: Spawner,
    watch: &'static Watch,
}

type Watch = watchdog::Watch<MAX_TASKS>;

impl Tasks {
    /// Starts a task with its pulse.
    pub(crate) fn spawn<S>(
        &self,
        name: TaskName,
        task: impl FnOnce(&'static Pulse) -> Result<SpawnToken<S>, SpawnError>,
    ) {
        let pulse = self.watch.register(name).expect("MAX_TASKS is large enough");
        self.spawner.spawn(task(pulse).expect("its pool is large enough"));
    }
}

/// Why nothing runs.
#[derive(Debug, Clone, Copy)]
enum Refused {
    Storage(<Board as platform::Board>::StorageError),
    Image(image::ImageError),
    Build(proto_core::engine::BuildError),
    NoDevice {
        port: u8,
        bus: &'static str,
        available: usize,
    },
    /// The store has no configuration, and the image on the board was taken over and is gone.
    Empty,
    Ethernet(<Board as platform::Board>::EthernetError),
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
            Self::Empty => f.write_str("the store holds no configuration"),
            Self::Ethernet(error) => error.fmt(f),
        }
    }
}

/// The parts of the configuration that the tasks need.
struct Wiring {
    ports: heapless::Vec<(PortId, Bus), { firmware::tasks::gateway::MAX_FIELD_PORTS }>,
    links: heapless::Vec<(LinkId, LinkKind, Endpoint), MAX_LINKS>,
    network: Option<Network>,
}

/// Memory for the configuration during the start, and for the links' buffers afterwards.
#[allow(clippy::large_enum_variant, reason = "both share one memory")]
#[repr(u8)]
enum Overlay {
    Configuration(GatewayConfig),
    Links(heapless::Vec<u8, { MAX_LINKS * Buffers::SIZE }>),
}

impl Overlay {
    /// All zeros, so that it takes no flash.
    const ZEROED: Self = Self::Configuration(GatewayConfig::empty());

    fn configuration(&mut self) -> &mut GatewayConfig {
        match self {
            Self::Configuration(config) => config,
            Self::Links(_) => unreachable!("the links come last"),
        }
    }

    /// The links' buffers, which replace the configuration.
    fn links(&mut self) -> &mut [u8] {
        *self = Self::Links(heapless::Vec::new());
        let Self::Links(buffers) = self else { return &mut [] };
        let _ = buffers.resize_default(buffers.capacity());
        buffers
    }
}

/// A configuration that runs.
struct Loaded {
    gateway: &'static Gateway,
    wiring: Wiring,
    /// What is to be done with the store while it runs.
    keeper: Option<(Kept<Flash>, KeeperWork)>,
}

/// Work of the keeper.
#[derive(Clone, Copy)]
enum KeeperWork {
    /// This image came from outside the store: it becomes the live one.
    Adopt(&'static [u8]),
    /// What runs is on trial for this long.
    Trial(Duration),
}

/// The first configuration that can run: the image that was put on the board since the last start; of the store
/// the one on trial, the live one, the one before; or else the image on the board, which was run before.
///
/// Nothing is written but the start of a trial, so that the start takes no longer than without a store.
///
/// Not inlined, so that its stack frame is free when the tasks run.
#[inline(never)]
fn load(
    board: &mut Board,
    gateway: &'static mut Gateway,
    config: &mut GatewayConfig,
) -> Result<Loaded, Refused> {
    let own = board.configuration().map_err(Refused::Storage).map(whole);
    let opened = board.flash().map(Kept::open);
    let kept = opened.and_then(|opened| opened.inspect_err(|error| error!("{}", Text(error))).ok());
    let Some(mut kept) = kept else {
        let (image, _) = own?;
        configure(image, gateway, config)?;
        let wiring = wiring(image.len(), gateway, config);
        return Ok(Loaded { gateway, wiring, keeper: None });
    };
    let mut why = own.err();
    if let Ok((image, digest)) = own
        && !kept.store().is_adopted(digest, image.len())
    {
        match configure(image, gateway, config) {
            Ok(()) => {
                let wiring = wiring(image.len(), gateway, config);
                return Ok(Loaded { gateway, wiring, keeper: Some((kept, KeeperWork::Adopt(image))) });
            }
            Err(error) => why = Some(error),
        }
    }
    let mut candidates = heapless::Vec::new();
    if let Err(error) = board.block_on(kept.candidates(&mut candidates)) {
        error!("the store: {}", Text(&error));
    }
    let mut is_first = true;
    for (revision, role) in candidates {
        let Some(image) = kept.image(revision) else { continue };
        match configure(image, gateway, config) {
            Ok(()) => {
                info!("configuration {} of the store, {}", revision.number, Text(&RoleName(role)));
                let wiring = wiring(image.len(), gateway, config);
                let keeper = kept::trial_time(role).map(|time| (kept, KeeperWork::Trial(time)));
                return Ok(Loaded { gateway, wiring, keeper });
            }
            Err(error) => {
                error!("configuration {} of the store cannot run: {}", revision.number, Text(&error));
                // It says more than an empty place.
                if core::mem::take(&mut is_first) {
                    why = Some(error);
                }
            }
        }
    }
    // Nothing of the store: the image on the board, although it was taken over.
    if let Ok((image, _)) = own
        && configure(image, gateway, config).is_ok()
    {
        let wiring = wiring(image.len(), gateway, config);
        return Ok(Loaded { gateway, wiring, keeper: None });
    }
    Err(why.unwrap_or(Refused::Empty))
}

/// The image without what follows it, and its CRC.
fn whole(bytes: &'static [u8]) -> (&'static [u8], u32) {
    let image = image::image_len(bytes).ok().and_then(|len| bytes.get(..len)).unwrap_or(bytes);
    let crc = image.get(image::HEADER - 4..).and_then(|rest| rest.first_chunk());
    (image, crc.map_or(0, |crc| u32::from_le_bytes(*crc)))
}

/// Not inlined: it is called in several places.
#[inline(never)]
fn configure(bytes: &[u8], gateway: &mut Gateway, config: &mut GatewayConfig) -> Result<(), Refused> {
    image::decode_into(bytes, config).map_err(Refused::Image)?;
    gateway.configure(config).map_err(Refused::Build)
}

#[inline(never)]
fn wiring(len: usize, gateway: &Gateway, config: &GatewayConfig) -> Wiring {
    let wiring = Wiring {
        ports: config
            .view()
            .field_ports()
            .map(|(index, port, _)| (PortId(index), port.bus.clone()))
            .collect(),
        links: gateway.links().map(|(id, kind)| (id, kind, Endpoint::of(config, kind))).collect(),
        network: config.network.fixed().copied(),
    };
    info!(
        "configuration: {} bytes; {} field ports, {} links; the engine has {} bytes, its configuration {}",
        len,
        wiring.ports.len(),
        wiring.links.len(),
        size_of::<Gateway>(),
        size_of::<GatewayConfig>(),
    );
    wiring
}

#[inline(never)]
fn run(
    tasks: &Tasks,
    mut board: Board,
    gateway: &'static Gateway,
    wiring: Wiring,
    mut memory: &'static mut [u8],
) -> Result<(), Refused> {
    // All devices are claimed before anything runs.
    let mut serial_ports: heapless::Vec<_, SERIAL_PORTS> = heapless::Vec::new();
    let mut can_ports: heapless::Vec<_, CAN_PORTS> = heapless::Vec::new();
    for (id, bus) in &wiring.ports {
        match bus {
            Bus::Rs485(settings) => {
                let line = board.serial(settings);
                let missing = Refused::NoDevice { port: id.0, bus: "RS-485", available: SERIAL_PORTS };
                let line = line.ok_or(missing)?;
                let _ = serial_ports.push((*id, line, settings.baud));
            }
            Bus::Can { bitrate } => {
                let missing = Refused::NoDevice { port: id.0, bus: "CAN", available: CAN_PORTS };
                let _ = can_ports.push((*id, board.can(*bitrate).ok_or(missing)?));
            }
            Bus::TcpListen { .. } | Bus::UdpListen { .. } => {}
        }
    }
    tasks.spawn(TaskName::Engine, |pulse| engine(pulse, gateway));
    for (id, line, baud) in serial_ports {
        tasks.spawn(TaskName::Serial(id), |pulse| serial_port(pulse, gateway, id, line, baud));
    }
    for (id, can) in can_ports {
        tasks.spawn(TaskName::Can(id), |pulse| can_port(pulse, gateway, id, can));
    }
    tasks.spawn(TaskName::Status, |pulse| status(pulse, gateway));
    // The network is last, so that the field buses run without a PHY.
    let ethernet = board.ethernet().map_err(Refused::Ethernet)?;
    static RESOURCES: StaticCell<StackResources<SOCKETS>> = StaticCell::new();
    let resources = RESOURCES.init(StackResources::new());
    let (stack, runner) = embassy_net::new(
        Fair::new(ethernet, gateway),
        network_config(wiring.network),
        resources,
        board.seed(),
    );
    info!("stack: {} bytes while the engine was made", board.stack_used());
    tasks.spawn(TaskName::Network, |pulse| network(pulse, runner));
    tasks.spawn(TaskName::Address, |pulse| address(pulse, stack));
    for (id, kind, endpoint) in wiring.links {
        let buffers = Buffers::take(&mut memory, &endpoint).expect("there is room for MAX_LINKS");
        tasks.spawn(TaskName::Link(kind), |pulse| {
            controller_link(pulse, gateway, id, stack, endpoint, buffers)
        });
    }
    Ok(())
}

fn network_config(own: Option<Network>) -> Config {
    let Some(own) = own else { return Config::dhcpv4(Default::default()) };
    Config::ipv4_static(StaticConfigV4 {
        address: Ipv4Cidr::new(own.address, own.prefix),
        gateway: own.router,
        dns_servers: own.dns.into_iter().collect(),
    })
}

/// The only task that is not watched.
#[embassy_executor::task]
async fn feeder(watch: &'static Watch, mut dog: Watchdog) -> ! {
    watchdog::run(watch, WATCHDOG_PERIOD, || dog.feed()).await
}

#[embassy_executor::task]
async fn engine(pulse: &'static Pulse, gateway: &'static Gateway) -> ! {
    pulse.run(pin!(gateway.keep_time(pulse))).await
}

#[embassy_executor::task(pool_size = SERIAL_PORTS)]
async fn serial_port(
    pulse: &'static Pulse,
    gateway: &'static Gateway,
    id: PortId,
    line: SerialDevice,
    baud: u32,
) -> ! {
    pulse.run(pin!(serial::run(gateway, pulse, id, line, baud))).await
}

#[embassy_executor::task(pool_size = CAN_PORTS)]
async fn can_port(pulse: &'static Pulse, gateway: &'static Gateway, id: PortId, device: CanDevice) -> ! {
    pulse.run(pin!(can::run(gateway, pulse, id, device))).await
}

#[embassy_executor::task(pool_size = MAX_LINKS)]
async fn controller_link(
    pulse: &'static Pulse,
    gateway: &'static Gateway,
    id: LinkId,
    stack: Stack<'static>,
    endpoint: Endpoint,
    buffers: Buffers<'static>,
) -> ! {
    pulse.run(pin!(link::run(gateway, pulse, id, stack, &endpoint, buffers))).await
}

#[embassy_executor::task]
async fn network(pulse: &'static Pulse, mut runner: Runner<'static, Fair<'static, Ethernet>>) -> ! {
    // The stack's own waits cannot be wrapped: that it is polled and returns is all that is checked.
    let mut running = pin!(runner.run());
    pulse.run(pin!(pulse.idle(running.as_mut()))).await
}

#[embassy_executor::task]
async fn status_led(pulse: &'static Pulse, gateway: Option<&'static Gateway>, mut led: Led) -> ! {
    let condition = || gateway.map_or(Condition::Refused, Gateway::condition);
    pulse.run(pin!(led::run(pulse, condition, |is_lit| led.set(is_lit)))).await
}

/// Logs the board's address whenever it changes.
#[embassy_executor::task]
async fn address(pulse: &'static Pulse, stack: Stack<'static>) -> ! {
    let telling = async {
        loop {
            // A fixed address exists before the link is up, but cannot be reached yet.
            pulse.idle(pin!(stack.wait_link_up())).await;
            pulse.idle(pin!(stack.wait_config_up())).await;
            if let Some(config) = stack.config_v4() {
                info!("address {}", Text(&config.address));
            }
            pulse.idle(pin!(stack.wait_config_down())).await;
            warn!("no address");
        }
    };
    pulse.run(pin!(telling)).await
}

#[embassy_executor::task]
async fn status(pulse: &'static Pulse, gateway: &'static Gateway) -> ! {
    pulse.run(pin!(firmware::tasks::status::run(gateway, pulse))).await
}

/// Changes the store while a configuration runs.
#[embassy_executor::task]
async fn keeper(pulse: &'static Pulse, mut kept: Kept<Flash>, work: KeeperWork) -> ! {
    let keeping = async {
        match work {
            KeeperWork::Adopt(image) => {
                let (image, digest) = whole(image);
                match pulse.idle(pin!(kept.adopt(digest, image))).await {
                    Ok(_) => info!("the store has taken over the configuration"),
                    Err(error) => error!("the store: {}", Text(&error)),
                }
            }
            KeeperWork::Trial(time) => {
                pulse.idle(pin!(Timer::after(time))).await;
                warn!("the configuration was not confirmed in time: back to the live one");
                if let Err(error) = pulse.idle(pin!(kept.end_trial())).await {
                    error!("the store: {}", Text(&error));
                }
                // For the log. A configuration is only changed by a restart.
                pulse.idle(pin!(Timer::after(LAST_WORDS))).await;
                cortex_m::peripheral::SCB::sys_reset()
            }
        }
        loop {
            pulse.idle(pin!(core::future::pending::<()>())).await;
        }
    };
    pulse.run(pin!(keeping)).await
}

/// Logs the reason repeatedly, because the log may be read late.
#[embassy_executor::task]
async fn refused(pulse: &'static Pulse, reason: Refused) -> ! {
    let what = if matches!(reason, Refused::Ethernet(_)) { "no controller" } else { "nothing runs" };
    let telling = async {
        loop {
            error!("{}: {}", what, Text(&reason));
            pulse.idle(pin!(Timer::after(REPEAT))).await;
        }
    };
    pulse.run(pin!(telling)).await
}

/// One for each link, DHCP and DNS.
const SOCKETS: usize = MAX_LINKS + 2;
/// Interval of that log line.
const REPEAT: Duration = Duration::from_secs(10);
/// Between the last log line and a restart.
const LAST_WORDS: Duration = Duration::from_millis(100);
/// A task for each port and link, and: engine, network, address, status, LED, refused, keeper, the board's own.
const MAX_TASKS: usize = SERIAL_PORTS + CAN_PORTS + MAX_LINKS + 8;
