//! From a board and its configuration to running tasks.
//!
//! Each `#[task]` here wraps a generic function of the library, because a task cannot be generic.

mod configuration;

use core::pin::pin;

use embassy_executor::Spawner;
use embassy_net::{Config, DhcpConfig, Ipv4Cidr, Runner, Stack, StackResources, StaticConfigV4};
use embassy_net_driver::{Driver as _, HardwareAddress};
use embassy_time::{Duration, Timer};
use firmware::fmt::DisplayText;
use firmware::identity;
use firmware::platform::{self, FeedWatchdog as _, NoDevice, Ports, StatusLed as _};
use firmware::stored::StoredConfig;
use firmware::tasks::console::{self, CONNECTIONS, Console, NodeView};
use firmware::tasks::edge::{self, Edge, EdgeError};
use firmware::tasks::fair::Fair;
use firmware::tasks::gateway::{Gateway, MAX_LINKS};
use firmware::tasks::led::Condition;
use firmware::tasks::link::{Endpoint, LinkBuffers};
use firmware::tasks::store::{self, StoreHandle};
use firmware::tasks::time::{self, WallClock};
use firmware::tasks::watchdog::{Pulse, TaskName, TaskWatch};
use firmware::tasks::{can, led, link, serial, watchdog};
use firmware::update::{Site, Updates};
use firmware::{error, info, warn};
use proto_core::config::image::MAX_IMAGE;
use proto_core::config::{Bus, GatewayConfig, Network};
use proto_core::engine::{LinkId, LinkKind, PortId};
use static_cell::{ConstStaticCell, StaticCell};

use crate::board::{
    self, Board, BoardLed, CanDevice, Ethernet, SerialDevice, SlotArea, StoreArea, UserButton, Watchdog,
};
use configuration::{CannotRun, load};
use firmware::platform::Board as _;

const SERIAL_PORTS: usize = <Board as platform::Board>::SERIAL_PORTS;
const CAN_PORTS: usize = <Board as platform::Board>::CAN_PORTS;
const PORTS: Ports = Ports { lines: SERIAL_PORTS, buses: CAN_PORTS };
const WATCHDOG_PERIOD: Duration = <Board as platform::Board>::WATCHDOG_PERIOD;

/// Starts the tasks of the configuration, and returns what a board needs to start tasks of its own. Without a
/// configuration that can run, the buses stay silent and the log says why; the console still accepts another one.
pub(crate) fn start(spawner: Spawner, mut board: Board) -> Tasks {
    info!("recipe gateway {}", env!("CARGO_PKG_VERSION"));
    let mut led = board.led();
    led.set(true);
    static WATCH: StaticCell<TaskWatch<MAX_TASKS>> = StaticCell::new();
    let tasks = Tasks::new(spawner, WATCH.init_with(TaskWatch::new));
    // First of all, so that the watchdog resets the board if anything later hangs.
    spawner.spawn(feeder(tasks.watch(), board.watchdog()).expect("it is spawned once"));
    // Both are all zeros: placed in .bss, not built on the stack.
    static GATEWAY: ConstStaticCell<Gateway> = ConstStaticCell::new(Gateway::idle());
    static OVERLAY: ConstStaticCell<Overlay> = ConstStaticCell::new(Overlay::ZEROED);
    let (gateway, overlay) = (GATEWAY.take(), OVERLAY.take());
    let mut stored = open_store(&mut board);
    let mut work = store::StartWork::default();
    let mut failure = None;
    let config = overlay.configuration();
    let loaded = load(&mut board, stored.as_deref_mut(), gateway, config, &mut work, &mut failure);
    let mut wiring = Wiring { ports: heapless::Vec::new(), links: heapless::Vec::new(), network: None };
    if let Ok(len) = loaded {
        wire(len, gateway, config, &mut wiring);
    }
    let gateway: &'static Gateway = gateway;
    let edge_setup =
        make_edge(stored.as_deref_mut(), gateway, loaded.is_ok().then_some(&*config), board.seed());
    // The configuration is not needed any more.
    let mut memory = overlay.buffers();
    let image = memory.split_off_mut(..MAX_IMAGE).and_then(|image| image.as_mut_array());
    let image = image.expect("there is room for an image");
    let key = stored.as_ref().and_then(|stored| stored.access_key());
    let slots = board.slots();
    let store =
        stored.and_then(|stored| start_store_task(&tasks, gateway, stored, image, slots, work, failure));
    let ran = loaded.and_then(|_| run_ports(&tasks, &mut board, gateway, &wiring));
    if ran.is_err() {
        wiring.links.clear();
    }
    let connected = connect(&tasks, &mut board, gateway, store, key, &wiring, edge_setup, memory);
    let console = connected.as_ref().ok().copied().flatten();
    let refused_why = ran.err().or(connected.err());
    let shown = LedSources { gateway: refused_why.is_none().then_some(gateway), console };
    tasks.spawn(TaskName::Led, |pulse| status_led(pulse, shown, led));
    if let Some(reason) = refused_why {
        tasks.spawn(TaskName::Refused, |pulse| refused(pulse, reason));
    }
    tasks
}

