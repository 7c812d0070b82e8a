//! Sources of output fields besides system variables: the controller's state packet, and the health of ports.
//!
//! In: names such as `controller.joint_position[1]`. Out: the row and item in the packet's table, which has offset and
//! type.

use core::fmt;

use crate::sysvar::SysVar;
use crate::wire::dialect::Dialect;
use crate::wire::scalar::ScalarType;
use crate::wire::state::{Content, FIELDS, FieldPlace};

/// A value of the controller's state packet: a row of [`FIELDS`] and its item, or the global speed, which only some
/// dialects have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StateValue {
    /// Index of the row in [`FIELDS`].
    pub row: u8,
    /// Index of the item in the row, from 0.
    pub item: u8,
}

/// Why a name, or a row and item, is not a value of the state packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum StateValueError {
    /// No row has this name.
    Unknown,
    /// The row is reserved: its content has no meaning.
    Reserved,
    /// The row has several items, but the name has no item number.
    NeedsItem {
        /// Number of items.
        items: u8,
    },
    /// The row has no such item.
    NoSuchItem {
        /// Number of items.
        items: u8,
    },
    /// The row has only one item, but the name has an item number.
    OneItem,
    /// The controller does not send the global speed in this dialect.
    NoSpeed,
}

impl fmt::Display for StateValueError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown => {
                f.write_str("the state packet has no such value; allowed: mode, speed")?;
                let rows = FIELDS.iter().filter(|place| place.content != Content::Reserved);
                for place in rows.filter(|place| place.name != MODE_ROW) {
                    write!(f, ", {}", place.name)?;
                    let items = items_of(place);
                    if items > 1 {
                        write!(f, "[1..{items}]")?;
                    }
                }
                Ok(())
            }
            Self::Reserved => f.write_str("reserved in the state packet: it has no meaning"),
            Self::NeedsItem { items } => {
                write!(f, "which of them is missing, such as [1]; allowed: [1]..[{items}]")
            }
            Self::NoSuchItem { items } => write!(f, "there is no such item; allowed: [1]..[{items}]"),
            Self::OneItem => f.write_str("there is only one, so no number in brackets is allowed"),
            Self::NoSpeed => f.write_str("the controller of this dialect does not send its speed"),
        }
    }
}

impl core::error::Error for StateValueError {}

/// The row with the name `mode` in files.
const MODE_ROW: &str = "operation_mode";

/// Number of items that are not reserved; the 7th of every joint field is.
fn items_of(place: &FieldPlace) -> u8 {
    match place.content {
        Content::Bools { real } => real,
        Content::Values if place.count == 7 => 6,
        Content::Values => place.count as u8,
        Content::Reserved => 0,
    }
}

impl StateValue {
    /// The global speed in percent, which is in a reserved row.
    pub const SPEED: Self = Self { row: u8::MAX, item: 0 };

    /// The value with this name, without `controller.`: `mode`, `speed`, or a row of the packet's table, with the item
    /// counted from 1 if there are several: `joint_position[1]`.
    ///
    /// # Errors
    /// [`StateValueError`], with the reason.
    pub fn parse(name: &str) -> Result<Self, StateValueError> {
        let (name, number) = match name.strip_suffix(']').and_then(|name| name.split_once('[')) {
            Some((name, number)) => (name, Some(number)),
            None => (name, None),
        };
        let name = if name == "mode" { MODE_ROW } else { name };
        if name == "speed" {
            return if number.is_none() { Ok(Self::SPEED) } else { Err(StateValueError::OneItem) };
        }
        let named = (0..).zip(FIELDS).find(|(_, place)| place.name == name);
        let (row, place) = named.ok_or(StateValueError::Unknown)?;
        let items = items_of(place);
        let item = match (number, items) {
            (_, 0) => return Err(StateValueError::Reserved),
            (None, 1) => 0,
            (Some(_), 1) => return Err(StateValueError::OneItem),
            (None, _) => return Err(StateValueError::NeedsItem { items }),
            (Some(number), _) => {
                let number = number.parse::<u8>().ok().and_then(|number| number.checked_sub(1));
                number.filter(|&item| item < items).ok_or(StateValueError::NoSuchItem { items })?
            }
        };
        Ok(Self { row, item })
    }

