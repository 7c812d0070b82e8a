//! A frame of the configuration: its fields, and the variables that they write or send.

use proto_core::config::{FieldSpec, InputBinding, InputRule, OutputBinding, Words};
use proto_core::sysvar::SysVar;
use proto_core::wire::can::CanId;

use super::device::{DeviceSpec, varies};

/// A value as it is on the wire; unused bytes are 0.
pub(super) type Raw = [u8; 4];

/// One frame on the field side or on a recipe link.
#[derive(Debug, Clone, Default)]
pub(super) struct Frame {
    pub head: Vec<u8>,
    pub tail: Vec<u8>,
    pub id: Option<CanId>,
    pub fields: Vec<FieldSpec>,
    /// The variables that the fields write, and those that they send.
    pub written: Vec<SysVar>,
    pub shown: Vec<SysVar>,
    /// Number of bytes of all fields, including the checksum.
    pub payload: usize,
    /// The places of the fields in a device's own frame.
    pub device: Option<DeviceSpec>,
    /// The places of the fields vary from frame to frame.
    pub varies: bool,
}

impl Frame {
    pub(super) fn len(&self) -> usize {
        self.head.len() + self.payload + self.tail.len()
    }

    pub(super) fn has(&self, var: SysVar) -> bool {
        self.written.contains(&var)
    }

    pub(super) fn shows(&self, var: SysVar) -> bool {
        self.shown.contains(&var)
    }

    /// The bytes of the fields; `None` if head, tail or length differ.
    pub(super) fn payload_of<'b>(&self, bytes: &'b [u8]) -> Option<&'b [u8]> {
        let rest = bytes.strip_prefix(self.head.as_slice())?.strip_suffix(self.tail.as_slice())?;
        (self.varies || rest.len() == self.payload).then_some(rest)
    }
}

/// The variables that an input field writes: one variable, or those of a text.
pub(super) fn written(field: &FieldSpec) -> impl Iterator<Item = SysVar> + use<> {
    let (words, others) = match *field {
        FieldSpec::System(var)
        | FieldSpec::UserInput { to: InputBinding::Variable { var, .. }, .. }
        | FieldSpec::DeviceInput { to: InputBinding::Variable { var, .. }, .. } => (None, [Some(var), None]),
        FieldSpec::TextInput { to, length_to, count_to, .. } => (to, [length_to, count_to]),
        FieldSpec::InputRule(InputRule::ValidTo { var, bit: None }) => (None, [Some(var), None]),
        FieldSpec::UserInput { .. }
        | FieldSpec::UserOutput { .. }
        | FieldSpec::DeviceInput { .. }
        | FieldSpec::DeviceOutput { .. }
        | FieldSpec::Fixed { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::Checksum(_)
        | FieldSpec::TextOutput { .. }
        | FieldSpec::Length(_)
        | FieldSpec::Limits(_)
        | FieldSpec::Mapped(_)
        | FieldSpec::InputRule(_) => (None, [None, None]),
    };
    words.into_iter().flat_map(Words::iter).chain(others.into_iter().flatten())
}

/// The variables that an output field sends.
pub(super) fn shown(field: &FieldSpec) -> impl Iterator<Item = SysVar> + use<> {
    let (words, other) = match *field {
        FieldSpec::System(var) => (None, Some(var)),
        FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. } => match from {
            OutputBinding::Variable { var, .. } | OutputBinding::Bit { var, .. } => (None, Some(var)),
            OutputBinding::Constant(_)
            | OutputBinding::Counter
            | OutputBinding::CounterTo { .. }
            | OutputBinding::Reply
            | OutputBinding::State { .. }
            | OutputBinding::Port { .. }
            | OutputBinding::Link { .. } => (None, None),
        },
        FieldSpec::TextOutput { from, length_from, .. } => (Some(from), length_from),
        FieldSpec::UserInput { .. }
        | FieldSpec::DeviceInput { .. }
        | FieldSpec::Fixed { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::Checksum(_)
        | FieldSpec::TextInput { .. }
        | FieldSpec::Length(_)
        | FieldSpec::Limits(_)
        | FieldSpec::Mapped(_)
        | FieldSpec::InputRule(_) => (None, None),
    };
    words.into_iter().flat_map(Words::iter).chain(other)
}

/// The size of a field in a plain recipe.
pub(super) fn size(field: &FieldSpec) -> usize {
    match field {
        FieldSpec::System(var) => var.size(),
        FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => ty.size(),
        _ => 0,
    }
}

pub(super) fn frame(head: &[u8], tail: &[u8], id: Option<CanId>, fields: &[FieldSpec]) -> Frame {
    if fields.iter().any(FieldSpec::is_device) {
        return device_frame(head, tail, id, fields);
    }
    let payload = fields.iter().map(size).sum();
    Frame { payload, ..any_frame(head, tail, id, fields) }
}

/// A frame of a device's recipe, even if a plain recipe could describe it.
pub(super) fn device_frame(head: &[u8], tail: &[u8], id: Option<CanId>, fields: &[FieldSpec]) -> Frame {
    let varies = fields.iter().any(varies);
    let device = if varies { DeviceSpec::default() } else { DeviceSpec::new(head.len(), fields) };
    Frame { payload: device.len, device: Some(device), varies, ..any_frame(head, tail, id, fields) }
}

fn any_frame(head: &[u8], tail: &[u8], id: Option<CanId>, fields: &[FieldSpec]) -> Frame {
    Frame {
        head: head.to_vec(),
        tail: tail.to_vec(),
        id,
        fields: fields.to_vec(),
        written: fields.iter().flat_map(written).collect(),
        shown: fields.iter().flat_map(shown).collect(),
        ..Frame::default()
    }
}
