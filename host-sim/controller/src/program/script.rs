//! Compiled scripts, and the interpreter they run in.

use std::fmt;
use std::sync::Arc;

use rhai::{AST, Engine, OptimizationLevel};

use super::{MAX_CALLS, MAX_DEPTH, MAX_ITEMS, MAX_STRING, MAX_VARIABLES};

/// A compiled script.
#[derive(Debug, Clone)]
pub struct Script {
    name: String,
    ast: Arc<AST>,
}

/// Why a script does not compile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScriptError {
    /// What is wrong, and where.
    message: String,
    /// 1-based line in the script, when it is known.
    line: Option<usize>,
}

impl ScriptError {
    /// 1-based line in the script, when it is known.
    pub fn line(&self) -> Option<usize> {
        self.line
    }
}

impl fmt::Display for ScriptError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for ScriptError {}

impl Script {
    /// Compiles `text`.
    ///
    /// # Errors
    /// [`ScriptError`] with the line.
    pub fn compile(name: &str, text: &str) -> Result<Self, ScriptError> {
        match engine().compile(text) {
            Ok(ast) => Ok(Self { name: name.to_owned(), ast: Arc::new(ast) }),
            Err(error) => {
                let message = error.to_string().replace('\n', " ");
                Err(ScriptError { message, line: error.position().line() })
            }
        }
    }

    /// The program's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn ast(&self) -> Arc<AST> {
        Arc::clone(&self.ast)
    }
}

/// An interpreter with all bounds set, and without functions that read a clock or wait.
pub(super) fn engine() -> Engine {
    let mut engine = Engine::new();
    engine
        .set_optimization_level(OptimizationLevel::None)
        .set_max_string_size(MAX_STRING)
        .set_max_array_size(MAX_ITEMS)
        .set_max_map_size(MAX_ITEMS)
        .set_max_variables(MAX_VARIABLES)
        .set_max_call_levels(MAX_CALLS)
        .set_max_expr_depths(MAX_DEPTH, MAX_DEPTH)
        .disable_symbol("eval");
    engine
}
