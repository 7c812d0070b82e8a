//! `[network]` of a gateway file: the board's own address. `host-sim` does not use it.

use std::net::Ipv4Addr;

use proto_core::config::Network;

use super::reader::{Result, TableReader, TableValue};

pub(super) fn read(table: &TableReader<'_>) -> Result<Network> {
    let item = table
        .required("address", "the board's IPv4 address and prefix length, such as \"192.168.12.20/24\"")?;
    let text = item.string()?;
    let parts = text.split_once('/');
    let parsed = parts.and_then(|(address, prefix)| Some((address.parse().ok()?, prefix.parse().ok()?)));
    let (address, prefix) = parsed.ok_or_else(|| {
        item.error(format!(
            "{text:?} is not an IPv4 address with a prefix length, such as \"192.168.12.20/24\""
        ))
    })?;
    let optional = |key| table.optional(key).map(|item| host(&item)).transpose();
    Ok(Network { address, prefix, router: optional("router")?, dns: optional("dns")? })
}

/// Refuses a text that looks like an IPv4 address and is not: a name service would be asked for it in vain.
pub(super) fn check_ipv4(text: &str) -> std::result::Result<(), String> {
    let last = text.trim_end_matches('.').rsplit('.').next().unwrap_or("");
    let ends_in_number = !last.is_empty() && last.bytes().all(|byte| byte.is_ascii_digit());
    if ends_in_number && text.parse::<Ipv4Addr>().is_err() {
        return Err(format!(
            "{text:?} is not an IPv4 address, which has four numbers in 0..=255 such as \"192.168.12.138\", and not a \
             host name, whose last part is no number"
        ));
    }
    Ok(())
}

fn host(item: &TableValue<'_>) -> Result<Ipv4Addr> {
    let text = item.string()?;
    text.parse().map_err(|_| item.error(format!("{text:?} is not an IPv4 address, such as \"192.168.12.1\"")))
}
