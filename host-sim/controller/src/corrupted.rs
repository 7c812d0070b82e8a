//! A fault for tests: sends other values of floats, such as NaN, in state packets and in frames of recipes' output
//! parts. The item itself keeps its value.

use proto_core::sysvar::{IMAGE_BYTES, SysVar};
use proto_core::wire::scalar::ScalarType;
use proto_core::wire::state::{FIELDS, LEN};

use recipe_config::{AnalogInput, InitialTarget};

/// The items, and the values sent instead.
#[derive(Debug, Clone, Default)]
pub(super) struct Corrupted(Vec<Instead>);

#[derive(Debug, Clone)]
struct Instead {
    name: String,
    item: SentItem,
    value: f32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct SentItem {
    /// Its offset in the process image, and so in recipes' frames.
    image: Option<usize>,
    packet: Option<usize>,
}

/// There is no float of this name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NoSuchFloat(pub String);

impl std::fmt::Display for NoSuchFloat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = &self.0;
        write!(
            f,
            "{name} is not a float; choose a system variable, an analog input, or an item of the state packet"
        )
    }
}

impl std::error::Error for NoSuchFloat {}

impl Corrupted {
    /// Sends `instead` for the item of this name from now on.
    pub(super) fn corrupt(&mut self, name: &str, instead: f32) -> Result<(), NoSuchFloat> {
        let item = find(name)?;
        self.0.retain(|other| other.item != item);
        self.0.push(Instead { name: name.to_owned(), item, value: instead });
        Ok(())
    }

    /// Sends the item's own value again.
    pub(super) fn heal(&mut self, name: &str) -> Result<(), NoSuchFloat> {
        let item = find(name)?;
        self.0.retain(|other| other.item != item);
        Ok(())
    }

    pub(super) fn items(&self) -> impl Iterator<Item = (&str, f32)> {
        self.0.iter().map(|instead| (instead.name.as_str(), instead.value))
    }

    /// The process image for recipes' frames; `None` if it is unchanged.
    pub(super) fn image(&self, image: &[u8; IMAGE_BYTES]) -> Option<[u8; IMAGE_BYTES]> {
        if self.0.is_empty() {
            return None;
        }
        let mut shown = *image;
        self.put(&mut shown, |item| item.image);
        Some(shown)
    }

    pub(super) fn put_in_packet(&self, packet: &mut [u8; LEN]) {
        self.put(packet, |item| item.packet);
    }

    fn put(&self, bytes: &mut [u8], place: impl Fn(SentItem) -> Option<usize>) {
        for instead in &self.0 {
            let bytes = place(instead.item).and_then(|offset| bytes.get_mut(offset..offset + 4));
            if let Some(bytes) = bytes {
                bytes.copy_from_slice(&instead.value.to_le_bytes());
            }
        }
    }
}

/// A system variable, an analog input, or `FIELD[N]` of the packet with N from 1.
fn find(name: &str) -> Result<SentItem, NoSuchFloat> {
    let wrong = || NoSuchFloat(name.to_owned());
    match name.parse() {
        Ok(InitialTarget::Var(var)) if var.ty() == ScalarType::Float => return Ok(variable(var)),
        Ok(InitialTarget::Analog { group, index }) => {
            let (field, before) = match group {
                AnalogInput::CabinetCurrent => ("analog_inputs", 0),
                AnalogInput::CabinetVoltage => ("analog_inputs", AnalogInput::CabinetCurrent.count()),
                AnalogInput::Tool => ("tool_analog_inputs", 0),
            };
            return in_packet(field, usize::from(before + index)).ok_or_else(wrong);
        }
        _ => {}
    }
    let field = name.strip_suffix(']').and_then(|name| name.split_once('['));
    let item = field.and_then(|(field, index)| in_packet(field, index.parse().ok()?));
    item.ok_or_else(wrong)
}

fn variable(var: SysVar) -> SentItem {
    let packet = var.stream().map(|place| usize::from(place.offset));
    SentItem { image: Some(var.image_offset()), packet }
}

fn in_packet(field: &str, index: usize) -> Option<SentItem> {
    let field = FIELDS.iter().find(|place| place.name == field && place.ty == ScalarType::Float)?;
    let nth = index.checked_sub(1).filter(|&nth| nth < usize::from(field.count))?;
    Some(SentItem { image: None, packet: Some(usize::from(field.offset) + 4 * nth) })
}
