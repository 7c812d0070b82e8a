//! Opens the gateway's devices, listening sockets and tap.

use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::rc::Rc;
use std::sync::Arc;
use std::time::SystemTime;

use proto_core::config::{Bus, GatewayConfig, Parts, Port as PortConfig};
use proto_core::engine::{Endpoint as To, LinkKind, PortId, Transport};
use proto_core::sysvar::Direction;
use proto_core::time::Instant;
use recipe_config::board::encoded;
use serde_json::json;
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tracing::info;

use super::tapping::Tapping;
use super::{Core, Observers, PreparedGateway, TxPolicy};
use crate::RunError;
use crate::host::AtEnd;
use crate::link::LinkEndpoint;
use crate::snapshot::GatewayEngine;
use recipe_capture::{Cell as Watched, Epoch};
use recipe_io::bind::Bind;
use recipe_io::handover::{Handover, HandoverDevice};
use recipe_io::port::{BusSettings, OpenPort};
use recipe_io::tcp_options;
use recipe_io::timer::now;

pub(super) struct Devices<'a> {
    pub(super) binds: &'a [Bind],
    /// Devices of the previous gateway, and where this one puts its own; `None` if it closes them.
    pub(super) handover: Option<(Handover, &'a AtEnd)>,
}

impl<'a> Devices<'a> {
    /// Devices that belong to one gateway only.
    pub(super) fn own(binds: &'a [Bind]) -> Self {
        Self { binds, handover: None }
    }

    /// Opens a port's device, or takes it over from the previous gateway.
    async fn open(&self, port: &PortConfig) -> Result<OpenPort, RunError> {
        let taken = self.handover.as_ref().and_then(|(handover, _)| handover.take(&port.name));
        let device = open_port(port, self.binds, taken).await?;
        if let Some((handover, at_end)) = &self.handover
            && let Some(hold) = device.hold()
        {
            let (handover, name) = (handover.clone(), port.name.to_string());
            at_end.add(move || {
                if let Some(device) = hold.release() {
                    handover.put(&name, device);
                }
            });
        }
        Ok(device)
    }
}

impl PreparedGateway {
    /// Opens devices and listening sockets.
    pub(super) async fn open(
        config: &GatewayConfig,
        devices: Devices<'_>,
        tx_policy: TxPolicy,
        observers: &Observers,
    ) -> Result<Self, RunError> {
        let engine: Box<GatewayEngine> =
            Box::new(GatewayEngine::new(config).map_err(|error| RunError::new(error.to_string()))?);
        // Modbus TCP ports have links instead.
        let has_device = |port: &PortConfig| !port.bus.is_modbus_tcp();
        let field = || config.view().field_ports().map(|(_, port, _)| port).filter(|port| has_device(port));
        if let Some(bind) =
            devices.binds.iter().find(|bind| field().all(|port| port.name != bind.port.as_str()))
        {
            let names: Vec<_> = field().map(|port| port.name.as_str()).collect();
            let message = format!("--bind {bind}: there is no such port; there are {}", names.join(", "));
            return Err(RunError::new(message));
        }
        let (mut ports, mut exchange_ports) = (Vec::new(), BTreeSet::new());
        for (index, port, recipe) in config.view().field_ports() {
            if recipe.exchanges.len > 0 {
                exchange_ports.insert(PortId(index));
            }
            if !has_device(port) {
                continue;
            }
            let mut device = devices.open(port).await?;
            if matches!(recipe.parts, Parts::Can { .. }) {
                let ids = |part| config.view().can_ids(recipe, part);
                device.listen_to(ids(Direction::Input).chain(ids(Direction::Output)).collect());
            }
            ports.push((PortId(index), device));
        }
        let mut links = Vec::new();
        for info in engine.links() {
            links.push((info.id, info.kind, open_endpoint(info.endpoint).await?));
        }
        let name = |id: PortId| config.ports.get(usize::from(id.0)).map_or("", |port| port.name.as_str());
        let mut places = serde_json::Map::new();
        for (id, port) in &ports {
            places.insert(name(*id).to_owned(), json!(port.place()));
        }
        for (_, kind, endpoint) in &links {
            if let LinkKind::RecipeTcpListen { port }
            | LinkKind::RecipeUdpListen { port }
            | LinkKind::ModbusDevice { port } = kind
            {
                places.insert(name(*port).to_owned(), json!(endpoint.place()));
            }
        }
        let tapping = begin_tapping(config, &engine, observers)?;
        let core = Rc::new(Core {
            tapping: RefCell::new(tapping),
            ports: ports.iter().map(|(id, port)| (*id, (name(*id).to_owned(), port.tx()))).collect(),
            links: links.iter().map(|(id, ..)| (*id, Rc::default())).collect(),
            engine: RefCell::new(engine),
            deadline: Cell::new(Instant::NEVER),
            sleeps: Cell::new(0),
            unreachable: RefCell::default(),
            deadline_moved: Notify::new(),
            is_ending: Cell::new(false),
            tx_policy,
            exchange_ports,
            started: now(),
            records: RefCell::default(),
        });
        Ok(Self {
            core,
            ports,
            links,
            ready: json!({ "ports": places }),
            slot: None,
            publisher_slot: None,
            doctor: None,
        })
    }
}