/// Reads the store; `None` if there is none, or if a newer program wrote it.
#[inline(never)]
fn open_store(board: &mut Board) -> Option<&'static mut StoredConfig<StoreArea>> {
    static STORED: StaticCell<StoredConfig<StoreArea>> = StaticCell::new();
    let places = board.flash()?;
    let stored = StoredConfig::open(places).inspect_err(|error| error!("{}", DisplayText(error))).ok()?;
    Some(STORED.init(stored))
}

/// The edge node, if there are settings for one.
struct EdgeSetup {
    view: NodeView,
    node: Option<&'static mut edge::Node>,
    seed: u64,
}

/// Creates the edge node for the running configuration, which is in memory only during the start.
#[inline(never)]
fn make_edge(
    stored: Option<&mut StoredConfig<StoreArea>>,
    gateway: &Gateway,
    config: Option<&GatewayConfig>,
    seed: u64,
) -> EdgeSetup {
    static EDGE: StaticCell<Edge> = StaticCell::new();
    static CLOCK: ConstStaticCell<WallClock> = ConstStaticCell::new(WallClock::unknown());
    static MEMORY: ConstStaticCell<edge::NodeMemory> = ConstStaticCell::new(edge::NodeMemory::ZEROED);
    static NODE: StaticCell<edge::Node> = StaticCell::new();
    let edge: &'static Edge = EDGE.init(Edge::off());
    let mut edge_setup =
        EdgeSetup { view: NodeView { edge, document: None, clock: CLOCK.take() }, node: None, seed };
    let edge::NodeMemory { document, node } = MEMORY.take();
    let bd_seq = stored.as_ref().and_then(|stored| stored.store().birth_sequence());
    match stored.and_then(|stored| stored.edge(document)) {
        None | Some(Ok(false)) => return edge_setup,
        Some(Ok(true)) => {}
        Some(Err(error)) => {
            error!("edge node: {}", DisplayText(&error));
            edge.cannot(EdgeError::Settings(error));
            return edge_setup;
        }
    }
    let document: &'static edge::NodeDocument = document;
    edge_setup.view.document = Some(document);
    let made = config
        .ok_or(EdgeError::NothingRuns)
        .and_then(|config| edge::Node::make(document, node, gateway, config.view(), bd_seq, seed));
    match made {
        Ok(node) => edge_setup.node = Some(NODE.init(node)),
        Err(why) => {
            error!("edge node: {}", DisplayText(&why));
            edge.cannot(why);
        }
    }
    edge_setup
}

#[inline(never)]
fn start_store_task(
    tasks: &Tasks,
    gateway: &'static Gateway,
    stored: &'static mut StoredConfig<StoreArea>,
    image: &'static mut [u8; MAX_IMAGE],
    slots: Site<SlotArea>,
    work: store::StartWork<'static>,
    failure: Option<CannotRun>,
) -> Option<&'static StoreHandle> {
    static UPDATES: StaticCell<Updates<SlotArea>> = StaticCell::new();
    let updates = UPDATES.init(Updates::new(slots)?);
    static HANDLE: StaticCell<StoreHandle> = StaticCell::new();
    let store: &'static StoreHandle = HANDLE.init_with(|| StoreHandle::new(image));
    if let Some(failure) = failure {
        store.failed(&failure);
    }
    tasks.spawn(TaskName::Store, |pulse| store_task(pulse, gateway, store, stored, updates, work));
    Some(store)
}

type Tasks = board::Tasks<MAX_TASKS>;

/// The parts of the configuration that the tasks need.
struct Wiring {
    ports: heapless::Vec<(PortId, Bus), { firmware::tasks::gateway::MAX_FIELD_PORTS }>,
    links: heapless::Vec<(LinkId, LinkKind, Endpoint), MAX_LINKS>,
    network: Option<Network>,
}

