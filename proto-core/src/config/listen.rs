//! The address and port that a port listens on.
//!
//! In: text such as `0.0.0.0:50000` or `[::]:50000`. Out: the same result as from the parser of [`SocketAddr`], which
//! is not used because the compiler cannot prove that it does not panic.

use core::net::{Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6};

use heapless::Vec;

use crate::wire::ascii::split_once;

/// The address and port in `text`.
pub fn listen_address(text: &str) -> Option<SocketAddr> {
    match text.strip_prefix('[') {
        None => {
            let (address, port) = split_once(text, b':')?;
            Some(SocketAddrV4::new(ipv4(address)?, decimal(port)?).into())
        }
        Some(rest) => {
            let (inside, port) = split_once(rest, b']')?;
            let port = decimal(port.strip_prefix(':')?)?;
            let (address, scope) = match split_once(inside, b'%') {
                Some((address, scope)) => (address, decimal(scope)?),
                None => (inside, 0),
            };
            Some(SocketAddrV6::new(ipv6(address)?, port, 0, scope).into())
        }
    }
}

fn decimal<T: core::str::FromStr>(digits: &str) -> Option<T> {
    // `parse` also accepts a sign.
    digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok())?
}

fn ipv4(text: &str) -> Option<Ipv4Addr> {
    let (first, rest) = split_once(text, b'.')?;
    let (second, rest) = split_once(rest, b'.')?;
    let (third, fourth) = split_once(rest, b'.')?;
    let octet = |text: &str| {
        // Some programs interpret a leading zero as octal.
        let leading_zero = text.len() > 1 && text.starts_with('0');
        if leading_zero { None } else { decimal(text) }
    };
    Some(Ipv4Addr::new(octet(first)?, octet(second)?, octet(third)?, octet(fourth)?))
}

pub(super) fn ipv6(text: &str) -> Option<Ipv6Addr> {
    let mut groups: Vec<u16, 8> = Vec::new();
    // Number of groups before the `::`.
    let mut gap = None;
    let mut rest = text;
    if let Some(behind) = rest.strip_prefix("::") {
        gap = Some(0);
        rest = behind;
    }
    while !(rest.is_empty() && gap == Some(groups.len())) {
        let (group, more) = match split_once(rest, b':') {
            Some((group, more)) => (group, Some(more)),
            None => (rest, None),
        };
        if more.is_none() && group.contains('.') {
            for pair in ipv4(group)?.octets().as_chunks().0 {
                groups.push(u16::from_be_bytes(*pair)).ok()?;
            }
        } else {
            groups.push(hexadecimal(group)?).ok()?;
        }
        let Some(more) = more else { break };
        rest = match more.strip_prefix(':') {
            Some(_) if gap.is_some() => return None,
            Some(behind) => {
                gap = Some(groups.len());
                behind
            }
            None => more,
        };
    }
    let mut all = [0; 8];
    match gap {
        // `::` replaces at least one group.
        Some(before) if !groups.is_full() => {
            let (front, back) = groups.split_at_checked(before)?;
            all.iter_mut().zip(front).for_each(|(place, group)| *place = *group);
            all.iter_mut().rev().zip(back.iter().rev()).for_each(|(place, group)| *place = *group);
        }
        None if groups.is_full() => all.iter_mut().zip(&groups).for_each(|(place, group)| *place = *group),
        _ => return None,
    }
    Some(all.into())
}

fn hexadecimal(digits: &str) -> Option<u16> {
    let fits = (1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    fits.then(|| u16::from_str_radix(digits, 16).ok())?
}

#[cfg(test)]
mod tests {
    use std::prelude::rust_2024::*;

    use proptest::prelude::*;

    use super::*;

    #[track_caller]
    fn same(text: &str) {
        assert_eq!(listen_address(text), text.parse().ok(), "{text:?}");
    }

    #[test]
    fn addresses_are_those_of_core() {
        let good = [
            "0.0.0.0:50000",
            "127.0.0.1:0",
            "[::]:50000",
            "[::1]:65535",
            "[1::]:7",
            "[fe80::1%3]:80",
            "[1:2:3:4:5:6:7:8]:1",
            "[1:2:3:4:5:6:7::]:1",
            "[::2:3:4:5:6:7:8]:1",
            "[::ffff:192.0.2.1]:1",
            "[1:2:3:4:5:6:1.2.3.4]:1",
            "1.2.3.4:00080",
        ];
        for text in good {
            assert!(listen_address(text).is_some(), "{text}");
            same(text);
        }
        let bad = [
            "",
            ":",
            "1.2.3.4",
            "1.2.3:4",
            "1.2.3.4.5:6",
            "01.2.3.4:5",
            "256.1.1.1:5",
            "1.2.3.4:65536",
            "1.2.3.4:",
            "1.2.3.4:+5",
            "[]:1",
            "[:]:1",
            "[:::]:1",
            "[1]:1",
            "[1:2:3:4:5:6:7:8:9]:1",
            "[1::2::3]:1",
            "[::1]",
            "[::1]1",
            "[::12345]:1",
            "[1:2:3:4::5:6:7:8]:1",
            "[1.2.3.4::]:1",
            "[::1.2.3.4:5]:1",
            "[fe80::1%]:80",
            "[::+1]:1",
            "[1:2:3:4:5:6:7:1.2.3.4]:1",
            "[1:]:1",
            "[::1:]:1",
        ];
        for text in bad {
            assert_eq!(listen_address(text), None, "{text}");
            same(text);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]

        #[test]
        fn any_text_means_what_it_means_to_core(text in "\\[?(([0-9a-f]{0,5}|[0-9.]{1,9})::?){0,9}[0-9a-f.]{0,8}(%[0-9]{0,2})?\\]?(:[0-9]{0,6})?") {
            prop_assert_eq!(listen_address(&text), text.parse().ok());
        }

        #[test]
        fn every_address_is_read(v6: u128, zeros: u128, port: u16, scope in 0..3_u32) {
            let v6 = SocketAddrV6::new(Ipv6Addr::from_bits(v6 & zeros), port, 0, scope);
            prop_assert_eq!(listen_address(&v6.to_string()), Some(v6.into()));
            let v4 = SocketAddrV4::new(Ipv4Addr::from_bits(zeros as u32), port);
            prop_assert_eq!(listen_address(&v4.to_string()), Some(v4.into()));
        }
    }
}
