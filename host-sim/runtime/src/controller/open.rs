//! Opening the controller's devices, listening sockets and tasks.

use std::cell::{Cell, RefCell};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::rc::Rc;

use serde_json::{Map, Value, json};
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tokio::task::JoinSet;

use super::{ControllerOptions, ControllerRuntime, Outward, RunningController};
use crate::{EventsFile, RunError, udp};
use recipe_config::{Listen, SimBus, SimConfig, SimParts};
use recipe_controller::{Controller, ControllerInput, Link};
use recipe_io::bind::Bind;
use recipe_io::clock::Clock;
use recipe_io::log_limit::LogLimit;
use recipe_io::port::{BusSettings, OpenPort};

impl RunningController {
    pub(super) async fn open(config: SimConfig, options: ControllerOptions) -> Result<Self, RunError> {
        let mut controller = Controller::new(&config).map_err(|error| RunError::new(error.to_string()))?;
        if let Some(seed) = options.seed {
            controller.seed(seed);
        }
        controller.record_events();
        let clock = Clock::new(options.pace);
        let devices = open_devices(&config, &options.run.binds, &clock).await?;
        let ControllerSockets { command, state, modbus, control, udp, udp_at, mut ready } =
            ControllerSockets::open(&config.listen).await?;
        let mut places = Map::new();
        let mut ports = Vec::new();
        for (port, device) in config.ports.iter().zip(&devices) {
            let (outward, place) = match (&port.bus, device) {
                (_, Some(device)) => (Outward::Device(device.tx()), device.place()),
                (SimBus::TcpClient { to }, _) => (Outward::Tcp(RefCell::default()), to.clone()),
                (SimBus::UdpClient { to }, _) => (Outward::Udp(RefCell::default()), to.clone()),
                _ => (Outward::UdpServer, udp_at.to_string()),
            };
            ports.push(outward);
            places.insert(port.name.clone(), json!(place));
        }
        let is_kernel_can = |device: &Option<OpenPort>| device.as_ref().is_some_and(OpenPort::is_kernel_can);
        let kernel_can = (0..devices.len()).filter(|&nth| is_kernel_can(&devices[nth])).collect();
        let alarm =
            || clock.alarm().map_err(|error| RunError::new(format!("cannot create a timer: {error}")));
        let (timer, timeline_alarm) = (alarm()?, alarm()?);
        // The last step that can fail: an earlier run's file is kept if this run cannot start.
        let events_file = options.events.as_ref().map(EventsFile::create).transpose()?;
        ready.insert("ports".to_owned(), json!(places));
        let runtime = Rc::new(ControllerRuntime {
            controller: RefCell::new(controller),
            connections: RefCell::default(),
            next_connection: Cell::new(0),
            udp,
            ports,
            port_names: config.ports.iter().map(|port| port.name.clone()).collect(),
            reports: RefCell::default(),
            lingering: RefCell::default(),
            busy: Cell::new(false),
            timer,
            clock,
            waits: RefCell::default(),
            moved: Notify::new(),
            kernel_can,
            kernel_sends: RefCell::default(),
            activity: Cell::new(0),
            timeline: RefCell::new(options.timeline),
            timeline_alarm,
            is_playing: Cell::new(false),
            reported: Cell::new(0),
            events_file,
            control_clients: RefCell::default(),
            refused_control_clients: Cell::new(0),
            ended: Notify::new(),
            counters: Cell::default(),
            refusal_log: LogLimit::default(),
            log_limit: LogLimit::default(),
        });
        let mut tasks = JoinSet::new();
        tasks.spawn_local(Rc::clone(&runtime).serve(Link::Command, command));
        tasks.spawn_local(Rc::clone(&runtime).serve(Link::State, state));
        tasks.spawn_local(Rc::clone(&runtime).serve(Link::Modbus, modbus));
        tasks.spawn_local(Rc::clone(&runtime).serve_udp());
        tasks.spawn_local(Rc::clone(&runtime).serve_control(control));
        tasks.spawn_local(Rc::clone(&runtime).keep_time());
        tasks.spawn_local(Rc::clone(&runtime).keep_timeline());
        if runtime.clock.is_stepped() {
            tasks.spawn_local(Rc::clone(&runtime).keep_stepping());
        }
        for (index, (port, device)) in config.ports.into_iter().zip(devices).enumerate() {
            let runtime = Rc::clone(&runtime);
            match (port.bus, device) {
                (_, Some(device)) => drop(tasks.spawn_local(runtime.drive(index, device))),
                (SimBus::TcpClient { to }, _) => drop(tasks.spawn_local(runtime.connect_out(index, to))),
                (SimBus::UdpClient { to }, _) => drop(tasks.spawn_local(runtime.send_out(index, to))),
                _ => {}
            }
        }
        runtime.input(ControllerInput::Tick);
        Ok(Self { runtime, tasks, ready: Value::Object(ready) })
    }
}

