//! The frames of a file in one common form: parts and exchanges, of devices and of the controller's own recipes.
//!
//! In: a gateway file or a controller file. Out: ports, and for each recipe its frames with names, places and uses of
//! their fields. Exports and decoded recordings are made from this.

use std::path::Path;

use proto_core::config::{Bus, DeviceFrame, FieldSpec, GatewayConfig, InputBinding, SafeValue, SendOn};
use proto_core::device::{Boundary, Carrier, Cutter, Element, LayoutError, Piece, Place, Probe};
use proto_core::recipe::model;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use recipe_config::file::{self, Config, FileError, Text};
use recipe_config::{
    AnyRecipe, DeviceField, DeviceRecipe, ExchangeKind, FrameEnds, NamedFrame, SimBus, SimConfig, SimField,
    SimParts, SimRecipe,
};

/// The ports and recipes of a file.
#[derive(Debug, Clone)]
pub struct Model {
    /// Whose file it is.
    pub owner: Owner,
    /// Every port, in file order.
    pub ports: Vec<PortModel>,
    /// Every recipe, in file order.
    pub recipes: Vec<Recipe>,
}

/// Whose file it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The gateway's.
    Gateway,
    /// The simulated controller's.
    Controller,
}

/// A port.
#[derive(Debug, Clone)]
pub struct PortModel {
    /// Its name.
    pub name: String,
    /// What it is connected to.
    pub bus: BusModel,
    /// Index of its recipe; `None` if it is idle.
    pub recipe: Option<usize>,
    /// The period of the output part, if it is only sent periodically.
    pub period: Option<Duration>,
    /// The values of the port's health that are written to variables, with the variables.
    pub health: Vec<(&'static str, SysVar)>,
    /// Safe values of inputs while the device is silent: the name of variable or bit in the file, the variable, the
    /// value.
    pub safe: Vec<(String, SysVar, String)>,
}

/// The bus of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusModel {
    /// A serial line.
    Serial {
        /// Bit/s.
        baud: u32,
    },
    /// A CAN bus.
    Can {
        /// Bit/s.
        bitrate: u32,
    },
    /// A Modbus TCP connection to devices: each frame has the header of Modbus TCP and no CRC.
    ModbusTcp,
    /// TCP or UDP.
    Network,
}

/// A recipe.
#[derive(Debug, Clone)]
pub struct Recipe {
    /// Its name.
    pub name: String,
    /// Every frame: of the input part, of the output part, of the exchanges.
    pub formats: Vec<Format>,
}

/// The purpose of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// The input part: user to robot.
    Input,
    /// The output part: robot to user.
    Output,
    /// The request of the exchange with this number, from 1.
    Request(usize),
    /// The reply of this exchange.
    Reply(usize),
    /// The frame of a peer that is still executing the request.
    Pending(usize),
    /// The frame of a peer that refuses the request.
    Refusal(usize),
}

impl Role {
    /// A short name: `input`, `reply-2`.
    pub fn name(self) -> String {
        match self {
            Self::Input => "input".into(),
            Self::Output => "output".into(),
            Self::Request(nth) => format!("request-{nth}"),
            Self::Reply(nth) => format!("reply-{nth}"),
            Self::Pending(nth) => format!("pending-{nth}"),
            Self::Refusal(nth) => format!("refusal-{nth}"),
        }
    }
}

/// The format of all frames with the same fields at the same places.
#[derive(Debug, Clone)]
pub struct Format {
    /// What it is for.
    pub role: Role,
    /// Whether the owner of the file receives or sends it.
    pub direction: Direction,
    /// Its id on CAN.
    pub id: Option<CanId>,
    /// How the frames of a stream are separated.
    pub ends: FrameEnds,
    /// The period of the frame, if it has its own.
    pub every: Option<Duration>,
    /// Whether it is a remote frame, without data.
    pub is_remote: bool,
    /// Bytes at the beginning and at the end.
    pub delimiters: (Vec<u8>, Vec<u8>),
    /// Its fields, and the checksum among them.
    pub fields: Vec<FrameField>,
    /// Its layout.
    pub frame: DeviceFrame,
}

