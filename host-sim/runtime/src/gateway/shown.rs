//! Inputs and outputs of the engine in a trace: bytes in hexadecimal and CAN frames as candump has them,
//! so that `host-sim decode` takes them.

use std::fmt;

use proto_core::engine::{Input, Output};
use proto_core::wire::can::{CanFrame, CanId};
use recipe_doctor::HexBytes;

/// An input or output for a trace.
pub(super) struct TraceText<T>(pub(super) T);

impl fmt::Display for TraceText<&Input<'_>> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Input::PortBytes { port, bytes } => write!(f, "port {}: {}", port.0, HexBytes(bytes)),
            Input::PortCan { port, frame } => write!(f, "port {}: {}", port.0, TraceText(frame)),
            Input::LinkBytes { link, bytes } => write!(f, "link {}: {}", link.0, HexBytes(bytes)),
            other => write!(f, "{other:?}"),
        }
    }
}

impl fmt::Display for TraceText<&Output<'_>> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Output::PortSend { port, bytes } => write!(f, "port {}: {}", port.0, HexBytes(bytes)),
            Output::PortSendCan { port, frame } => write!(f, "port {}: {}", port.0, TraceText(frame)),
            Output::LinkSend { link, bytes } => write!(f, "link {}: {}", link.0, HexBytes(bytes)),
            other => write!(f, "{other:?}"),
        }
    }
}

impl fmt::Display for TraceText<&CanFrame> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.id() {
            CanId::Standard(id) => write!(f, "{id:03X}#")?,
            CanId::Extended(id) => write!(f, "{id:08X}#")?,
        }
        if self.0.is_remote() {
            return f.write_str("R");
        }
        self.0.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proto_core::engine::{LinkId, PortId};

    #[test]
    fn bytes_and_frames_are_shown_as_decode_takes_them() {
        let port = PortId(1);
        let input = Input::PortBytes { port, bytes: &[0x48, 0xAA, 0] };
        assert_eq!(TraceText(&input).to_string(), "port 1: 48 AA 00");
        let frame = CanFrame::new(CanId::Standard(2), &[0xEF, 0x54]).unwrap();
        assert_eq!(TraceText(&Input::PortCan { port, frame }).to_string(), "port 1: 002#EF54");
        let frame = CanFrame::remote(CanId::Extended(0x1234), 0).unwrap();
        assert_eq!(TraceText(&Output::PortSendCan { port, frame }).to_string(), "port 1: 00001234#R");
        let output = Output::LinkSend { link: LinkId::STATE, bytes: &[10] };
        assert_eq!(TraceText(&output).to_string(), "link 1: 0A");
        assert_eq!(TraceText(&Input::Tick).to_string(), "Tick");
    }
}
