//! Which configuration runs, and why none does.

use firmware::fmt::Text;
use firmware::platform::{self, Board as _, NoDevice};
use firmware::stored::{self, EndedName, RoleName, StoredConfig};
use firmware::tasks::gateway::Gateway;
use firmware::tasks::store;
use firmware::{error, info};
use proto_core::config::{GatewayConfig, image};
use recipe_store::Role;

use super::{Flash, PORTS};
use crate::board::Board;

/// Why nothing runs.
#[derive(Debug, Clone, Copy)]
pub(super) enum CannotRun {
    Storage(<Board as platform::Board>::StorageError),
    Image(image::ImageError),
    Build(proto_core::engine::BuildError),
    NoDevice(NoDevice),
    /// The store has no configuration, and the image on the board was taken over and is gone.
    Empty,
    Ethernet(<Board as platform::Board>::EthernetError),
}

impl core::fmt::Display for CannotRun {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Storage(error) => error.fmt(f),
            Self::Image(error) => error.fmt(f),
            Self::Build(error) => error.fmt(f),
            Self::NoDevice(missing) => missing.fmt(f),
            Self::Empty => f.write_str("the store holds no configuration"),
            Self::Ethernet(error) => error.fmt(f),
        }
    }
}

/// Runs the first configuration that can run: the image that was put on the board since the last start; of the store
/// the one on trial, the live one, the one before; or else the image on the board, which was run before. Returns the
/// length of its image, or why none runs; leaves to the store task what is to be done with the store, and in `failure` why
/// the first one that was tried does not run.
///
/// Nothing is written but the start of a trial, so that the start takes no longer than without a store.
///
/// Not inlined, so that its stack frame is free when the tasks run.
#[inline(never)]
pub(super) fn load(
    board: &mut Board,
    stored: Option<&mut StoredConfig<Flash>>,
    gateway: &mut Gateway,
    config: &mut GatewayConfig,
    work: &mut store::StartWork<'static>,
    failure: &mut Option<CannotRun>,
) -> Result<usize, CannotRun> {
    let own = board.configuration().map_err(CannotRun::Storage).map(whole);
    let Some(stored) = stored else {
        let (image, _) = own?;
        return configure(image, gateway, config);
    };
    // An empty place is no failure where the store has something.
    let mut why = own.err();
    if let Ok((image, digest)) = own
        && !stored.store().is_adopted(digest, image.len())
    {
        match configure(image, gateway, config) {
            Ok(len) => {
                work.adopt = Some((digest, image));
                return Ok(len);
            }
            Err(error) => (why, *failure) = (Some(error), Some(error)),
        }
    }
    let mut candidates = heapless::Vec::new();
    if let Err(error) = board.block_on(stored.candidates(&mut candidates)) {
        error!("the store: {}", Text(&error));
    }
    // A trial ends by a restart, whose log is the only one that somebody may look at.
    if let Some((number, ended)) = stored.store().marks().last {
        info!("the last trial was of configuration {}: {}", number, Text(&EndedName(ended)));
    }
    let mut is_first = true;
    for (revision, role) in candidates {
        let Some(image) = stored.image(revision) else { continue };
        match configure(image, gateway, config) {
            Ok(len) => {
                info!("configuration {} of the store, {}", revision.number, Text(&RoleName(role)));
                work.trial = stored::trial_time(role);
                work.running = Some(revision.number);
                return Ok(len);
            }
            Err(error) => {
                error!("configuration {} of the store cannot run: {}", revision.number, Text(&error));
                work.trial_failed |= matches!(role, Role::Trial { .. });
                // It says more than an empty place.
                if core::mem::take(&mut is_first) {
                    (why, *failure) = (Some(error), Some(error));
                }
            }
        }
    }
    // Nothing of the store: the image on the board, although it was taken over.
    if let Ok((image, _)) = own
        && let Ok(len) = configure(image, gateway, config)
    {
        return Ok(len);
    }
    Err(why.unwrap_or(CannotRun::Empty))
}

/// The image without what follows it, and its CRC.
fn whole(bytes: &'static [u8]) -> (&'static [u8], u32) {
    let image = image::image_len(bytes).ok().and_then(|len| bytes.get(..len)).unwrap_or(bytes);
    let crc = image.get(image::HEADER - 4..).and_then(|rest| rest.first_chunk());
    (image, crc.map_or(0, |crc| u32::from_le_bytes(*crc)))
}

/// Runs the configuration of an image; returns the image's length. Not inlined: it is called in several places.
#[inline(never)]
fn configure(bytes: &[u8], gateway: &mut Gateway, config: &mut GatewayConfig) -> Result<usize, CannotRun> {
    decode(bytes, config)?;
    gateway.configure(config).map_err(CannotRun::Build)?;
    Ok(bytes.len())
}

/// Reads an image whose ports this board has. Not inlined, so that its stack frame is free when the engine is built.
#[inline(never)]
fn decode(bytes: &[u8], config: &mut GatewayConfig) -> Result<(), CannotRun> {
    image::decode_into(bytes, config).map_err(CannotRun::Image)?;
    PORTS.have(config.ports.iter().map(|port| &port.bus)).map_err(CannotRun::NoDevice)
}
