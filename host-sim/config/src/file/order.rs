//! The order in which the output frames of a CAN recipe are sent.
//!
//! In: the frames in file order, with `name` and `after`. Out: the same frames, each after the frame that it follows.
//! The gateway sends a whole cycle at once, in this order.

use super::model::{FileFrame, FrameOrder};
use super::names::did_you_mean;
use super::reader::{Result, Spot, TableReader};
use crate::keys::Key;
use crate::keys::frame::{AFTER, FRAME_NAME};

pub(super) const ORDER_KEYS: &[Key] = &[FRAME_NAME, AFTER];

impl FrameOrder {
    pub(super) fn read(frame: &TableReader<'_>) -> Result<Self> {
        let read = |key: &Key| {
            let Some(item) = frame.optional(key.name) else { return Ok(None) };
            let name = item.string()?;
            proto_core::config::check_name(name).map_err(|kind| item.error(kind))?;
            Ok(Some((name.to_owned(), item.spot)))
        };
        Ok(Self { name: read(&FRAME_NAME)?, after: read(&AFTER)? })
    }
}

/// Puts each frame after the frame that it names. Otherwise keeps the order of the file.
///
/// # Errors
/// What is wrong with a name, and where.
pub(super) fn sort(frames: &mut Vec<FileFrame>) -> std::result::Result<(), (Spot, String)> {
    check(frames)?;
    let mut waiting = std::mem::take(frames);
    while !waiting.is_empty() {
        let is_sent = |name: &str| frames.iter().any(|frame| frame.order.name() == Some(name));
        match waiting.iter().position(|frame| frame.order.after().is_none_or(is_sent)) {
            Some(next) => frames.push(waiting.remove(next)),
            None => return Err(circle(&waiting)),
        }
    }
    Ok(())
}

fn check(frames: &[FileFrame]) -> std::result::Result<(), (Spot, String)> {
    let names = || frames.iter().filter_map(|frame| frame.order.name());
    for (nth, FileFrame { order, .. }) in frames.iter().enumerate() {
        if let Some((name, spot)) = &order.name
            && names_before(frames, nth).any(|before| before == name)
        {
            let message = format!("there is already an output frame {name:?}; names must differ");
            return Err((spot.clone(), message));
        }
        let Some((after, spot)) = &order.after else { continue };
        if order.name() == Some(after) {
            let message =
                format!("a frame cannot be sent after itself, {after:?}; allowed: another output frame");
            return Err((spot.clone(), message));
        }
        if !names().any(|name| name == after) {
            let known: Vec<_> = names().map(|name| format!("{name:?}")).collect();
            let known = match &known[..] {
                [] => "no output frame of this recipe has a name".to_owned(),
                known => format!("there are {}", known.join(", ")),
            };
            let meant = did_you_mean(after, names());
            return Err((spot.clone(), format!("there is no output frame {after:?}; {known}{meant}")));
        }
    }
    Ok(())
}

fn names_before(frames: &[FileFrame], nth: usize) -> impl Iterator<Item = &str> {
    frames.iter().take(nth).filter_map(|frame| frame.order.name())
}

/// The error if frames wait for each other in a circle.
fn circle(waiting: &[FileFrame]) -> (Spot, String) {
    let mut names: Vec<&str> = Vec::new();
    let mut at = waiting.first();
    // Each of these frames waits for another one of them, so following `after` reaches a name a second time.
    while let Some(after) = at.and_then(|frame| frame.order.after())
        && !names.contains(&after)
    {
        names.push(after);
        at = waiting.iter().find(|frame| frame.order.name() == Some(after));
    }
    let again = at.and_then(|frame| frame.order.after()).unwrap_or_default();
    let circle = names.iter().skip_while(|name| **name != again).chain([&again]);
    let circle: Vec<_> = circle.map(|name| format!("{name:?}")).collect();
    let spot = at.or(waiting.first()).and_then(|frame| frame.order.after.clone()).map(|(_, spot)| spot);
    let message = format!("{} is a circle; allowed: one of them without after", circle.join(" after "));
    // A waiting frame has `after`.
    (spot.unwrap_or_else(|| waiting[0].spot.clone()), message)
}
