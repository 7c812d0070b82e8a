//! IP addresses in `Host`, parsed here because the parser of `core` has panics that the optimiser does not remove.

use core::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use heapless::Vec;

use crate::request::cut;

/// Parses an IP address: four decimal numbers, or hexadecimal groups without brackets.
pub(crate) fn parse(text: &str) -> Option<IpAddr> {
    match text.bytes().any(|byte| byte == b':') {
        true => v6(text).map(IpAddr::V6),
        false => v4(text).map(IpAddr::V4),
    }
}

fn v4(text: &str) -> Option<Ipv4Addr> {
    let mut rest = Some(text);
    let mut octets = [0; 4];
    for octet in &mut octets {
        let (part, behind) = part(rest?, b'.');
        rest = behind;
        // Other programs could read a leading zero as octal.
        let is_number = part.len() == 1 || !part.starts_with('0');
        if !is_number || part.is_empty() || !part.bytes().all(|byte| byte.is_ascii_digit()) {
            return None;
        }
        *octet = part.parse().ok()?;
    }
    rest.is_none().then(|| octets.into())
}

fn v6(text: &str) -> Option<Ipv6Addr> {
    let gap = text.as_bytes().windows(2).position(|two| two == b"::");
    let (front, back) = match gap {
        Some(at) => (groups(text.get(..at)?)?, groups(text.get(at.saturating_add(2)..)?)?),
        None => (groups(text)?, Vec::new()),
    };
    let len = front.len().saturating_add(back.len());
    if len > 8 || (gap.is_none() && len != 8) || (gap.is_some() && len == 8) {
        return None;
    }
    let mut segments = [0; 8];
    for (segment, group) in segments.iter_mut().zip(&front) {
        *segment = *group;
    }
    for (segment, group) in segments.iter_mut().rev().zip(back.iter().rev()) {
        *segment = *group;
    }
    Some(segments.into())
}

/// Groups separated by colons; an empty text has none.
fn groups(text: &str) -> Option<Vec<u16, 8>> {
    let mut groups = Vec::new();
    let mut rest = (!text.is_empty()).then_some(text);
    while let Some(left) = rest {
        let (part, behind) = part(left, b':');
        rest = behind;
        if !(1..=4).contains(&part.len()) || !part.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return None;
        }
        groups.push(u16::from_str_radix(part, 16).ok()?).ok()?;
    }
    Some(groups)
}

/// What comes before the first `at`, and what comes after it; `None` without an `at`.
fn part(text: &str, at: u8) -> (&str, Option<&str>) {
    cut(text, at).map_or((text, None), |(part, behind)| (part, Some(behind)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::string::ToString;

    proptest! {
        #[test]
        fn what_an_address_displays_as_is_read(address in any::<IpAddr>()) {
            prop_assume!(!matches!(address, IpAddr::V6(six) if six.to_string().contains('.')));
            prop_assert_eq!(parse(&address.to_string()), Some(address));
        }

        #[test]
        fn whatever_is_read_another_reader_reads_too(text in "[0-9a-f:.]{0,20}|[0-9a-fg]{0,5}(::?[0-9a-f+-]{1,5}){0,9}") {
            if let Some(address) = parse(&text) {
                prop_assert_eq!(text.parse(), Ok(address));
            }
        }
    }

    #[test]
    fn zeros_may_be_left_out_once() {
        for right in ["::", "::1", "1::", "1::2", "1:2:3:4:5:6:7:8", "1:2:3:4:5:6:7::", "fe80::1:2"] {
            assert_eq!(parse(right), right.parse().ok(), "{right}");
        }
        for wrong in [
            "",
            ":",
            ":::",
            "1:::2",
            "1::2::3",
            "1:2:3:4:5:6:7",
            "1:2:3:4:5:6:7:8:9",
            "1:2:3:4:5:6:7:8::",
            ":1::",
            "12345::",
            "1.2.3",
            "1.2.3.4.5",
            "1.2.3.256",
            "01.2.3.4",
            "1.2.3.4.",
            "+1.2.3.4",
            "::1%eth0",
        ] {
            assert_eq!(parse(wrong), None, "{wrong}");
        }
    }
}