    /// Offset in the packet, and type.
    ///
    /// # Errors
    /// [`StateValueError`] if the row or item does not exist, or not in this dialect.
    pub fn place(self, dialect: &Dialect) -> Result<(u16, ScalarType), StateValueError> {
        if self == Self::SPEED {
            let offset = dialect.global_speed.ok_or(StateValueError::NoSpeed)?;
            return Ok((offset, ScalarType::Byte));
        }
        let place = FIELDS.get(usize::from(self.row)).ok_or(StateValueError::Unknown)?;
        let items = items_of(place);
        if items == 0 {
            return Err(StateValueError::Reserved);
        }
        if self.item >= items {
            return Err(StateValueError::NoSuchItem { items });
        }
        let before = u16::from(self.item).saturating_mul(place.ty.size() as u16);
        Ok((place.offset.saturating_add(before), place.ty))
    }
}

/// The name in files: `controller.mode`, `controller.joint_position[1]`.
impl fmt::Display for StateValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::SPEED {
            return f.write_str("controller.speed");
        }
        let Some(place) = FIELDS.get(usize::from(self.row)) else {
            return write!(f, "controller, row {}", self.row);
        };
        let name = if place.name == MODE_ROW { "mode" } else { place.name };
        match items_of(place) {
            0 | 1 => write!(f, "controller.{name}"),
            _ => write!(f, "controller.{name}[{}]", u16::from(self.item).saturating_add(1)),
        }
    }
}

/// A value of the health of a field port.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum PortValue {
    /// 1 while the device is there and none of its input frames is overdue, otherwise 0.
    Alive,
    /// Number of accepted frames, wrapping.
    Frames,
    /// Age of the newest accepted frame in milliseconds, saturating; the maximum before the first frame.
    Age,
    /// Number of rejected frames, wrapping. CAN frames for other nodes do not count.
    Rejected,
    /// Number of frames with an ignored text, such as `NOREAD`, wrapping.
    Ignored,
}

impl PortValue {
    /// All values, with their names in files.
    pub const NAMES: [(&'static str, Self); 5] = [
        ("alive", Self::Alive),
        ("frames", Self::Frames),
        ("age_ms", Self::Age),
        ("rejected", Self::Rejected),
        ("ignored", Self::Ignored),
    ];

    /// The value with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(own, _)| *own == name).map(|&(_, value)| value)
    }

    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Alive => "alive",
            Self::Frames => "frames",
            Self::Age => "age_ms",
            Self::Rejected => "rejected",
            Self::Ignored => "ignored",
        }
    }

    /// Whether it is a count, which wraps in its field and has no scale.
    pub const fn is_count(self) -> bool {
        matches!(self, Self::Frames | Self::Rejected | Self::Ignored)
    }
}

/// A link to the controller whose state an output field shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum LinkSource {
    /// To the command port.
    Command,
    /// The second connection to the command port, for commands that stop the robot.
    Urgent,
    /// To the state stream.
    State,
    /// To the Modbus server.
    Modbus,
    /// To the UDP server of recipes.
    RecipeUdp,
    /// The controller's client that connects to the listening port with this index.
    Listening(u8),
}

impl LinkSource {
    /// The links that are not ports, with their names in files and in statistics.
    pub const NAMES: [(&'static str, Self); 5] = [
        ("command", Self::Command),
        ("urgent", Self::Urgent),
        ("state", Self::State),
        ("modbus", Self::Modbus),
        ("udp2011", Self::RecipeUdp),
    ];

    /// The link with this name; `None` if only a port can have the name.
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(own, _)| *own == name).map(|&(_, link)| link)
    }

    /// The name in files; `None` for a listening port, which has a name of its own.
    pub fn name(self) -> Option<&'static str> {
        Self::NAMES.iter().find(|(_, link)| *link == self).map(|&(name, _)| name)
    }
}

/// The variables that report the health of a port to the robot. The port owns them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PortHealth {
    /// Gets [`PortValue::Alive`].
    pub alive: Option<SysVar>,
    /// Gets [`PortValue::Frames`].
    pub frames: Option<SysVar>,
    /// Gets [`PortValue::Age`].
    pub age: Option<SysVar>,
    /// Gets [`PortValue::Rejected`].
    pub rejected: Option<SysVar>,
    /// Gets [`PortValue::Ignored`].
    pub ignored: Option<SysVar>,
}

