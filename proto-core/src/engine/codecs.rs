//! The layouts of a port's recipe, from the configuration. Those of devices' frames are made in
//! `device_port`.

use super::build_error::BuildError;
use super::field_port::Codec;
use crate::config::{CanFramePart, ConfigView, FieldSpec, Recipe, StreamPart};
use crate::recipe::model::{Framing, Rules};
use crate::recipe::{CanLayout, Deframer, StreamLayout};
use crate::sysvar::Direction;

/// The layouts of a stream recipe.
#[inline(never)]
pub(super) fn stream_codec(
    config: ConfigView<'_>,
    index: u8,
    recipe: &Recipe,
    [input, output]: [&Option<StreamPart>; 2],
) -> Result<Codec, BuildError> {
    let layout = |part: &Option<StreamPart>, direction| {
        stream_layout(config, index, recipe, part.as_ref(), direction, Framing::Bytes)
    };
    Ok(Codec::Stream {
        input: layout(input, Direction::Input)?,
        output: layout(output, Direction::Output)?,
        deframer: Deframer::new(),
    })
}

/// The layout of one part, if there is one.
pub(super) fn stream_layout(
    config: ConfigView<'_>,
    index: u8,
    recipe: &Recipe,
    part: Option<&StreamPart>,
    direction: Direction,
    framing: Framing,
) -> Result<Option<StreamLayout>, BuildError> {
    let Some(part) = part else { return Ok(None) };
    let rules = Rules { mode: recipe.mode, direction };
    let fields = part.fields.of(config.fields).iter().filter_map(FieldSpec::field);
    StreamLayout::new(rules, &part.head, &part.tail, fields, framing)
        .map(Some)
        .map_err(|error| BuildError::Part { recipe: index, part: direction, error })
}

/// The layouts of a CAN recipe.
#[inline(never)]
pub(super) fn can_codec(
    config: ConfigView<'_>,
    index: u8,
    recipe: &Recipe,
    [input, output]: [&[CanFramePart]; 2],
) -> Result<Codec, BuildError> {
    let layout = |frames: &[CanFramePart], direction| {
        if frames.is_empty() {
            return Ok(None);
        }
        let frames = frames.iter().map(|frame| {
            let fields = frame.fields.of(config.fields).iter().filter_map(FieldSpec::field);
            (frame.id, fields)
        });
        CanLayout::new(Rules { mode: recipe.mode, direction }, frames)
            .map(Some)
            .map_err(|error| BuildError::Part { recipe: index, part: direction, error })
    };
    Ok(Codec::Can { input: layout(input, Direction::Input)?, output: layout(output, Direction::Output)? })
}

/// The index of a recipe.
pub(super) fn index_of(config: ConfigView<'_>, recipe: &Recipe) -> u8 {
    (0..).zip(config.recipes).find(|(_, other)| other.name == recipe.name).map_or(0, |(index, _)| index)
}
