use std::vec::Vec;

use super::*;
use crate::config::GatewayConfig;
use crate::config::image;

const PORT: PortId = PortId(3);
const LINK: LinkId = LinkId(200);
const AT: Instant = Instant::from_micros(1_000_000_300);

/// The maximum length of a host name.
static HOST: &str = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";

fn open(transport: Transport, host: &'static str) -> Output<'static> {
    Output::LinkOpen { link: LINK, to: Endpoint::new(transport, host) }
}

fn entries() -> Vec<Entry<'static>> {
    let data = CanFrame::new(CanId::Standard(0x7FF), &[1, 2, 3]).unwrap();
    let long = CanFrame::new(CanId::Extended(0x1FFF_FFFF), &[]).unwrap();
    let remote = CanFrame::remote(CanId::Extended(1), 8).unwrap();
    let inputs = [
        Input::PortUp { port: PORT },
        Input::PortDown { port: PORT },
        Input::PortBytes { port: PORT, bytes: &[0xA5; 300] },
        Input::PortBytes { port: PORT, bytes: &[] },
        Input::PortCan { port: PORT, frame: data },
        Input::PortCan { port: PORT, frame: long },
        Input::PortCan { port: PORT, frame: remote },
        Input::PortSent { port: PORT },
        Input::PortBus { port: PORT, state: BusState::Active },
        Input::PortBus { port: PORT, state: BusState::Warning },
        Input::PortBus { port: PORT, state: BusState::Passive },
        Input::PortBus { port: PORT, state: BusState::BusOff },
        Input::LinkUp { link: LINK },
        Input::LinkDown { link: LINK },
        Input::LinkBytes { link: LINK, bytes: &[0; 1468] },
        Input::LinkSent { link: LINK },
        Input::LinkAcked { link: LINK, left: u32::MAX },
        Input::Tick,
    ];
    let outputs = [
        Output::Sleep { until: AT },
        Output::Sleep { until: Instant::NEVER },
        Output::Sleep { until: Instant::ZERO },
        Output::PortSend { port: PORT, bytes: &[1, 2, 3] },
        Output::PortSendCan { port: PORT, frame: data },
        open(Transport::Tcp { port: 2000 }, "robot.example"),
        open(Transport::Udp { port: u16::MAX }, "192.168.12.10"),
        open(Transport::TcpListen { local: "0.0.0.0:50000".parse().unwrap() }, ""),
        open(Transport::UdpListen { local: "[fe80::ffff]:65535".parse().unwrap() }, HOST),
        Output::LinkClose { link: LINK },
        Output::LinkSend { link: LINK, bytes: &[0xFF; 128] },
    ];
    let mut entries = std::vec![Entry::Start { image: &[7; 200] }, Entry::Totals(&[0; 127]), Entry::MakeSafe];
    entries.extend(inputs.into_iter().map(|input| Entry::Input { at: AT, input }));
    entries.extend(outputs.into_iter().map(Entry::Output));
    entries
}

fn encoded(entries: &[Entry<'_>]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for entry in entries {
        entry.encode(|piece| bytes.extend_from_slice(piece));
    }
    bytes
}

fn text(entry: &Entry<'_>) -> std::string::String {
    std::format!("{entry:?}")
}

#[test]
fn every_entry_is_read_as_it_was_written_and_not_when_it_is_cut() {
    for entry in entries() {
        let bytes = encoded(&[entry]);
        let (read, rest) = Entry::parse(&bytes).unwrap();
        assert_eq!((text(&read), rest.len()), (text(&entry), 0));
        for end in 0..bytes.len() {
            assert!(Entry::parse(&bytes[..end]).is_none(), "{} cut at {end}", text(&entry));
        }
    }
}

#[test]
fn entries_stand_one_behind_the_other() {
    let bytes = encoded(&entries());
    let mut rest = &bytes[..];
    for entry in entries() {
        let (read, after) = Entry::parse(rest).unwrap();
        assert_eq!(text(&read), text(&entry));
        rest = after;
    }
    assert!(rest.is_empty());
}

#[test]
fn an_input_and_an_output_byte_by_byte() {
    let input = Entry::Input { at: AT, input: Input::PortBytes { port: PORT, bytes: &[1, 2] } };
    assert_eq!(encoded(&[input]), [0x12, 0xAC, 0x96, 0xEB, 0xDC, 0x03, 3, 2, 1, 2]);
    let frame = CanFrame::new(CanId::Extended(0x501), &[9]).unwrap();
    let output = Entry::Output(Output::PortSendCan { port: PORT, frame });
    assert_eq!(encoded(&[output]), [0x22, 3, 0x01, 0x05, 0x00, 0x80, 1, 9]);
}

#[test]
fn any_byte_may_be_wrong_and_nothing_panics() {
    let mut bytes = MAGIC.to_vec();
    bytes.extend(encoded(&entries()));
    for at in 0..bytes.len().min(400) {
        for wrong in [0x00, 0x01, 0x7F, 0x80, 0xFF] {
            let mut damaged = bytes.clone();
            damaged[at] = wrong;
            let mut rest = &damaged[..];
            while let Some((_, after)) = Entry::parse(rest) {
                assert!(after.len() < rest.len());
                rest = after;
            }
        }
    }
    let overlong = [0x20, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x02];
    assert!(Entry::parse(&overlong).is_none(), "more than 64 bits");
}

#[test]
fn what_is_no_recording_is_refused() {
    let refused = |recording: &[u8]| {
        let mut engine = Engine::<1, 1, 8>::idle();
        replay(recording, &mut engine, &mut GatewayConfig::empty(), |_| {}).unwrap_err()
    };
    assert_eq!(refused(b"RGR\x01"), ReplayError::NotARecording);
    let with = |entry| [&MAGIC[..], &encoded(&[entry])].concat();
    assert_eq!(refused(&with(Entry::Input { at: AT, input: Input::Tick })), ReplayError::NoStart);
    assert_eq!(
        refused(&with(Entry::Start { image: b"RGCX then zeros, enough" })),
        ReplayError::Image(image::ImageError::NotAnImage { found: *b"RGCX" }),
    );
    let cut = with(Entry::Start { image: &[1, 2, 3] });
    assert_eq!(refused(&cut[..cut.len() - 1]), ReplayError::Entry { at: 4 });
}
