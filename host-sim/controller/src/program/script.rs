//! Compiled scripts, and the interpreter they run in.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use rhai::{AST, Engine, OptimizationLevel, Token};

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
    message: String,
    /// 1-based line in the script, if known.
    line: Option<usize>,
}

impl ScriptError {
    /// 1-based line in the script, if known.
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

/// The script with this name, or with the file name of this path.
pub(crate) fn named<'a>(scripts: &'a [Script], name: &str) -> Option<&'a Script> {
    let base = name.rsplit('/').next().unwrap_or(name);
    let by = |wanted: &str| scripts.iter().find(|script| script.name() == wanted);
    by(name).or_else(|| by(base))
}

/// An interpreter with all limits set, and without functions that read a clock or wait.
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
    let after_dot = AtomicBool::new(false);
    #[expect(deprecated, reason = "marked so by its authors only because it may change")]
    engine.on_parse_token(move |token, _, _| {
        let is_method = after_dot.swap(matches!(token, Token::Period | Token::Elvis), Relaxed);
        match &token {
            Token::Identifier(name) | Token::Reserved(name) if name.as_str() == "call" && !is_method => {
                Token::Identifier(Box::new(CALL_PROGRAM.into()))
            }
            _ => token,
        }
    });
    engine
}

/// The name of the function `call` in a compiled script: the interpreter reserves `call` for function pointers, whose
/// method it remains.
pub(super) const CALL_PROGRAM: &str = "call_program";
