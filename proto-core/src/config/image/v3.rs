//! Version 3: before events of exchanges. Frozen: its reader never changes.
//!
//! Old types of exchanges and ports, each with `From` into the new type; the lists' other types are unchanged.

use serde::Deserialize;

use super::{ConfigMut, ImageError, item, items, v4};
use crate::config::error::Counted;
use crate::config::{self, Bus, Name, PortHealth, Span, Transaction, Triggers};
use crate::time::Duration;

pub(super) fn read_head(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item(rest)?;
    *config.network = item(rest)?;
    Ok(())
}

pub(super) fn read_entries(
    list: Counted,
    count: usize,
    rest: &mut &[u8],
    config: &mut ConfigMut<'_>,
) -> Result<(), ImageError> {
    match list {
        Counted::Ports => items::<PortV3, _>(rest, count, config.ports),
        Counted::Exchanges => items::<Exchange, _>(rest, count, config.exchanges),
        _ => v4::read_entries(list, count, rest, config),
    }
}

#[derive(Deserialize)]
struct PortV3 {
    name: Name,
    bus: Bus,
    recipe: u8,
    cycle: Duration,
    timeout: Duration,
    on_timeout: Span,
    stale_after: Duration,
    health: PortHealth,
    safe_at_start: bool,
    refresh: Option<Duration>,
}

impl From<PortV3> for config::Port {
    fn from(old: PortV3) -> Self {
        let PortV3 {
            name,
            bus,
            recipe,
            cycle,
            timeout,
            on_timeout,
            stale_after,
            health,
            safe_at_start,
            refresh,
        } = old;
        let absent = Self::ABSENT;
        Self {
            name,
            bus,
            recipe,
            cycle,
            timeout,
            on_timeout,
            stale_after,
            health,
            safe_at_start,
            refresh,
            absent,
        }
    }
}

/// Repetitions also applied to events, which are not repeated any more.
#[derive(Deserialize)]
struct Exchange {
    peer: u8,
    transaction: Transaction,
    when: Triggers,
    timeout: Duration,
    retries: u8,
    pause: Duration,
}

impl From<Exchange> for config::Exchange {
    fn from(Exchange { peer, transaction, when, timeout, retries, pause }: Exchange) -> Self {
        Self { timeout, retries, pause, ..Self::new(peer, transaction, when) }
    }
}