/// A field of a frame.
#[derive(Debug, Clone)]
pub struct FrameField {
    /// The field as in the file.
    pub field: DeviceField,
    /// The system variable of a field of a realtime recipe.
    pub system: Option<SysVar>,
    /// The place in the frame.
    pub place: Place,
    /// Index among the elements of the layout; `None` for a checksum.
    pub element: Option<usize>,
}

impl FrameField {
    /// The field's name, empty if it needs none.
    pub fn name(&self) -> &str {
        &self.field.name
    }

    /// The constant value of the field, if it is a constant of the frame or one that the gateway sends.
    pub fn constant(&self) -> Option<i64> {
        use proto_core::config::OutputBinding::Constant;
        match self.field.spec {
            FieldSpec::Fixed { value, .. } => Some(value),
            FieldSpec::DeviceOutput { from: Constant(value), .. }
            | FieldSpec::UserOutput { from: Constant(value), .. } => {
                (value.fract() == 0.0 && value.abs() < 9e15).then_some(value as i64)
            }
            _ => None,
        }
    }
}

impl Model {
    /// Reads a file of either kind.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, FileError> {
        file::with_text(path, |text| Self::parse(text, overrides))
    }

    /// As [`Model::load`], from a text.
    pub fn parse(text: Text<'_>, overrides: &[String]) -> Result<Self, FileError> {
        let config = file::parse(text, overrides)?;
        let recipes = file::parse_recipes(text, overrides)?;
        let frames = file::parse_frames(text, overrides)?;
        // The same frames were laid out when the file was read.
        let all = recipes.iter().zip(&frames).enumerate().map(|(nth, (recipe, framed))| {
            let gateway = match &config {
                Config::Gateway(config) => config.recipes.get(nth).map(|recipe| (&**config, recipe)),
                Config::Controller(_) => None,
            };
            let formats = match (framed, recipe) {
                (Some(device), _) | (None, AnyRecipe::Device(device)) => of_device(device, gateway),
                (None, AnyRecipe::Plain(recipe)) => of_system(recipe),
            };
            Ok(Recipe { name: recipe.name().to_owned(), formats: formats? })
        });
        let all: Result<Vec<_>, LayoutError> = all.collect();
        let recipes = all.map_err(|error| file::error_in(text, overrides, &["recipe"], error))?;
        let (owner, ports) = match &config {
            Config::Gateway(config) => (Owner::Gateway, gateway_ports(config)),
            Config::Controller(config) => (Owner::Controller, controller_ports(config)),
        };
        Ok(Self { owner, ports, recipes })
    }

    /// The recipe of a port.
    pub fn recipe_of(&self, port: &PortModel) -> Option<&Recipe> {
        self.recipes.get(port.recipe?)
    }
}

impl Format {
    /// The bytes without escapes of a frame on the wire, if it has this format. `id` is its id on CAN.
    pub fn take(&self, id: Option<CanId>, bytes: &[u8]) -> Option<Vec<u8>> {
        if self.id != id || self.is_remote {
            return None;
        }
        let DeviceFrame { layout, elements } = &self.frame;
        if layout.probe_whole(elements, bytes) == Probe::Frame(bytes.len()) {
            return Some(bytes.to_vec());
        }
        // Sent frames include their escape bytes.
        let mut cutter = Cutter::new(self.ends.boundary, self.ends.escape)?;
        let mut chunk = bytes;
        while let Some(piece) = cutter.next_piece(&mut chunk, layout.tail()) {
            if let Piece::Whole(bytes) = piece
                && layout.probe_whole(elements, bytes) == Probe::Frame(bytes.len())
            {
                return Some(bytes.to_vec());
            }
        }
        None
    }
}

