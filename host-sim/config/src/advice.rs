//! Warnings about what is valid and often a mistake, that need what only the file says.
//!
//! In: the recipes of a gateway file as frames. Out: sentences, each with the key it is about.

use proto_core::config::{FieldSpec, InputRule};
use proto_core::wire::scalar::ScalarType;

use crate::device::{DeviceField, DeviceRecipe, NamedFrame};

/// Fields that can be negative and write a variable that cannot, without `offset`: a negative number is
/// rejected. An `offset = 0` that is written says that this is known.
pub fn negative_numbers(recipes: &[Option<DeviceRecipe>]) -> Vec<(Vec<String>, String)> {
    let advice = |recipe: &DeviceRecipe| {
        let parts = recipe.input.iter().map(|frame| &frame.fields);
        let talk = |frame: &Option<NamedFrame>| frame.as_ref().map(|frame| frame.fields.clone());
        let exchanged = recipe.exchanges.iter().flat_map(|exchange| {
            [&exchange.request, &exchange.reply, &exchange.refusal].map(talk).into_iter().flatten()
        });
        let fields = parts.cloned().chain(exchanged).flatten();
        let told = fields.filter_map(|field| of_field(&recipe.name, &field));
        told.map(|said| (["recipe", &recipe.name].map(str::to_owned).to_vec(), said)).collect::<Vec<_>>()
    };
    recipes.iter().flatten().flat_map(advice).collect()
}

fn of_field(recipe: &str, field: &DeviceField) -> Option<String> {
    let var = field.spec.rejects_negative().filter(|_| !field.has_offset)?;
    let is_told = field.sendable.iter().any(|rule| match rule {
        FieldSpec::InputRule(InputRule::Int16) | FieldSpec::Mapped(_) => true,
        FieldSpec::Limits(limits) => limits.low >= 0.0,
        _ => false,
    });
    if is_told {
        return None;
    }
    let (least, most) = var.ty().range();
    Some(format!(
        "recipe {recipe:?}, field {:?}: {var} takes {least}..={most}, so a negative number is rejected; write {}an offset, \
         or offset = 0 if there is none",
        field.name,
        if var.ty() == ScalarType::Word { "as = \"int16\", " } else { "" }
    ))
}
