//! Reads `[functions]` of a controller file (D27).

use super::reader::{Result, TableReader};
use crate::functions::{
    FUNCTION_INPUTS, FUNCTION_OUTPUTS, Function, FunctionInput, FunctionOutput, Functions, ShownState,
};
use crate::keys;
use crate::sim::SimProgram;
use crate::target::{InitialTarget, TargetError};

pub(super) fn read(root: &TableReader<'_>, programs: &[SimProgram]) -> Result<Functions> {
    let Some(item) = root.optional("functions") else { return Ok(Functions::default()) };
    let table = item.table(&keys::controller::FUNCTIONS)?;
    let inputs = read_table(&table, "inputs", &INPUTS, &Function::ALL)?;
    let outputs = read_table(&table, "outputs", &OUTPUTS, &ShownState::ALL)?;
    let inputs: Vec<_> =
        inputs.into_iter().map(|(item, function)| FunctionInput { item, function }).collect();
    let outputs = outputs.into_iter().map(|(item, state)| FunctionOutput { item, state }).collect();
    let starts = inputs.iter().any(|input| input.function == Function::Start);
    let start = match table.optional("start") {
        None if starts => {
            return Err(table.error("start is missing; the name of the program that the input starts"));
        }
        None => None,
        Some(item) if !starts => return Err(item.error("no input has the function \"start\"")),
        Some(item) => {
            let names: Vec<_> = programs.iter().map(|program| (program.name.as_str(), ())).collect();
            if names.is_empty() {
                return Err(item.error("the file has no [[program]] that could be started"));
            }
            item.choice(&names)?;
            Some(item.string()?.to_owned())
        }
    };
    Ok(Functions { inputs, outputs, start })
}

/// The items that a table accepts.
struct Items {
    takes: fn(InitialTarget) -> bool,
    /// What only these items can do, for messages about others.
    does: &'static str,
    allowed: &'static str,
}

const INPUTS: Items =
    Items { takes: InitialTarget::triggers_functions, does: "trigger a function", allowed: FUNCTION_INPUTS };
const OUTPUTS: Items =
    Items { takes: InitialTarget::shows_states, does: "show a state", allowed: FUNCTION_OUTPUTS };

/// Reads a table that maps items to `choices`, in file order.
fn read_table<T: Clone>(
    functions: &TableReader<'_>,
    key: &str,
    items: &Items,
    choices: &[(&str, T)],
) -> Result<Vec<(InitialTarget, T)>> {
    let mut all: Vec<(InitialTarget, T)> = Vec::new();
    let Some(item) = functions.optional(key) else { return Ok(all) };
    let Items { takes, does, allowed } = items;
    for (name, spot, item) in item.any_table()?.entries() {
        let wrong = |message: String| Err(spot.error(functions.document, message));
        let target: InitialTarget = match name.parse() {
            Ok(target) => target,
            Err(TargetError::Variable(_)) => {
                return wrong(format!("{name:?} is no input or output; allowed: {allowed}"));
            }
            Err(error) => return wrong(error.to_string()),
        };
        if !takes(target) {
            return wrong(format!("{target} cannot {does}; allowed: {allowed}"));
        }
        if let Some((before, _)) = all.iter().find(|(before, _)| before.is_same_bit(target)) {
            return wrong(format!("{before} is in this table already, and is the same bit"));
        }
        all.push((target, item.choice(choices)?));
    }
    Ok(all)
}