fn gateway_ports(config: &GatewayConfig) -> Vec<PortModel> {
    let port = |port: &proto_core::config::Port| {
        let recipe = config.recipes.get(usize::from(port.recipe));
        let by_time = recipe.is_some_and(|recipe| recipe.send == SendOn::Period);
        PortModel {
            name: port.name.to_string(),
            bus: match port.bus {
                Bus::Rs485(line) => BusModel::Serial { baud: line.baud },
                Bus::Can { bitrate } => BusModel::Can { bitrate },
                Bus::ModbusTcp { .. } => BusModel::ModbusTcp,
                Bus::TcpListen { .. } | Bus::UdpListen { .. } => BusModel::Network,
            },
            recipe: Some(usize::from(port.recipe)),
            period: by_time.then_some(port.cycle),
            health: port.health.iter().map(|(value, var)| (value.name(), var)).collect(),
            safe: port.on_timeout.of(&config.safe_values).iter().flat_map(safe_value).collect(),
        }
    };
    config.ports.iter().map(port).collect()
}

/// A safe value as in the file: for the whole variable, or for each of its bits.
fn safe_value(safe: &SafeValue) -> Vec<(String, SysVar, String)> {
    let SafeValue { var, value, mask } = *safe;
    if safe.is_whole() {
        return vec![(var.to_string(), var, value.to_string())];
    }
    let on = value.as_f64() as u8;
    let bits = (0..8_u8).filter(|bit| mask & 1 << bit != 0);
    bits.map(|bit| (format!("{var}.{bit}"), var, (on >> bit & 1).to_string())).collect()
}

fn controller_ports(config: &SimConfig) -> Vec<PortModel> {
    let port = |port: &recipe_config::SimPort| {
        let recipe = port.recipe.and_then(|index| config.recipes.get(index));
        let by_time = recipe.is_some_and(|recipe| recipe.mode == model::Mode::Realtime);
        PortModel {
            name: port.name.clone(),
            bus: match port.bus {
                SimBus::Rs485(line) => BusModel::Serial { baud: line.baud },
                SimBus::Can { bitrate } => BusModel::Can { bitrate },
                _ => BusModel::Network,
            },
            recipe: port.recipe,
            period: by_time.then_some(port.cycle),
            health: Vec::new(),
            safe: Vec::new(),
        }
    };
    config.ports.iter().map(port).collect()
}

fn of_device(
    recipe: &DeviceRecipe,
    gateway: Option<(&GatewayConfig, &proto_core::config::Recipe)>,
) -> Result<Vec<Format>, LayoutError> {
    let mut formats = Vec::new();
    for (role, direction) in [(Role::Input, Direction::Input), (Role::Output, Direction::Output)] {
        let ends = recipe.ends(direction);
        for frame in recipe.part(direction) {
            formats.push(Format::new(frame, role, direction, recipe.carrier, ends)?);
        }
    }
    let times = gateway.map_or(&[][..], |(config, recipe)| config.view().exchanges_of(recipe));
    for (nth, exchange) in recipe.exchanges.iter().enumerate() {
        // A slave receives requests and sends replies.
        let (asks, answers) = match exchange.kind {
            ExchangeKind::Slave(_) => (Direction::Input, Direction::Output),
            _ => (Direction::Output, Direction::Input),
        };
        let frames = [
            (Role::Request(nth + 1), asks, &exchange.request),
            (Role::Reply(nth + 1), answers, &exchange.reply),
            (Role::Pending(nth + 1), answers, &exchange.pending),
            (Role::Refusal(nth + 1), answers, &exchange.refusal),
        ];
        for (role, direction, frame) in frames {
            let Some(frame) = frame else { continue };
            let carrier = if frame.id.is_some() { Carrier::Can } else { Carrier::Stream };
            let mut format = Format::new(frame, role, direction, carrier, FrameEnds::default())?;
            if matches!(role, Role::Request(_)) {
                format.is_remote = exchange.remote;
                format.every = times.get(nth).and_then(|exchange| exchange.when.every);
            }
            formats.push(format);
        }
    }
    Ok(formats)
}