/// Memory that the configuration uses during the start, and the buffers of the tasks afterwards.
#[allow(clippy::large_enum_variant, reason = "both share one memory")]
#[repr(u8)]
enum Overlay {
    Configuration(GatewayConfig),
    Buffers(heapless::Vec<u8, BUFFERS>),
}

impl Overlay {
    /// The initial value, all zeros, so that the static takes no flash.
    const ZEROED: Self = Self::Configuration(GatewayConfig::empty());

    fn configuration(&mut self) -> &mut GatewayConfig {
        match self {
            Self::Configuration(config) => config,
            Self::Buffers(_) => unreachable!("the buffers come last"),
        }
    }

    /// The tasks' buffers, which replace the configuration.
    fn buffers(&mut self) -> &mut [u8] {
        *self = Self::Buffers(heapless::Vec::new());
        let Self::Buffers(buffers) = self else { return &mut [] };
        let _ = buffers.resize_default(buffers.capacity());
        buffers
    }
}

/// Size of the buffers: an image to be stored, and the sockets of links, edge node and console.
const BUFFERS: usize =
    MAX_IMAGE + LinkBuffers::ALL + edge::NodeBuffers::SIZE + CONNECTIONS * console::ConnectionBuffers::SIZE;

#[inline(never)]
fn wire(len: usize, gateway: &Gateway, config: &GatewayConfig, wiring: &mut Wiring) {
    wiring
        .ports
        .extend(config.view().field_ports().map(|(index, port, _)| (PortId(index), port.bus.clone())));
    wiring.links.extend(gateway.links().map(|(id, kind)| (id, kind, Endpoint::of(config, kind))));
    wiring.network = config.network.fixed().copied();
    info!(
        "configuration: {} bytes; {} field ports, {} links; the engine has {} bytes, its configuration {}",
        len,
        wiring.ports.len(),
        wiring.links.len(),
        size_of::<Gateway>(),
        size_of::<GatewayConfig>(),
    );
}

