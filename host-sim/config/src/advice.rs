//! Warnings about valid configurations that are often mistakes, where only the file shows them.
//!
//! In: the recipes of a gateway file as frames. Out: sentences, each with the key it is about.

use proto_core::config::{FieldSpec, InputRule, OutputBinding};
use proto_core::device::Carrier;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use crate::device::{DeviceField, DeviceRecipe, NamedExchange, NamedFrame};

/// Output frames that look like commands, such as a control word, and are sent before values of the same device: a
/// drive then starts with the target of the previous cycle. `after` in either frame says that the order is intended.
pub fn orders_before_values(recipes: &[Option<DeviceRecipe>]) -> Vec<(Vec<String>, String)> {
    let advice = |recipe: &DeviceRecipe| {
        let frames = if recipe.carrier == Carrier::Can { &recipe.output[..] } else { &[] };
        let told = (1..).zip(frames).filter_map(|(behind, order)| {
            let frames = frames.get(behind..)?;
            let value = frames.iter().find(|value| is_early(order, value))?;
            Some((["recipe", &recipe.name].map(str::to_owned).to_vec(), early(&recipe.name, order, value)))
        });
        told.collect::<Vec<_>>()
    };
    recipes.iter().flatten().flat_map(advice).collect()
}

/// Whether `order` starts a motion with values of the frame `value`, which is sent after it.
fn is_early(order: &NamedFrame, value: &NamedFrame) -> bool {
    let nodes = (node(order), node(value));
    let is_of_one_device = !matches!(nodes, (Some((_, order)), Some((_, value))) if order != value);
    let is_first_of_node = matches!(nodes, (Some((1, order)), Some((2.., value))) if order == value);
    let is_order = is_first_of_node || order_in(order).is_some();
    let is_value = value_in(value).is_some() && (is_first_of_node || order_in(value).is_none());
    let is_meant = order.after.is_some() || value.after.is_some();
    is_of_one_device && is_order && is_value && !is_meant && value_in(order).is_some()
}

fn early(recipe: &str, order: &NamedFrame, value: &NamedFrame) -> String {
    let id = |frame: &NamedFrame| match frame.id {
        Some(CanId::Standard(id)) => format!("{id:#05X}"),
        Some(CanId::Extended(id)) => format!("{id:#010X}"),
        None => String::new(),
    };
    let (first, second) = (id(order), id(value));
    let started = order_in(order).or(value_in(order)).unwrap_or_default();
    let late = value_in(value).unwrap_or_default();
    let name = value.name.as_deref().unwrap_or(late);
    let named =
        if value.name.is_some() { String::new() } else { format!("name = {name:?} at {second} and ") };
    format!(
        "recipe {recipe:?}: frame {first} with {started:?} is sent before frame {second} with {late:?}, so a device can \
         start with the value of the cycle before; write {named}after = {name:?} at {first}, or an after at {second} if \
         this order is meant"
    )
}

/// The PDO number and the node of a CANopen frame.
fn node(frame: &NamedFrame) -> Option<(u16, u16)> {
    match frame.id {
        Some(CanId::Standard(id @ 0x201..=0x57F)) if id & 0x7F != 0 && id & 0x80 == 0 => {
            Some(((id >> 8).saturating_sub(1), id & 0x7F))
        }
        _ => None,
    }
}

/// The first varying field whose name sounds like a command.
fn order_in(frame: &NamedFrame) -> Option<&str> {
    let sounds = |name: &str| {
        let name = name.to_ascii_lowercase();
        ORDERS.iter().any(|word| name.contains(word))
    };
    varying(frame).find(|name| sounds(name))
}

/// The first varying field.
fn value_in(frame: &NamedFrame) -> Option<&str> {
    varying(frame).next()
}

/// The names of the fields whose values come from variables.
fn varying(frame: &NamedFrame) -> impl Iterator<Item = &str> {
    let is_varying = |field: &&DeviceField| match field.spec {
        FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. } => {
            matches!(from, OutputBinding::Variable { .. } | OutputBinding::Bit { .. })
        }
        _ => false,
    };
    frame.fields.iter().filter(is_varying).map(|field| field.name.as_str())
}

/// Parts of names that sound like commands.
const ORDERS: [&str; 6] = ["control", "command", "cmd", "start", "trigger", "enable"];

/// Fields that can be negative and write a variable that cannot, without `offset`: a negative number is rejected. An
/// explicit `offset = 0` says that this is known.
pub fn negative_numbers(recipes: &[Option<DeviceRecipe>]) -> Vec<(Vec<String>, String)> {
    let advice = |recipe: &DeviceRecipe| {
        let parts = recipe.input.iter().map(|frame| &frame.fields);
        let fields_of = |frame: &Option<NamedFrame>| frame.as_ref().map(|frame| frame.fields.clone());
        let exchanged = recipe.exchanges.iter().flat_map(|exchange| {
            let NamedExchange { request, reply, pending, refusal, .. } = exchange;
            [request, reply, pending, refusal].map(fields_of).into_iter().flatten()
        });
        let fields = parts.cloned().chain(exchanged).flatten();
        let told = fields.filter_map(|field| of_field(&recipe.name, &field));
        told.map(|said| (["recipe", &recipe.name].map(str::to_owned).to_vec(), said)).collect::<Vec<_>>()
    };
    recipes.iter().flatten().flat_map(advice).collect()
}

fn of_field(recipe: &str, field: &DeviceField) -> Option<String> {
    let var = field.spec.rejects_negative().filter(|_| !field.has_offset)?;
    let has_rule = field.sendable.iter().any(|rule| match rule {
        FieldSpec::InputRule(InputRule::Int16) | FieldSpec::Mapped(_) => true,
        FieldSpec::Limits(limits) => limits.low >= 0.0,
        _ => false,
    });
    if has_rule {
        return None;
    }
    let (least, most) = var.ty().range();
    Some(format!(
        "recipe {recipe:?}, field {:?}: {var} takes {least}..={most}, so a negative number is rejected; write {}an offset, \
         or offset = 0 if there is none",
        field.name,
        if var.ty() == ScalarType::Word { "as = \"int16\", " } else { "" }
    ))
}
