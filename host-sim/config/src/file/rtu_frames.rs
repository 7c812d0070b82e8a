//! Whole frames of Modbus RTU around registers and coils, for tools that show frames.
//!
//! In: an operation and the fields of its data. Out: its request, reply and refusal, with address, function, counts and
//! CRC.

use proto_core::config::{FieldSpec, InputBinding};
use proto_core::device::{Algorithm, ByteOrder, Checksum, Encoding};
use proto_core::modbus::rtu::{BROADCAST, Operation};
use proto_core::wire::scalar::ScalarType;

use crate::device::{DeviceField, NamedFrame};

/// The frames of one exchange: request, reply and refusal. A broadcast has no reply.
pub(super) fn frames(
    slave: u8,
    operation: &Operation,
    written: &[DeviceField],
    read: &[DeviceField],
) -> [Option<NamedFrame>; 3] {
    let mut frame = FrameBuilder::new(slave, operation.function());
    let request = frame.clone().request(operation, written).seal();
    if slave == BROADCAST {
        return [Some(request), None, None];
    }
    let reply = match operation {
        _ if operation.is_repeated_by_reply() => frame.clone().request(operation, written),
        Operation::WriteCoils { address, count } | Operation::WriteRegisters { address, count } => {
            frame.clone().words(&[("address", *address), ("count", *count)])
        }
        _ => frame.clone().data(operation.read_len(), read),
    };
    let refusal = {
        frame = FrameBuilder::new(slave, operation.function() | 0x80);
        let spec = FieldSpec::UserInput { ty: ScalarType::Byte, to: InputBinding::Unused };
        frame.push("code", spec);
        frame
    };
    [Some(request), Some(reply.seal()), Some(refusal.seal())]
}

/// A frame under construction.
#[derive(Clone)]
struct FrameBuilder(Vec<DeviceField>);

impl FrameBuilder {
    fn new(slave: u8, function: u8) -> Self {
        let mut frame = Self(Vec::new());
        frame.byte("slave", slave);
        frame.byte("function", function);
        frame
    }

    fn push(&mut self, name: &str, spec: FieldSpec) {
        self.0.push(DeviceField::new(name.to_owned(), spec));
    }

    fn byte(&mut self, name: &str, value: u8) {
        let encoding = Encoding::scalar(ScalarType::Byte);
        self.push(name, FieldSpec::Fixed { encoding, value: i64::from(value) });
    }

    fn words(mut self, words: &[(&str, u16)]) -> Self {
        let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(ScalarType::Word) };
        for (name, value) in words {
            self.push(name, FieldSpec::Fixed { encoding, value: i64::from(*value) });
        }
        self
    }

    /// The part of a request after the function.
    fn request(self, operation: &Operation, written: &[DeviceField]) -> Self {
        match *operation {
            Operation::WriteCoil { address } => {
                let coils: Vec<_> =
                    written.iter().map(|field| DeviceField { is_coil: true, ..field.clone() }).collect();
                let mut frame = self.words(&[("address", address)]).fields(&coils);
                frame.byte("", 0);
                frame
            }
            Operation::MaskWriteRegister { address, mask } => {
                self.words(&[("address", address), ("keep", !mask)]).fields(written)
            }
            Operation::WriteRegister { address } => self.words(&[("address", address)]).fields(written),
            Operation::WriteCoils { address, count } | Operation::WriteRegisters { address, count } => {
                self.words(&[("address", address), ("count", count)]).data(operation.written_len(), written)
            }
            Operation::ReadWriteRegisters { read_address, read_count, write_address, write_count } => self
                .words(&[
                    ("address", read_address),
                    ("count", read_count),
                    ("write-address", write_address),
                    ("write-count", write_count),
                ])
                .data(operation.written_len(), written),
            _ => {
                let (_, address, count) = operation.place();
                self.words(&[("address", address), ("count", count)])
            }
        }
    }

    fn fields(mut self, fields: &[DeviceField]) -> Self {
        self.0.extend_from_slice(fields);
        self
    }

    /// The number of bytes, and the fields.
    fn data(mut self, len: usize, fields: &[DeviceField]) -> Self {
        // The limits of the counts allow at most 250.
        self.byte("bytes", len as u8);
        self.fields(fields)
    }

    fn seal(mut self) -> NamedFrame {
        if let Some(algorithm) = Algorithm::named("crc16-modbus") {
            self.push("", FieldSpec::Checksum(Checksum::standard(algorithm)));
        }
        NamedFrame { id: None, head: Vec::new(), tail: Vec::new(), fields: self.0, name: None, after: None }
    }
}