#[inline(never)]
fn run_ports(
    tasks: &Tasks,
    board: &mut Board,
    gateway: &'static Gateway,
    wiring: &Wiring,
) -> Result<(), CannotRun> {
    // All devices are claimed before anything runs.
    let mut serial_ports: heapless::Vec<_, SERIAL_PORTS> = heapless::Vec::new();
    let mut can_ports: heapless::Vec<_, CAN_PORTS> = heapless::Vec::new();
    for (id, bus) in &wiring.ports {
        match bus {
            Bus::Rs485(settings) => {
                let line = board.serial(settings);
                let missing =
                    CannotRun::NoDevice(NoDevice { port: id.0, bus: "RS-485", available: SERIAL_PORTS });
                let line = line.ok_or(missing)?;
                let _ = serial_ports.push((*id, line, settings.baud));
            }
            Bus::Can { bitrate } => {
                let missing = CannotRun::NoDevice(NoDevice { port: id.0, bus: "CAN", available: CAN_PORTS });
                let _ = can_ports.push((*id, board.can(*bitrate).ok_or(missing)?));
            }
            // These ports have links instead of devices of the board.
            Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => {}
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
    Ok(())
}

/// Starts the network, the console, the links of the running configuration, and the edge node. Called last, so that the
/// field buses run even without a PHY.
#[inline(never)]
#[allow(clippy::too_many_arguments, reason = "each is used once")]
fn connect(
    tasks: &Tasks,
    board: &mut Board,
    gateway: &'static Gateway,
    store: Option<&'static StoreHandle>,
    key: Option<[u8; 16]>,
    wiring: &Wiring,
    edge_setup: EdgeSetup,
    mut memory: &'static mut [u8],
) -> Result<Option<&'static Console>, CannotRun> {
    let ethernet = board.ethernet().map_err(CannotRun::Ethernet)?;
    let name = match ethernet.hardware_address() {
        HardwareAddress::Ethernet(address) => identity::host_name(address),
        _ => identity::host_name([0; 6]),
    };
    let (stack, runner) =
        network_stack(Fair::new(ethernet, gateway), network_config(wiring.network, &name), board.seed());
    info!("stack: {} bytes while the engine was made", board.stack_used());
    tasks.spawn(TaskName::Network, |pulse| network(pulse, runner));
    tasks.spawn(TaskName::Address, |pulse| address(pulse, stack));
    for (id, kind, endpoint) in &wiring.links {
        let (id, kind, endpoint) = (*id, *kind, endpoint.clone());
        let buffers = LinkBuffers::take(&mut memory, &endpoint).expect("there is room for MAX_LINKS");
        tasks.spawn(TaskName::Link(kind), |pulse| {
            controller_link(pulse, gateway, id, stack, endpoint, buffers)
        });
    }
    let buffers = edge::NodeBuffers::take(&mut memory).expect("there is room for the edge node");
    let view = edge_setup.view;
    if let (Some(node), Some(store)) = (edge_setup.node, store) {
        if let Some(server) = view.document.and_then(|document| document.time_server.as_ref()) {
            let (host, port) = (server.0.as_str(), server.1);
            tasks.spawn(TaskName::Time, |pulse| {
                time_server(pulse, stack, host, port, view.clock, edge_setup.seed)
            });
        }
        tasks.spawn(TaskName::Edge, |pulse| edge_node(pulse, gateway, stack, store, view, node, buffers));
    }
    Ok(start_console(tasks, board, gateway, store, key, view, name, stack, memory))
}

/// Starts the console; `None` if the board cannot have one.
#[inline(never)]
#[allow(clippy::too_many_arguments, reason = "each is used once")]
fn start_console(
    tasks: &Tasks,
    board: &mut Board,
    gateway: &'static Gateway,
    store: Option<&'static StoreHandle>,
    key: Option<[u8; 16]>,
    node: NodeView,
    name: heapless::String<{ identity::NAME }>,
    stack: Stack<'static>,
    mut memory: &'static mut [u8],
) -> Option<&'static Console> {
    let Some(secret) = board.random() else {
        error!("no console: the board has no random numbers");
        return None;
    };
    info!("name {}", name.as_str());
    static CONSOLE: StaticCell<Console> = StaticCell::new();
    let console: &'static Console =
        CONSOLE.init_with(|| Console::new(gateway, store, PORTS, node, name, key, secret));
    for nth in 0..CONNECTIONS {
        let buffers = console::ConnectionBuffers::take(&mut memory).expect("there is room for CONNECTIONS");
        tasks.spawn(TaskName::Console(nth as u8), |pulse| connection(pulse, console, stack, buffers));
    }
    let button = board.button();
    tasks.spawn(TaskName::Button, |pulse| watch_button(pulse, console, button));
    Some(console)
}

/// Not inlined, to free its stack frame before links and console are started.
#[inline(never)]
fn network_stack(
    ethernet: Fair<'static, Ethernet>,
    config: Config,
    seed: u64,
) -> (Stack<'static>, Runner<'static, Fair<'static, Ethernet>>) {
    static RESOURCES: StaticCell<StackResources<SOCKETS>> = StaticCell::new();
    embassy_net::new(ethernet, config, RESOURCES.init(StackResources::new()), seed)
}

fn network_config(own: Option<Network>, name: &str) -> Config {
    let Some(own) = own else {
        let mut config = DhcpConfig::default();
        config.hostname = heapless::String::try_from(name).ok();
        return Config::dhcpv4(config);
    };
    Config::ipv4_static(StaticConfigV4 {
        address: Ipv4Cidr::new(own.address, own.prefix),
        gateway: own.router,
        dns_servers: own.dns.into_iter().collect(),
    })
}

/// Feeds the watchdog. It is the only task without a pulse, because it checks the pulses of the others.
#[embassy_executor::task]
async fn feeder(watch: &'static TaskWatch<MAX_TASKS>, mut dog: Watchdog) -> ! {
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
    buffers: LinkBuffers<'static>,
) -> ! {
    pulse.run(pin!(link::run(gateway, pulse, id, stack, &endpoint, buffers))).await
}

#[embassy_executor::task]
async fn network(pulse: &'static Pulse, mut runner: Runner<'static, Fair<'static, Ethernet>>) -> ! {
    // The waits inside the network stack cannot be wrapped, so the check is only that polling the stack returns.
    let mut running = pin!(runner.run());
    pulse.run(pin!(pulse.idle(running.as_mut()))).await
}

/// Sources of the LED's condition.
#[derive(Clone, Copy)]
struct LedSources {
    /// `None` if nothing runs, or there is no Ethernet.
    gateway: Option<&'static Gateway>,
    console: Option<&'static Console>,
}

