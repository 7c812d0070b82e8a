//! Checks an image piece by piece without keeping it.
//!
//! In: the same bytes of an image in each step. Out: the first error in them, or the buses of the ports. Refuses what
//! `decode_into` refuses, except for errors that only a complete configuration shows.

use heapless::Vec;

use super::v4::LISTS;
use super::{Counted, HEADER, ImageError, count, header, payload, read_entries, read_head};
use crate::config::{
    Bus, GatewayConfig, MAX_ALL_FIELDS, MAX_COMMANDS, MAX_EXCHANGES, MAX_PORTS, MAX_RECIPES, MAX_SAFE_VALUES,
};

/// Progress of checking an image. A board uses this for an image that it only stores, because a second configuration
/// takes almost 60 KiB. Other work can be done between two steps.
///
/// ```
/// use proto_core::config::image::{self, Scan};
/// # use proto_core::config::{GatewayConfig, Port, Recipe};
/// # let config = GatewayConfig::<1, 1, 1, 0, 0>::builder()
/// #     .controller("192.168.12.138")
/// #     .recipe(Recipe::realtime("outputs").stream_input(&[0xFF], &[0xEE], &["DigitalOutputCommand[1]"]))
/// #     .port(Port::rs485("rs485-1", "outputs"))
/// #     .build()?;
/// # let mut bytes = [0; 256];
/// # let len = image::encode(&config, &mut bytes)?;
/// # let image = &bytes[..len];
/// let mut scan = Scan::new();
/// while scan.step(image)? {
///     // Others run.
/// }
/// assert_eq!(scan.buses().len(), 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Default)]
pub struct Scan {
    /// Number of payload bytes read.
    at: usize,
    /// Number of lists started.
    lists: usize,
    /// Remaining entries of the newest list.
    left: usize,
    buses: Vec<Bus, MAX_PORTS>,
}

impl Scan {
    /// A scan that has read nothing.
    pub const fn new() -> Self {
        Self { at: 0, lists: 0, left: 0, buses: Vec::new() }
    }

    /// Reads the head and checks the CRC, or reads a few entries of a list. Returns whether there is more. Pass the
    /// same bytes each time: otherwise, a step may fail, or the contents were not checked.
    ///
    /// # Errors
    /// [`ImageError`], but never [`ImageError::Config`]. Do not call it again then.
    pub fn step(&mut self, bytes: &[u8]) -> Result<bool, ImageError> {
        let (version, all) = match self.at {
            0 => payload(bytes)?,
            _ => unchecked(bytes)?,
        };
        let mut rest = all.get(self.at..).ok_or(ImageError::Contents)?;
        // Space for one entry of each list; earlier ones are dropped.
        let mut one = GatewayConfig::<1, 1, 1, 1, 1, 1>::empty();
        let mut config = one.view_mut();
        if self.at == 0 {
            read_head(version, &mut rest, &mut config)?;
        }
        for _ in 0..AT_ONCE {
            if self.left == 0 {
                let Some(list) = LISTS.get(self.lists) else { break };
                self.left = count(&mut rest, *list, room(*list))?;
                self.lists = self.lists.saturating_add(1);
                continue;
            }
            let Some(list) = LISTS.get(self.lists.saturating_sub(1)) else { break };
            config.clear(*list);
            read_entries(version, *list, 1, &mut rest, &mut config)?;
            self.left = self.left.saturating_sub(1);
            if *list == Counted::Ports
                && let Some(port) = config.ports.first()
            {
                // Cannot fail: the count was checked.
                let _ = self.buses.push(port.bus.clone());
            }
        }
        self.at = all.len().saturating_sub(rest.len());
        let is_more = self.left > 0 || self.lists < LISTS.len();
        if !is_more && !rest.is_empty() {
            return Err(ImageError::Contents);
        }
        Ok(is_more)
    }

    /// The buses of the ports in their order, once everything is read.
    pub fn buses(&self) -> &[Bus] {
        &self.buses
    }
}

/// Version and payload of an image with a checked CRC.
fn unchecked(bytes: &[u8]) -> Result<(u32, &[u8]), ImageError> {
    let (version, length, _) = header(bytes)?;
    let needed = HEADER.saturating_add(length as usize);
    let payload = bytes.get(HEADER..needed);
    Ok((version, payload.ok_or(ImageError::TooShort { needed, available: bytes.len() })?))
}

/// Number of entries that fit a board's configuration.
const fn room(list: Counted) -> usize {
    match list {
        Counted::Recipes => MAX_RECIPES,
        Counted::Ports => MAX_PORTS,
        Counted::Fields => MAX_ALL_FIELDS,
        Counted::Commands => MAX_COMMANDS,
        Counted::SafeValues => MAX_SAFE_VALUES,
        Counted::Exchanges | Counted::ExchangeFrames => MAX_EXCHANGES,
        _ => 0,
    }
}

/// Number of entries, or lists, per step.
const AT_ONCE: usize = 8;
