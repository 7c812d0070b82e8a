//! A compiled part of a recipe, with the names and units of its fields.
//!
//! In: recipes from a file. Out: frames from values and values from frames.

use proto_core::config::FieldSpec;
use proto_core::recipe::model::{Field, Framing, Rules};
use proto_core::recipe::{CanLayout, StreamLayout};
use proto_core::sysvar::Direction;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

use recipe_config::{AnyRecipe, DeviceRecipe, NamedExchange, NamedFrame, SimField, SimParts, SimRecipe};
use recipe_export::unit_of;

use super::device::DevicePart;

/// A compiled part.
#[derive(Debug)]
pub(in super::super) struct CompiledPart {
    pub(in super::super) layout: Layout,
    /// One for a stream part, one per id for a CAN part.
    pub(in super::super) frames: Vec<FrameValues>,
    /// The recipe and the part of it, for a recipe as the controller has it.
    plain: Option<(String, Direction)>,
}

#[derive(Debug)]
pub(in super::super) enum Layout {
    /// Frames in a stream of bytes.
    Stream(Box<StreamLayout>),
    /// One frame per datagram, without head and tail.
    Datagram(Box<StreamLayout>),
    Can(Box<CanLayout>),
    /// Frames of a device, on a stream or on CAN.
    Device(Box<DevicePart>),
}

/// The fields of one frame.
#[derive(Debug)]
pub(in super::super) struct FrameValues {
    pub(in super::super) id: Option<CanId>,
    pub(in super::super) fields: Vec<NamedField>,
}

#[derive(Debug)]
pub(in super::super) struct NamedField {
    pub(in super::super) name: String,
    pub(in super::super) ty: ScalarType,
    pub(in super::super) unit: &'static str,
    /// What a gateway does with its value, in a gateway file.
    pub(in super::super) spec: Option<FieldSpec>,
}

impl CompiledPart {
    /// Chooses the recipe called `name`, or the only one, and its part, or the only one.
    pub(in super::super) fn choose(
        recipes: &[AnyRecipe],
        name: Option<&str>,
        part: Option<Direction>,
    ) -> Result<Self, String> {
        let recipe = choose_recipe(recipes, name)?;
        let has = |part| match recipe {
            AnyRecipe::Plain(recipe) => has_part(recipe, part),
            AnyRecipe::Device(recipe) => !recipe.part(part).is_empty(),
        };
        let name = recipe.name();
        let part = match (part, has(Direction::Input), has(Direction::Output)) {
            (Some(Direction::Input), false, _) => {
                return Err(format!("recipe {name:?} has no input part"));
            }
            (Some(Direction::Output), _, false) => {
                return Err(format!("recipe {name:?} has no output part"));
            }
            (Some(part), _, _) => part,
            (None, false, false) => return Self::choose_exchange(recipes, Some(name), None, None),
            (None, true, false) => Direction::Input,
            (None, false, _) => Direction::Output,
            (None, true, true) => {
                return Err(format!(
                    "recipe {name:?} has both parts; choose one: --part input (user to robot) or --part output (robot to user)"
                ));
            }
        };
        match recipe {
            AnyRecipe::Plain(recipe) => Self::compile(recipe, part),
            AnyRecipe::Device(recipe) => Self::lay_out(recipe, part),
        }
    }

    /// Chooses a frame of an exchange, or the only one.
    pub(in super::super) fn choose_exchange(
        recipes: &[AnyRecipe],
        name: Option<&str>,
        number: Option<usize>,
        part: Option<ExchangePart>,
    ) -> Result<Self, String> {
        let recipe = choose_recipe(recipes, name)?;
        let name = recipe.name();
        let exchanges = match recipe {
            AnyRecipe::Device(recipe) => &recipe.exchanges[..],
            AnyRecipe::Plain(_) => &[],
        };
        let exchange = match (number, exchanges) {
            (_, []) => return Err(format!("recipe {name:?} has no exchanges")),
            (None, [only]) => only,
            (None, all) => {
                return Err(format!(
                    "recipe {name:?} has several exchanges; choose one with --exchange N: 1..={}",
                    all.len()
                ));
            }
            (Some(number), all) => number.checked_sub(1).and_then(|nth| all.get(nth)).ok_or_else(|| {
                format!("there is no exchange {number} in recipe {name:?}; allowed: 1..={}", all.len())
            })?,
        };
        let all = [ExchangePart::Request, ExchangePart::Reply, ExchangePart::Pending, ExchangePart::Refusal];
        let there: Vec<_> = all.into_iter().filter(|part| part.of(exchange).is_some()).collect();
        let names = || there.iter().map(|part| part.name()).collect::<Vec<_>>().join(", ");
        let part = match (part, &there[..]) {
            (Some(part), _) => part,
            (None, [only]) => *only,
            (None, _) => {
                return Err(format!("the exchange has several frames; choose one with --part: {}", names()));
            }
        };
        let frame = part
            .of(exchange)
            .ok_or_else(|| format!("the exchange has no {}; there are {}", part.name(), names()))?;
        let device = DevicePart::of_exchange(exchange, frame, part == ExchangePart::Request)?;
        Ok(Self::of_device(device))
    }

    fn lay_out(recipe: &DeviceRecipe, direction: Direction) -> Result<Self, String> {
        DevicePart::new(recipe, direction).map(Self::of_device)
    }

    fn of_device(device: DevicePart) -> Self {
        let frames = device.ids().map(|id| FrameValues { id, fields: Vec::new() }).collect();
        Self { layout: Layout::Device(Box::new(device)), frames, plain: None }
    }