/// Starts to record for subscribers.
fn begin_tapping(
    config: &GatewayConfig,
    engine: &GatewayEngine,
    Observers { watch, decoder, .. }: &Observers,
) -> Result<Tapping, RunError> {
    let at = now();
    let cell = Watched::new(config, engine, Epoch { at, wall: SystemTime::now() }, Arc::clone(decoder));
    // Only recordings start with the image; a long configuration has none.
    let image = watch.wanted().passes.then(|| encoded(config)).transpose().map_err(RunError::new)?;
    Tapping::begin(watch, cell, at, image.as_deref())
        .map_err(|error| RunError::new(format!("cannot start a thread: {error}")))
}

async fn open_port(
    port: &PortConfig,
    binds: &[Bind],
    handover: Option<HandoverDevice>,
) -> Result<OpenPort, RunError> {
    let name = port.name.as_str();
    let bus = match port.bus {
        Bus::Rs485(settings) => BusSettings::Serial(settings),
        Bus::Can { bitrate } => BusSettings::Can { bitrate },
        Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => {
            return Err(RunError::new(format!("port {name} is not a field port")));
        }
    };
    let mut own = binds.iter().filter(|bind| bind.port == name);
    let (Some(bind), None) = (own.next(), own.next()) else {
        let examples = match bus {
            BusSettings::Serial(_) => "pty:PATH or serial:/dev/ttyUSB0",
            BusSettings::Can { .. } => "socketcan:can0, slcan-tcp:127.0.0.1:0 or slcan-pty:PATH",
        };
        return Err(RunError::new(format!(
            "port {name} needs exactly one device: --bind {name}=DEVICE, such as {examples}"
        )));
    };
    let opened = OpenPort::open_or_adopt(&bind.device, bus, handover).await;
    let device = opened.map_err(|error| RunError::new(format!("--bind {name}={}: {error}", bind.device)))?;
    if device.is_handed_over() {
        info!(port = name, "the device stays open; its clients stay connected");
    }
    Ok(device)
}

async fn open_endpoint(to: To<'_>) -> Result<LinkEndpoint, RunError> {
    if to.host.is_empty() {
        let message = "controller.address is needed: the controller's address or host name";
        return Err(RunError::new(message));
    }
    let host = to.host.to_owned();
    let refused = |address, error| RunError::new(format!("cannot listen on {address}: {error}"));
    Ok(match to.transport {
        Transport::Tcp { port } => LinkEndpoint::Tcp { host, port },
        Transport::Udp { port } => LinkEndpoint::Udp { host, port },
        Transport::TcpListen { local } => {
            let listener = TcpListener::bind(local).await.map_err(|error| refused(local, error))?;
            tcp_options::limit_buffers(&listener);
            LinkEndpoint::TcpListen { listener, controller: host }
        }
        Transport::UdpListen { local } => {
            let socket = UdpSocket::bind(local).await.map_err(|error| refused(local, error))?;
            LinkEndpoint::UdpListen { socket, controller: host }
        }
        other => return Err(RunError::new(format!("unknown kind of link: {other:?}"))),
    })
}

impl LinkEndpoint {
    fn place(&self) -> String {
        let address = match self {
            Self::TcpListen { listener, .. } => listener.local_addr(),
            Self::UdpListen { socket, .. } => socket.local_addr(),
            Self::Tcp { host, port } | Self::Udp { host, port } => return format!("{host}:{port}"),
        };
        address.map_or_else(|_| String::new(), |address| address.to_string())
    }
}
