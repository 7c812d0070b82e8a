//! Chooses the configuration to run.

use firmware::fmt::DisplayText;
use firmware::platform::{Board as _, NoDevice};
use firmware::stored::{self, EndedName, RoleName, StoredConfig};
use firmware::tasks::gateway::Gateway;
use firmware::tasks::store;
use firmware::{error, info};
use proto_core::config::{GatewayConfig, image};
use recipe_store::Role;

use super::PORTS;
use crate::board::{Board, EthernetError, StorageError, StoreArea};

/// Why no configuration runs.
#[derive(Debug, Clone, Copy)]
pub(super) enum CannotRun {
    Storage(StorageError),
    Image(image::ImageError),
    Build(proto_core::engine::BuildError),
    NoDevice(NoDevice),
    /// The store has no configuration, and there is no image outside it.
    Empty,
    Ethernet(EthernetError),
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

/// Configures the gateway with the first configuration that can run, and returns the length of its image. The order is:
/// a new image outside the store; from the store, the configuration on trial, the live one, the previous one; the image
/// outside the store even if it was adopted before. `work` gets the writes that are left to the store task, `failure`
/// the reason why the first candidate does not run.
///
/// Writes only the start of a trial, so that the start takes no longer than without a store.
///
/// Not inlined, to free its stack frame before the tasks run.
#[inline(never)]
pub(super) fn load(
    board: &mut Board,
    stored: Option<&mut StoredConfig<StoreArea>>,
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
    // A missing image is not a failure if the store has a configuration.
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
        error!("the store: {}", DisplayText(&error));
    }
    // A trial ends by a restart; log its result where it can be read.
    if let Some((number, ended)) = stored.store().marks().last {
        info!("the last trial was of configuration {}: {}", number, DisplayText(&EndedName(ended)));
    }
    let mut is_first = true;
    for (revision, role) in candidates {
        let Some(image) = stored.image(revision) else { continue };
        match configure(image, gateway, config) {
            Ok(len) => {
                info!("configuration {} of the store, {}", revision.number, DisplayText(&RoleName(role)));
                work.trial = stored::trial_time(role);
                work.running = Some(revision.number);
                return Ok(len);
            }
            Err(error) => {
                error!("configuration {} of the store cannot run: {}", revision.number, DisplayText(&error));
                work.trial_failed |= matches!(role, Role::Trial { .. });
                // Report why the first candidate does not run, which is more useful than "no image".
                if core::mem::take(&mut is_first) {
                    (why, *failure) = (Some(error), Some(error));
                }
            }
        }
    }
    // Nothing from the store runs: fall back to the adopted image.
    if let Ok((image, _)) = own
        && let Ok(len) = configure(image, gateway, config)
    {
        return Ok(len);
    }
    Err(why.unwrap_or(CannotRun::Empty))
}

/// The image without trailing bytes, and its CRC.
fn whole(bytes: &'static [u8]) -> (&'static [u8], u32) {
    let image = image::image_len(bytes).ok().and_then(|len| bytes.get(..len)).unwrap_or(bytes);
    let crc = image.get(image::HEADER - 4..).and_then(|rest| rest.first_chunk());
    (image, crc.map_or(0, |crc| u32::from_le_bytes(*crc)))
}

/// Configures the gateway with an image; returns the image's length. Not inlined: it has several callers.
#[inline(never)]
fn configure(bytes: &[u8], gateway: &mut Gateway, config: &mut GatewayConfig) -> Result<usize, CannotRun> {
    decode(bytes, config)?;
    gateway.configure(config).map_err(CannotRun::Build)?;
    Ok(bytes.len())
}

/// Decodes an image and checks its ports. Not inlined, to free its stack frame before the engine is built.
#[inline(never)]
fn decode(bytes: &[u8], config: &mut GatewayConfig) -> Result<(), CannotRun> {
    image::decode_into(bytes, config).map_err(CannotRun::Image)?;
    PORTS.have(config.ports.iter().map(|port| &port.bus)).map_err(CannotRun::NoDevice)
}
