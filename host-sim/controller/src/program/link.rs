//! The thread of a script, which runs in lock-step with the model.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};

use proto_core::time::Instant;
use rhai::debugger::{DebuggerCommand, DebuggerEvent};
use rhai::{ASTNode, Array, Dynamic, Engine, EvalAltResult, Expr, Position, Scope, Stmt};

use super::text::described;
use super::{
    CALL_OPERATIONS, Call, CallReply, End, MAX_NESTED, Progress, SLICE, SLICE_OPERATIONS, Script, Variables,
    script,
};

#[derive(Debug)]
pub(super) struct Stamped {
    pub(super) now: Instant,
    pub(super) answer: CallReply,
}

/// The thread's ends of both channels.
pub(super) struct ScriptLink {
    events: SyncSender<Progress>,
    answers: Mutex<Receiver<Stamped>>,
    variables: Arc<Mutex<Variables>>,
    /// Scripts that can be called by name.
    scripts: Vec<Script>,
    /// The scripts that were called and have not returned, outermost first.
    called: Mutex<Vec<String>>,
    /// When the present slice began, in the model's time, µs.
    slice_began: AtomicU64,
    /// Operations used in this slice.
    spent: AtomicU64,
    /// Number of operations that each operation counts for: more with large variables, which it may copy.
    charge: AtomicU64,
    /// Operations until the size of the variables is checked again.
    weigh_in: AtomicU64,
    /// A call has returned since variables were last published.
    stale: AtomicBool,
    /// The program must end, or the model is gone. After a function that cannot fail, such as `print`, the next
    /// operation ends the script.
    over: AtomicBool,
}

/// Functions that call the model, by their names in a compiled script.
const CALLS: [&str; 9] =
    ["comm_recv", "comm_send", "get", "set", "movej", "movel", "wait_ms", script::CALL_PROGRAM, "log"];

pub(super) type ScriptResult<T> = Result<T, Box<EvalAltResult>>;

impl ScriptLink {
    pub(super) fn new(
        events: SyncSender<Progress>,
        answers: Receiver<Stamped>,
        variables: Arc<Mutex<Variables>>,
        scripts: Vec<Script>,
        now: Instant,
    ) -> Self {
        Self {
            events,
            answers: Mutex::new(answers),
            variables,
            scripts,
            called: Mutex::new(Vec::new()),
            slice_began: AtomicU64::new(now.as_micros()),
            spent: AtomicU64::new(0),
            charge: AtomicU64::new(1),
            weigh_in: AtomicU64::new(WEIGH_EVERY),
            stale: AtomicBool::new(false),
            over: AtomicBool::new(false),
        }
    }

    pub(super) fn end(&self, scope: &Scope<'_>, result: ScriptResult<()>) {
        self.show(scope);
        let end = match result {
            Ok(()) => End::Finished,
            Err(error) if is_abort(&error) => End::Aborted,
            Err(error) => End::Failed(described(*error)),
        };
        // Fails only if the model is gone.
        let _ = self.events.send(Progress::Ended(end));
    }

    /// Hands control to the model until the model replies.
    pub(super) fn call(&self, call: Call) -> ScriptResult<CallReply> {
        self.spend(CALL_OPERATIONS)?;
        let answer = self.exchange(call)?;
        self.stale.store(true, Relaxed);
        Ok(answer)
    }