impl PortHealth {
    /// No variable.
    pub const NONE: Self = Self { alive: None, frames: None, age: None, rejected: None, ignored: None };

    /// The variables, each with its value.
    pub fn iter(&self) -> impl Iterator<Item = (PortValue, SysVar)> + use<> {
        let Self { alive, frames, age, rejected, ignored } = *self;
        let all = [
            (PortValue::Alive, alive),
            (PortValue::Frames, frames),
            (PortValue::Age, age),
            (PortValue::Rejected, rejected),
            (PortValue::Ignored, ignored),
        ];
        all.into_iter().filter_map(|(value, var)| Some((value, var?)))
    }

    /// Sets the variable that gets this value.
    pub const fn set(&mut self, value: PortValue, var: SysVar) {
        match value {
            PortValue::Alive => self.alive = Some(var),
            PortValue::Frames => self.frames = Some(var),
            PortValue::Age => self.age = Some(var),
            PortValue::Rejected => self.rejected = Some(var),
            PortValue::Ignored => self.ignored = Some(var),
        }
    }

    /// Whether a variable can report such a value: words and floats of the registers.
    pub(super) fn can_write(var: SysVar) -> bool {
        matches!(var.group(), "WordInputReg" | "FloatInputReg")
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;
    use crate::wire::state::LEN;

    #[test]
    fn every_row_of_the_packet_has_a_name_unless_it_is_reserved() {
        for (row, place) in (0..).zip(FIELDS) {
            let items = items_of(place);
            let name = |item: u8| match items {
                1 => place.name.to_string(),
                _ => std::format!("{}[{}]", place.name, item + 1),
            };
            if place.content == Content::Reserved {
                assert_eq!(StateValue::parse(place.name), Err(StateValueError::Reserved));
                continue;
            }
            for item in 0..items {
                let value = StateValue::parse(&name(item)).unwrap();
                assert_eq!(value, StateValue { row, item });
                let (offset, ty) = value.place(&Dialect::V2_3).unwrap();
                assert_eq!(offset, place.offset + u16::from(item) * place.ty.size() as u16);
                assert!(ty == place.ty && usize::from(offset) + ty.size() <= LEN);
                let shown = value.to_string();
                let shown = shown.strip_prefix("controller.").unwrap();
                assert_eq!(StateValue::parse(shown), Ok(value));
            }
            let beyond = StateValue { row, item: items };
            assert_eq!(beyond.place(&Dialect::V2_3), Err(StateValueError::NoSuchItem { items }));
        }
    }

    #[test]
    fn names_are_refused_with_what_is_allowed() {
        use StateValueError::*;
        let refused = |name| StateValue::parse(name).unwrap_err();
        assert_eq!(refused("joint_position"), NeedsItem { items: 6 });
        assert_eq!(refused("joint_position[7]"), NoSuchItem { items: 6 });
        assert_eq!(refused("joint_position[0]"), NoSuchItem { items: 6 });
        assert_eq!(refused("joint_position[one]"), NoSuchItem { items: 6 });
        assert_eq!(refused("digital_inputs[17]"), NoSuchItem { items: 16 });
        assert_eq!(refused("mode[1]"), OneItem);
        assert_eq!(refused("speed[1]"), OneItem);
        assert_eq!(refused("temperature"), Unknown);
        assert!(Unknown.to_string().contains("tcp_pose[1..6]"));
        assert_eq!(StateValue::parse("mode"), StateValue::parse("operation_mode"));
        assert_eq!(StateValue { row: 99, item: 0 }.place(&Dialect::V2_3), Err(Unknown));
    }

    #[test]
    fn the_speed_is_where_the_dialect_has_it() {
        let speed = StateValue::parse("speed").unwrap();
        assert_eq!(speed.place(&Dialect::V2_3), Err(StateValueError::NoSpeed));
        let later = Dialect::NAMES.iter().filter_map(|name| Dialect::named(name));
        let places: std::vec::Vec<_> = later.filter_map(|dialect| speed.place(&dialect).ok()).collect();
        assert_eq!(places.first(), Some(&(660, ScalarType::Byte)));
    }

    #[test]
    fn health_has_a_name_for_each_value() {
        for (name, value) in PortValue::NAMES {
            assert_eq!((PortValue::named(name), value.name()), (Some(value), name));
        }
    }
}
