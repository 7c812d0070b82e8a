//! The layouts of a port's recipe, from the configuration. Those of device frames are made in `field/device.rs`.

use crate::config::{CanFramePart, ConfigView, FieldSpec, Recipe, StreamPart};
use crate::engine::build_error::BuildError;
use crate::engine::field::codec::Codec;
use crate::recipe::model::{Framing, Rules};
use crate::recipe::{CanLayout, Deframer, StreamLayout};
use crate::sysvar::Direction;

/// Makes the layouts of a stream recipe in place.
#[inline(never)]
pub(crate) fn stream_codec(
    config: ConfigView<'_>,
    index: u8,
    recipe: &Recipe,
    [input, output]: [&Option<StreamPart>; 2],
    codec: &mut Codec,
) -> Result<(), BuildError> {
    let layout = |part: &Option<StreamPart>, direction| {
        stream_layout(config, index, recipe, part.as_ref(), direction, Framing::Bytes)
    };
    *codec = Codec::Stream { input: None, output: None, deframer: Deframer::new() };
    if let Codec::Stream { input: own_input, output: own_output, .. } = codec {
        *own_input = layout(input, Direction::Input)?;
        *own_output = layout(output, Direction::Output)?;
    }
    Ok(())
}

pub(crate) fn stream_layout(
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
    // One copy of the layout, where `map` and `map_err` would make two.
    match StreamLayout::new(rules, &part.head, &part.tail, fields, framing) {
        Ok(layout) => Ok(Some(layout)),
        Err(error) => Err(BuildError::Part { recipe: index, part: direction, error }),
    }
}

/// Makes the layouts of a CAN recipe in place.
#[inline(never)]
pub(crate) fn can_codec(
    config: ConfigView<'_>,
    index: u8,
    recipe: &Recipe,
    [input, output]: [&[CanFramePart]; 2],
    codec: &mut Codec,
) -> Result<(), BuildError> {
    let layout = |frames: &[CanFramePart], direction| {
        if frames.is_empty() {
            return Ok(None);
        }
        let frames = frames.iter().map(|frame| {
            let fields = frame.fields.of(config.fields).iter().filter_map(FieldSpec::field);
            (frame.id, fields)
        });
        match CanLayout::new(Rules { mode: recipe.mode, direction }, frames) {
            Ok(layout) => Ok(Some(layout)),
            Err(error) => Err(BuildError::Part { recipe: index, part: direction, error }),
        }
    };
    *codec = Codec::Can { input: None, output: None };
    if let Codec::Can { input: own_input, output: own_output } = codec {
        *own_input = layout(input, Direction::Input)?;
        *own_output = layout(output, Direction::Output)?;
    }
    Ok(())
}

pub(crate) fn index_of(config: ConfigView<'_>, recipe: &Recipe) -> u8 {
    (0..).zip(config.recipes).find(|(_, other)| other.name == recipe.name).map_or(0, |(index, _)| index)
}