    /// Notes what a gateway does with the values, of the same file's recipes as frames.
    pub(in super::super) fn bind(&mut self, recipes: &[Option<DeviceRecipe>]) {
        let Some((name, direction)) = &self.plain else { return };
        let Some(recipe) = recipes.iter().flatten().find(|recipe| recipe.name == *name) else { return };
        for (frame, bound) in self.frames.iter_mut().zip(recipe.part(*direction)) {
            for (field, bound) in frame.fields.iter_mut().zip(&bound.fields) {
                field.spec = Some(bound.spec);
            }
        }
    }

    /// Whether its only frame is always the same, so that no values are needed.
    pub(in super::super) fn is_constant(&self) -> bool {
        matches!(&self.layout, Layout::Device(device) if device.is_constant())
    }

    fn compile(recipe: &SimRecipe, direction: Direction) -> Result<Self, String> {
        let rules = Rules { mode: recipe.mode, direction };
        // Cannot fail: reading the file compiled the same parts.
        let refused = |error| format!("recipe {:?}: {error}", recipe.name);
        let fields = |fields: &[SimField]| fields.iter().map(|field| field.field).collect::<Vec<_>>();
        match &recipe.parts {
            SimParts::Stream { input, output } => {
                let part = if direction == Direction::Input { input } else { output };
                let Some(part) = part else { return Err("no such part".into()) };
                let compile =
                    |framing| StreamLayout::new(rules, &part.head, &part.tail, fields(&part.fields), framing);
                let layout = if part.head.is_empty() && part.tail.is_empty() {
                    Layout::Datagram(Box::new(compile(Framing::Datagram).map_err(refused)?))
                } else {
                    Layout::Stream(Box::new(compile(Framing::Bytes).map_err(refused)?))
                };
                let frames = vec![FrameValues::new(None, &part.fields)];
                Ok(Self { layout, frames, plain: Some((recipe.name.clone(), direction)) })
            }
            SimParts::Can { input, output } => {
                let frames = if direction == Direction::Input { input } else { output };
                let entries = frames.iter().map(|frame| (frame.id, fields(&frame.fields)));
                let layout = CanLayout::new(rules, entries).map_err(refused)?;
                let frames = frames.iter().map(|frame| FrameValues::new(Some(frame.id), &frame.fields));
                let plain = Some((recipe.name.clone(), direction));
                Ok(Self { layout: Layout::Can(Box::new(layout)), frames: frames.collect(), plain })
            }
        }
    }

    /// Whether frames are CAN frames.
    pub(in super::super) fn is_can(&self) -> bool {
        self.frames.iter().any(|frame| frame.id.is_some())
    }

    /// The bytes of a stream frame or datagram.
    pub(in super::super) fn encode_stream(
        &self,
        layout: &StreamLayout,
        values: &[Scalar],
    ) -> Result<Vec<u8>, String> {
        let mut bytes = vec![0; layout.frame_len()];
        match layout.encode_values(values, &mut bytes) {
            Ok(_) => Ok(bytes),
            Err(error) => Err(error.to_string()),
        }
    }

    /// The CAN frame with this index.
    pub(in super::super) fn encode_can(
        &self,
        layout: &CanLayout,
        index: usize,
        values: &[Scalar],
    ) -> Result<CanFrame, String> {
        let frame = layout.frame(index).ok_or("no such frame")?;
        frame.encode_values(values).map_err(|error| error.to_string())
    }
}

/// The recipe called `name`, or the only one.
fn choose_recipe<'r>(recipes: &'r [AnyRecipe], name: Option<&str>) -> Result<&'r AnyRecipe, String> {
    let names = || recipes.iter().map(|recipe| format!("{:?}", recipe.name())).collect::<Vec<_>>().join(", ");
    match (name, recipes) {
        (_, []) => Err("there is no recipe in this file".into()),
        (None, [only]) => Ok(only),
        (None, _) => Err(format!("several recipes; choose one with --recipe NAME: {}", names())),
        (Some(name), _) => recipes
            .iter()
            .find(|recipe| recipe.name() == name)
            .ok_or_else(|| format!("there is no recipe {name:?}; there are {}", names())),
    }
}

/// A frame of an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) enum ExchangePart {
    Request,
    Reply,
    Pending,
    Refusal,
}

impl ExchangePart {
    fn name(self) -> &'static str {
        match self {
            Self::Request => "request",
            Self::Reply => "reply",
            Self::Pending => "pending",
            Self::Refusal => "refusal",
        }
    }

    fn of(self, exchange: &NamedExchange) -> Option<&NamedFrame> {
        match self {
            Self::Request => exchange.request.as_ref(),
            Self::Reply => exchange.reply.as_ref(),
            Self::Pending => exchange.pending.as_ref(),
            Self::Refusal => exchange.refusal.as_ref(),
        }
    }
}

fn has_part(recipe: &SimRecipe, part: Direction) -> bool {
    match (&recipe.parts, part) {
        (SimParts::Stream { input, .. }, Direction::Input) => input.is_some(),
        (SimParts::Stream { output, .. }, Direction::Output) => output.is_some(),
        (SimParts::Can { input, .. }, Direction::Input) => !input.is_empty(),
        (SimParts::Can { output, .. }, Direction::Output) => !output.is_empty(),
    }
}

impl FrameValues {
    fn new(id: Option<CanId>, fields: &[SimField]) -> Self {
        let named = |field: &SimField| NamedField {
            name: field.name.clone(),
            ty: field.field.ty(),
            unit: match field.field {
                Field::System(var) => unit_of(var),
                Field::User(_) => "",
            },
            spec: None,
        };
        Self { id, fields: fields.iter().map(named).collect() }
    }
}