struct ControllerSockets {
    command: TcpListener,
    state: TcpListener,
    modbus: TcpListener,
    control: TcpListener,
    udp: UdpSocket,
    udp_at: SocketAddr,
    /// Addresses of the sockets, by their names in the file.
    ready: Map<String, Value>,
}

impl ControllerSockets {
    async fn open(wanted: &Listen) -> Result<Self, RunError> {
        let address = wanted.address;
        let listen = async |key: &str, address: IpAddr, port: u16| {
            let listener = TcpListener::bind((address, port)).await;
            let local = listener.and_then(|listener| Ok((listener.local_addr()?, listener)));
            local.map_err(|error| not_listening(key, SocketAddr::new(address, port), &error))
        };
        let (command_at, command) = listen("command", address, wanted.command).await?;
        let (state_at, state) = listen("state", address, wanted.state).await?;
        let (modbus_at, modbus) = listen("modbus", address, wanted.modbus).await?;
        let loopback = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let (control_at, control) = listen("control", loopback, wanted.control).await?;
        let udp_wanted = SocketAddr::new(address, wanted.udp2011);
        let udp = UdpSocket::bind(udp_wanted).await;
        let (udp, udp_at) = udp
            .and_then(|udp| {
                udp::keep_errors(&udp)?;
                let at = udp.local_addr()?;
                Ok((udp, at))
            })
            .map_err(|error| not_listening("udp2011", udp_wanted, &error))?;
        let places = [
            ("command", command_at),
            ("state", state_at),
            ("modbus", modbus_at),
            ("udp2011", udp_at),
            ("control", control_at),
        ];
        let ready = places.map(|(name, at)| (name.to_owned(), json!(at))).into_iter().collect();
        Ok(Self { command, state, modbus, control, udp, udp_at, ready })
    }
}

/// Opens the devices; `None` for a port that needs none.
async fn open_devices(
    config: &SimConfig,
    binds: &[Bind],
    clock: &Clock,
) -> Result<Vec<Option<OpenPort>>, RunError> {
    for (index, bind) in binds.iter().enumerate() {
        let refused = |why: &str| Err(RunError::new(format!("--bind {bind}: {why}")));
        match config.ports.iter().find(|port| port.name == bind.port) {
            None => return refused(&format!("there is no such port; {}", bindable(config))),
            Some(port) if bus_of(&port.bus).is_none() => {
                return refused("this port is reached over the network and takes no device");
            }
            Some(_) if binds[..index].iter().any(|other| other.port == bind.port) => {
                return refused("the port is already bound");
            }
            Some(_) => {}
        }
    }
    let mut devices = Vec::new();
    for port in &config.ports {
        devices.push(match bus_of(&port.bus) {
            Some(bus) => {
                let mut device = open_device(&port.name, bus, binds).await?.on_clock(clock);
                let recipe = port.recipe.and_then(|recipe| config.recipes.get(recipe));
                if let Some(SimParts::Can { input, output }) = recipe.map(|recipe| &recipe.parts) {
                    device.listen_to(input.iter().chain(output).map(|frame| frame.id).collect());
                }
                Some(device)
            }
            None => None,
        });
    }
    Ok(devices)
}

async fn open_device(name: &str, bus: BusSettings, binds: &[Bind]) -> Result<OpenPort, RunError> {
    let Some(bind) = binds.iter().find(|bind| bind.port == name) else {
        let (kind, forms) = match bus {
            BusSettings::Serial(_) => {
                ("serial line", "pty:PATH, serial:PATH, tcp:HOST:PORT or tcp-listen:HOST:PORT")
            }
            BusSettings::Can { .. } => {
                ("CAN bus", "socketcan:INTERFACE, slcan-pty:PATH or slcan-tcp:HOST:PORT")
            }
        };
        return Err(RunError::new(format!(
            "port {name} is a {kind} without a device: add --bind {name}=DEVICE, where DEVICE is {forms}"
        )));
    };
    let opened = OpenPort::open(&bind.device, bus).await;
    opened.map_err(|error| RunError::new(format!("--bind {bind}: {error}")))
}

fn bindable(config: &SimConfig) -> String {
    let ports = config.ports.iter().filter(|port| bus_of(&port.bus).is_some());
    let names: Vec<_> = ports.map(|port| port.name.as_str()).collect();
    if names.is_empty() {
        "no port takes a device".to_owned()
    } else {
        format!("ports that take a device: {}", names.join(", "))
    }
}

fn not_listening(key: &str, address: SocketAddr, error: &std::io::Error) -> RunError {
    RunError::new(format!("listen.{key}: {address}: {error}"))
}

fn bus_of(bus: &SimBus) -> Option<BusSettings> {
    match bus {
        SimBus::Rs485(settings) => Some(BusSettings::Serial(*settings)),
        SimBus::Can { bitrate } => Some(BusSettings::Can { bitrate: *bitrate }),
        SimBus::UdpServer | SimBus::TcpClient { .. } | SimBus::UdpClient { .. } => None,
    }
}