    /// Runs another script, with its own variables, to its end.
    pub(super) fn run_other(&self, engine: &Engine, name: &str) -> ScriptResult<()> {
        self.spend(CALL_OPERATIONS)?;
        let Some(script) = script::named(&self.scripts, name) else {
            let names: Vec<_> = self.scripts.iter().map(Script::name).collect();
            return Err(format!("call: there is no program {name}; there are {}", names.join(", ")).into());
        };
        {
            let mut called = self.called.lock().unwrap_or_else(PoisonError::into_inner);
            if called.len() >= MAX_NESTED {
                let text =
                    format!("call: {name}: more than {MAX_NESTED} programs would wait for one another");
                return Err(text.into());
            }
            called.push(script.name().to_owned());
        }
        let mut scope = Scope::new();
        let result = engine.run_ast_with_scope(&mut scope, &script.ast());
        self.show(&scope);
        self.called.lock().unwrap_or_else(PoisonError::into_inner).pop();
        self.stale.store(true, Relaxed);
        let Err(error) = result else { return Ok(()) };
        if is_abort(&error) {
            return Err(error);
        }
        let can_be_caught = error.is_catchable();
        let text = format!("in {}: {}", script.name(), described(*error));
        if can_be_caught {
            Err(text.into())
        } else {
            Err(Box::new(EvalAltResult::ErrorTerminated(text.into(), Position::NONE)))
        }
    }

    /// Counts operations. When the slice is used up, waits for the next slice.
    fn spend(&self, operations: u64) -> ScriptResult<()> {
        if self.spent.fetch_add(operations, Relaxed) + operations <= SLICE_OPERATIONS {
            return Ok(());
        }
        let until = Instant::from_micros(self.slice_began.load(Relaxed)) + SLICE;
        self.exchange(Call::GiveWay { until }).map(|_| ())
    }

    fn exchange(&self, call: Call) -> ScriptResult<CallReply> {
        if self.over.load(Relaxed) {
            return Err(terminated());
        }
        let Some(Stamped { now, answer }) = self.send(call) else {
            self.over.store(true, Relaxed);
            return Err(terminated());
        };
        if now >= Instant::from_micros(self.slice_began.load(Relaxed)) + SLICE {
            self.slice_began.store(now.as_micros(), Relaxed);
            self.spent.store(0, Relaxed);
        }
        match answer {
            CallReply::Abort => {
                self.over.store(true, Relaxed);
                Err(terminated())
            }
            CallReply::Error(message) => Err(message.into()),
            answer => Ok(answer),
        }
    }

    /// The model's reply; `None` if the model is gone.
    fn send(&self, call: Call) -> Option<Stamped> {
        self.events.send(Progress::Calling(call)).ok()?;
        self.answers.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
    }

    /// Ends a script whose variables are too large in total. The interpreter only limits single values, and does not
    /// check all limits when an item is added.
    fn weigh(&self, scope: &Scope<'_>, place: Position) -> ScriptResult<()> {
        if self.weigh_in.load(Relaxed) > 0 {
            return Ok(());
        }
        self.weigh_in.store(WEIGH_EVERY, Relaxed);
        let mut budget = MAX_WEIGHT;
        for (_, _, value) in scope.iter_raw() {
            budget = budget.saturating_sub(weight(value, budget));
        }
        self.charge.store(1 + ((MAX_WEIGHT - budget) / ITEMS_AN_OPERATION) as u64, Relaxed);
        if budget > 0 {
            return Ok(());
        }
        let token = Dynamic::from(format!("more than {MAX_WEIGHT} items in the variables"));
        Err(Box::new(EvalAltResult::ErrorTerminated(token, place)))
    }

    fn show(&self, scope: &Scope<'_>) {
        let called = self.called.lock().unwrap_or_else(PoisonError::into_inner).last().cloned();
        let mut variables = self.variables.lock().unwrap_or_else(PoisonError::into_inner);
        let mut budget = MAX_SHOWN;
        for (name, _, value) in scope.iter_raw() {
            let value = shown(value, &mut budget);
            let name = called.as_ref().map_or_else(|| name.to_owned(), |script| format!("{script}: {name}"));
            if variables.len() < MAX_SHOWN || variables.contains_key(&name) {
                variables.insert(name, value);
            }
        }
    }
}