/// The frames of a recipe of system variables.
fn of_system(recipe: &SimRecipe) -> Result<Vec<Format>, LayoutError> {
    let named = |id, (head, tail): (&[u8], &[u8]), fields: &[SimField]| {
        let field = |field: &SimField| {
            let spec = FieldSpec::UserInput { ty: field.field.ty(), to: InputBinding::Unused };
            DeviceField::new(field.name.clone(), spec)
        };
        let fields = fields.iter().map(field).collect();
        NamedFrame { id, head: head.to_vec(), tail: tail.to_vec(), fields, name: None, after: None }
    };
    let mut formats = Vec::new();
    let mut add = |part: Direction, carrier, frame: &NamedFrame, fields: &[SimField]| {
        let role = if part == Direction::Input { Role::Input } else { Role::Output };
        let mut format = Format::new(frame, role, part, carrier, FrameEnds::default())?;
        for (field, known) in format.fields.iter_mut().zip(fields) {
            field.system = match known.field {
                model::Field::System(var) => Some(var),
                model::Field::User(_) => None,
            };
        }
        formats.push(format);
        Ok::<(), LayoutError>(())
    };
    match &recipe.parts {
        SimParts::Stream { input, output } => {
            for (part, stream) in [(Direction::Input, input), (Direction::Output, output)] {
                let Some(stream) = stream else { continue };
                let frame = named(None, (&stream.head, &stream.tail), &stream.fields);
                // A datagram may have no head and no tail.
                let is_bare = stream.head.is_empty() && stream.tail.is_empty();
                let carrier = if is_bare { Carrier::Whole } else { Carrier::Stream };
                add(part, carrier, &frame, &stream.fields)?;
            }
        }
        SimParts::Can { input, output } => {
            for (part, frames) in [(Direction::Input, input), (Direction::Output, output)] {
                for can in frames {
                    let frame = named(Some(can.id), (&[], &[]), &can.fields);
                    add(part, Carrier::Can, &frame, &can.fields)?;
                }
            }
        }
    }
    Ok(formats)
}

impl Format {
    fn new(
        frame: &NamedFrame,
        role: Role,
        direction: Direction,
        carrier: Carrier,
        ends: FrameEnds,
    ) -> Result<Self, LayoutError> {
        let is_bare = frame.head.is_empty() && frame.tail.is_empty();
        let carrier = match carrier {
            // A recipe for datagrams.
            Carrier::Stream if is_bare && ends == FrameEnds::default() => Carrier::Whole,
            Carrier::Stream if ends.boundary != Boundary::Fields || ends.escape.is_some() => Carrier::Whole,
            other => other,
        };
        let laid_out = frame.lay_out(carrier, direction)?;
        let mut places = Vec::new();
        laid_out.layout.parts(&laid_out.elements, |part, place| {
            if !matches!(part, proto_core::device::Part::Head | proto_core::device::Part::Tail) {
                places.push(place);
            }
        });
        let mut element = 0..;
        let fields = frame.fields.iter().zip(places).map(|(field, place)| {
            let is_element = field.spec.element().is_some();
            let element = if is_element { element.next() } else { None };
            FrameField { field: field.clone(), system: None, place, element }
        });
        Ok(Self {
            role,
            direction,
            id: frame.id,
            ends,
            every: None,
            is_remote: false,
            delimiters: (frame.head.clone(), frame.tail.clone()),
            fields: fields.collect(),
            frame: laid_out,
        })
    }

    /// The fields that have a value and a name, each once, with its element.
    pub fn named_values(&self) -> impl Iterator<Item = (&FrameField, &Element)> {
        self.fields.iter().filter(|field| !field.field.repeats && !field.name().is_empty()).filter_map(
            |field| {
                let element = self.frame.elements.get(field.element?)?;
                let has_value = !matches!(element, Element::Padding { .. });
                has_value.then_some((field, element))
            },
        )
    }
}