#[embassy_executor::task]
async fn status_led(pulse: &'static Pulse, shown: LedSources, mut led: BoardLed) -> ! {
    let condition = || match shown.console {
        Some(console) if console.is_identifying() => Condition::Identify,
        _ => shown.gateway.map_or(Condition::Refused, Gateway::condition),
    };
    pulse.run(pin!(led::run(pulse, condition, |is_lit| led.set(is_lit)))).await
}

#[embassy_executor::task(pool_size = CONNECTIONS)]
async fn connection(
    pulse: &'static Pulse,
    console: &'static Console,
    stack: Stack<'static>,
    buffers: console::ConnectionBuffers<'static>,
) -> ! {
    pulse.run(pin!(console.serve(pulse, stack, buffers))).await
}

#[embassy_executor::task]
async fn watch_button(pulse: &'static Pulse, console: &'static Console, button: UserButton) -> ! {
    pulse.run(pin!(console.watch(pulse, button))).await
}

#[embassy_executor::task]
async fn edge_node(
    pulse: &'static Pulse,
    gateway: &'static Gateway,
    stack: Stack<'static>,
    store: &'static StoreHandle,
    view: NodeView,
    node: &'static mut edge::Node,
    buffers: edge::NodeBuffers<'static>,
) -> ! {
    pulse.run(pin!(node.run(gateway, pulse, stack, store, view.edge, view.clock, buffers))).await
}

#[embassy_executor::task]
async fn time_server(
    pulse: &'static Pulse,
    stack: Stack<'static>,
    host: &'static str,
    port: u16,
    clock: &'static WallClock,
    seed: u64,
) -> ! {
    pulse.run(pin!(time::run(pulse, stack, (host, port), clock, seed))).await
}

#[embassy_executor::task]
async fn address(pulse: &'static Pulse, stack: Stack<'static>) -> ! {
    let log = async {
        loop {
            // Wait for the link first: a fixed address is configured before the link is up, but cannot be reached yet.
            pulse.idle(pin!(stack.wait_link_up())).await;
            pulse.idle(pin!(stack.wait_config_up())).await;
            if let Some(config) = stack.config_v4() {
                info!("address {}", DisplayText(&config.address));
            }
            pulse.idle(pin!(stack.wait_config_down())).await;
            warn!("no address");
        }
    };
    pulse.run(pin!(log)).await
}

#[embassy_executor::task]
async fn status(pulse: &'static Pulse, gateway: &'static Gateway) -> ! {
    pulse.run(pin!(firmware::tasks::status::run(gateway, pulse))).await
}

/// Runs the store task, and resets the board when it ends.
#[embassy_executor::task]
async fn store_task(
    pulse: &'static Pulse,
    gateway: &'static Gateway,
    store: &'static StoreHandle,
    stored: &'static mut StoredConfig<StoreArea>,
    updates: &'static mut Updates<SlotArea>,
    work: store::StartWork<'static>,
) -> ! {
    pulse.run(pin!(store::run(gateway, pulse, store, stored, updates, work))).await;
    cortex_m::peripheral::SCB::sys_reset()
}

/// Logs repeatedly why no configuration runs, because a reader of the log may connect late.
#[embassy_executor::task]
async fn refused(pulse: &'static Pulse, reason: CannotRun) -> ! {
    let what = if matches!(reason, CannotRun::Ethernet(_)) { "no controller" } else { "nothing runs" };
    let log = async {
        loop {
            error!("{}: {}", what, DisplayText(&reason));
            pulse.idle(pin!(Timer::after(REPEAT))).await;
        }
    };
    pulse.run(pin!(log)).await
}

/// Number of sockets: one for each link and connection, the broker, the time server, DHCP and DNS.
const SOCKETS: usize = MAX_LINKS + CONNECTIONS + 4;
/// Interval of that log line.
const REPEAT: Duration = Duration::from_secs(10);
/// Maximum number of tasks: one for each port, link and connection, and one each for: engine, network, address, status,
/// LED, refused configuration, store, button, edge node, time, the board's own.
const MAX_TASKS: usize = SERIAL_PORTS + CAN_PORTS + MAX_LINKS + CONNECTIONS + 11;
// The timer queue (`generic-queue-32`) needs an entry for each task, for the task that feeds the watchdog, and for the
// start.
const _: () = assert!(MAX_TASKS + 2 <= 32);