/// Installs the limits on work and the publication of variables.
pub(super) fn watch(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    // Called for each operation.
    engine.on_progress(move |_| {
        if l.over.load(Relaxed) {
            return Some(Dynamic::UNIT);
        }
        let _ = l.weigh_in.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1));
        l.spend(l.charge.load(Relaxed)).err().map(|_| Dynamic::UNIT)
    });

    // Variables are published after a call has returned and before the next one.
    let l = Arc::clone(link);
    #[expect(deprecated, reason = "marked so by its authors only because it may change")]
    engine.register_debugger(
        |_, debugger| debugger,
        move |mut context, event, node, _, place| {
            // At the exit of a function, the scope is not the caller's.
            if matches!(event, DebuggerEvent::Start | DebuggerEvent::Step) {
                let name = match node {
                    ASTNode::Stmt(Stmt::FnCall(call, _)) | ASTNode::Expr(Expr::FnCall(call, _)) => {
                        &*call.name
                    }
                    _ => "",
                };
                l.weigh(context.scope_mut(), place)?;
                if l.stale.swap(false, Relaxed) || CALLS.contains(&name) {
                    l.show(context.scope_mut());
                }
            }
            Ok(DebuggerCommand::StepInto)
        },
    );
}

/// An error that a script cannot catch.
fn terminated() -> Box<EvalAltResult> {
    Box::new(EvalAltResult::ErrorTerminated(Dynamic::UNIT, Position::NONE))
}

/// Whether the model has ended the script. Other errors that cannot be caught have a text.
fn is_abort(error: &EvalAltResult) -> bool {
    match error {
        EvalAltResult::ErrorTerminated(token, _) => !token.is_string(),
        EvalAltResult::ErrorInFunctionCall(_, _, inner, _) => is_abort(inner),
        _ => false,
    }
}

/// A value as JSON for statistics, with at most `budget` items.
fn shown(value: &Dynamic, budget: &mut usize) -> serde_json::Value {
    use serde_json::Value;
    if *budget == 0 {
        return Value::String("...".to_owned());
    }
    *budget -= 1;
    if let Some(items) = value.read_lock::<Array>() {
        return Value::Array(
            items.iter().map_while(|item| (*budget > 0).then(|| shown(item, budget))).collect(),
        );
    }
    if let Some(map) = value.read_lock::<rhai::Map>() {
        let items = map
            .iter()
            .map_while(|(name, item)| (*budget > 0).then(|| (name.to_string(), shown(item, budget))));
        return Value::Object(items.collect());
    }
    if let Ok(whole) = value.as_int() {
        Value::from(whole)
    } else if let Ok(number) = value.as_float() {
        Value::from(number)
    } else if let Ok(on) = value.as_bool() {
        Value::from(on)
    } else if value.is_unit() {
        Value::Null
    } else {
        Value::String(value.to_string())
    }
}

/// Number of items in a value, including itself, but at most `limit`; a long string counts as several.
fn weight(value: &Dynamic, limit: usize) -> usize {
    let mut sum = 1;
    if let Some(items) = value.read_lock::<Array>() {
        for item in items.iter() {
            if sum >= limit {
                break;
            }
            sum += weight(item, limit - sum);
        }
    } else if let Some(map) = value.read_lock::<rhai::Map>() {
        for item in map.values() {
            if sum >= limit {
                break;
            }
            sum += weight(item, limit - sum);
        }
    } else if let Some(blob) = value.read_lock::<rhai::Blob>() {
        sum += blob.len() / 16;
    } else if let Some(text) = value.read_lock::<rhai::ImmutableString>() {
        sum += text.len() / 16;
    }
    sum.min(limit)
}

/// Maximum number of items in all variables.
const MAX_WEIGHT: usize = 65_536;
/// Number of operations between two checks of the total.
const WEIGH_EVERY: u64 = 1_000;
/// Number of items that can be copied in the time of one operation.
const ITEMS_AN_OPERATION: usize = 16;
/// Maximum number of variables and items in statistics.
const MAX_SHOWN: usize = 1_024;
