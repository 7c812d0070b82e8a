//! The last part of a run's trace as text.

use proto_core::engine::LinkKind;
use proto_core::modbus::adu;
use proto_core::modbus::pdu::{Request, function};
use proto_core::time::Duration;
use proto_core::wire::state;

use super::Soak;
use crate::{Entry, What};

/// The kept entries of the cell's trace, one per line: seconds since the run's start, kind, port or link, bytes. Modbus
/// frames and commands are also decoded.
pub fn show_trace(soak: &Soak) -> String {
    let mut text = String::new();
    for entry in soak.cell().trace().entries() {
        let after = Duration::from_micros(entry.at.saturating_since(soak.start).as_micros());
        let seconds = format!("{}.{:06}", after.as_micros() / 1_000_000, after.as_micros() % 1_000_000);
        let (subject, shown) = (subject(soak, entry), shown(soak, entry));
        let line = format!("{seconds:>12}  {:<22} {subject:<14} {shown}", what(entry.what));
        text += line.trim_end();
        text.push('\n');
    }
    text
}

fn what(what: What) -> &'static str {
    match what {
        What::LinkOpen => "gateway opens",
        What::LinkClose => "gateway closes",
        What::LinkUp => "link up",
        What::LinkDown => "link down",
        What::LinkSent => "gateway sends up",
        What::LinkReceived => "gateway receives",
        What::ControllerOpened => "controller accepts",
        What::ControllerClosed => "controller loses",
        What::ControllerReceived => "controller receives",
        What::PortSent => "port sends",
        What::PortReceived => "port receives",
        What::ControllerPortSent => "controller port sends",
        What::ControllerPortReceived => "controller port hears",
        What::Fault => "fault",
        What::Remark => "fault",
    }
}

fn subject(soak: &Soak, entry: &Entry) -> String {
    match entry.what {
        What::PortSent | What::PortReceived => {
            let port = soak.cell().gateway().ports.get(entry.subject as usize);
            port.map_or_else(|| entry.subject.to_string(), |port| port.name.as_str().to_owned())
        }
        What::LinkOpen
        | What::LinkClose
        | What::LinkUp
        | What::LinkDown
        | What::LinkSent
        | What::LinkReceived => {
            let kind = link_of(soak, entry);
            kind.map_or_else(|| entry.subject.to_string(), |kind| kind.name().to_owned())
        }
        What::ControllerOpened | What::ControllerClosed | What::ControllerReceived => {
            format!("#{}", entry.subject)
        }
        What::Fault => match entry.subject {
            Entry::CONTROLLER => "controller".to_owned(),
            Entry::GATEWAY => "gateway".to_owned(),
            _ => link_of(soak, entry).map_or("", LinkKind::name).to_owned(),
        },
        What::Remark => String::new(),
        What::ControllerPortSent | What::ControllerPortReceived => entry.subject.to_string(),
    }
}

fn link_of(soak: &Soak, entry: &Entry) -> Option<LinkKind> {
    let mut links = soak.cell().engine().links();
    links.find(|link| u64::from(link.id.0) == entry.subject).map(|link| link.kind)
}

fn shown(soak: &Soak, entry: &Entry) -> String {
    let bytes = &entry.bytes[..];
    let says = match (entry.what, link_of(soak, entry)) {
        (What::Remark | What::Fault, _) => return String::from_utf8_lossy(bytes).into_owned(),
        (What::LinkSent | What::LinkReceived, Some(LinkKind::Command | LinkKind::Urgent)) => {
            return format!("\"{}\"", bytes.escape_ascii());
        }
        (What::LinkSent, Some(LinkKind::Modbus)) => request(bytes),
        (What::LinkReceived, Some(LinkKind::Modbus)) => answer(bytes),
        (What::LinkReceived, Some(LinkKind::State)) if bytes.len() == state::LEN => {
            return "a state packet".to_owned();
        }
        _ => None,
    };
    let hex: Vec<String> = bytes.iter().take(MAX_BYTES).map(|byte| format!("{byte:02X}")).collect();
    let more = if bytes.len() > MAX_BYTES { " ..." } else { "" };
    let says = says.map_or_else(String::new, |says| format!("  {says}"));
    format!("{}{more}{says}", hex.join(" "))
}

/// Decodes a request; `None` if it is incomplete.
fn request(adu: &[u8]) -> Option<String> {
    let (transaction, pdu) = split(adu)?;
    let says = match Request::parse(pdu).ok()? {
        Request::ReadCoils { address, count } => format!("read {count} coils from {address}"),
        Request::ReadHolding { address, count } => format!("read {count} registers from {address}"),
        Request::WriteCoil { address, value } => format!("coil {address} = {}", u8::from(value)),
        Request::WriteRegister { address, value } => format!("register {address} = {value}"),
        Request::WriteCoils { address, coils } => {
            format!("coils from {address} = {}", list(coils.iter().map(u8::from)))
        }
        Request::WriteRegisters { address, registers } => {
            format!("registers from {address} = {}", list(registers.iter()))
        }
    };
    Some(format!("#{transaction}: {says}"))
}

/// Decodes a response; `None` if it is incomplete.
fn answer(adu: &[u8]) -> Option<String> {
    let (transaction, pdu) = split(adu)?;
    let (&code, rest) = pdu.split_first()?;
    Some(match rest {
        [exception] if code & function::EXCEPTION_FLAG != 0 => {
            format!("#{transaction}: exception {exception:02X}")
        }
        _ => format!("#{transaction}: done"),
    })
}

/// Splits an ADU into transaction id and PDU.
fn split(adu: &[u8]) -> Option<(u16, &[u8])> {
    let (head, pdu) = adu.split_first_chunk::<{ adu::HEADER_LEN }>()?;
    let [high, low, ..] = *head;
    let len = usize::from(u16::from_be_bytes([head[4], head[5]]));
    // The length includes the unit id, which is part of the header.
    (len == pdu.len() + 1).then_some((u16::from_be_bytes([high, low]), pdu))
}

fn list<T: ToString>(values: impl Iterator<Item = T>) -> String {
    values.map(|value| value.to_string()).collect::<Vec<_>>().join(" ")
}

const MAX_BYTES: usize = 48;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_and_answers_are_told_in_numbers() {
        let adu = |pdu: &[u8]| [&[0, 7, 0, 0, 0, pdu.len() as u8 + 1, 1], pdu].concat();
        let text = |pdu: &[u8]| request(&adu(pdu));
        assert_eq!(text(&[1, 0, 192, 0, 8]).as_deref(), Some("#7: read 8 coils from 192"));
        assert_eq!(text(&[5, 0, 192, 0xFF, 0]).as_deref(), Some("#7: coil 192 = 1"));
        assert_eq!(text(&[15, 0, 192, 0, 3, 1, 5]).as_deref(), Some("#7: coils from 192 = 1 0 1"));
        let words = [16, 0, 8, 0, 2, 4, 0, 1, 1, 0];
        assert_eq!(text(&words).as_deref(), Some("#7: registers from 8 = 1 256"));
        assert_eq!(request(&adu(&words)[..10]), None, "a piece");
        assert_eq!(answer(&adu(&[0x8F, 4])).as_deref(), Some("#7: exception 04"));
        assert_eq!(answer(&adu(&[15, 0, 192, 0, 3])).as_deref(), Some("#7: done"));
    }
}
