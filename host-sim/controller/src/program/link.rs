//! The thread of a script, and its end of the lock-step with the model.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::Scalar;
use rhai::debugger::{DebuggerCommand, DebuggerEvent};
use rhai::{AST, ASTNode, Array, Dynamic, Engine, EvalAltResult, Expr, FLOAT, INT, Position, Scope, Stmt};

use super::{Answer, CALL_OPERATIONS, Call, End, Progress, SLICE, SLICE_OPERATIONS, Variables, script};

/// An answer with the model's time.
#[derive(Debug)]
pub(super) struct Stamped {
    pub(super) now: Instant,
    pub(super) answer: Answer,
}

/// The thread's end of both channels.
pub(super) struct Link {
    events: SyncSender<Progress>,
    answers: Mutex<Receiver<Stamped>>,
    variables: Arc<Mutex<Variables>>,
    /// When the present slice began, in the model's time, µs.
    slice_began: AtomicU64,
    /// Operations used in this slice.
    spent: AtomicU64,
    /// Operations that one operation counts for: more if the variables are large, because they may be copied.
    charge: AtomicU64,
    /// Operations until the size of the variables is checked again.
    weigh_in: AtomicU64,
    /// A call has returned since the variables were published.
    stale: AtomicBool,
    /// The program must end, or the model is gone. After a function that cannot fail, such as `print`, the
    /// next operation ends the script.
    over: AtomicBool,
}

type Outcome<T> = Result<T, Box<EvalAltResult>>;

/// Runs the script to its end and reports how it ended.
pub(super) fn run(link: Link, ast: &AST) {
    let link = Arc::new(link);
    let engine = register(script::engine(), &link);
    let mut scope = Scope::new();
    let result = engine.run_ast_with_scope(&mut scope, ast);
    link.show(&scope);
    let end = match result {
        Ok(()) => End::Finished,
        Err(error) => match *error {
            EvalAltResult::ErrorTerminated(token, place) if token.is_string() => {
                End::Failed(one_line(&format!("{token} ({place})")))
            }
            EvalAltResult::ErrorTerminated(..) => End::Aborted,
            other => End::Failed(one_line(&other.to_string())),
        },
    };
    // Fails only if the model is gone.
    let _ = link.events.send(Progress::Ended(end));
}

impl Link {
    pub(super) fn new(
        events: SyncSender<Progress>,
        answers: Receiver<Stamped>,
        variables: Arc<Mutex<Variables>>,
        now: Instant,
    ) -> Self {
        Self {
            events,
            answers: Mutex::new(answers),
            variables,
            slice_began: AtomicU64::new(now.as_micros()),
            spent: AtomicU64::new(0),
            charge: AtomicU64::new(1),
            weigh_in: AtomicU64::new(WEIGH_EVERY),
            stale: AtomicBool::new(false),
            over: AtomicBool::new(false),
        }
    }

    /// Hands control to the model until it answers.
    fn call(&self, call: Call) -> Outcome<Answer> {
        self.spend(CALL_OPERATIONS)?;
        let answer = self.exchange(call)?;
        self.stale.store(true, Relaxed);
        Ok(answer)
    }

    /// Counts operations. At the end of the slice the script waits for the next one.
    fn spend(&self, operations: u64) -> Outcome<()> {
        if self.spent.fetch_add(operations, Relaxed) + operations <= SLICE_OPERATIONS {
            return Ok(());
        }
        let until = Instant::from_micros(self.slice_began.load(Relaxed)) + SLICE;
        self.exchange(Call::GiveWay { until }).map(|_| ())
    }

    fn exchange(&self, call: Call) -> Outcome<Answer> {
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
            Answer::Abort => {
                self.over.store(true, Relaxed);
                Err(terminated())
            }
            Answer::Error(message) => Err(message.into()),
            answer => Ok(answer),
        }
    }

    /// The model's answer; `None` if it is gone.
    fn send(&self, call: Call) -> Option<Stamped> {
        self.events.send(Progress::Calling(call)).ok()?;
        self.answers.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
    }

    /// Ends a script whose variables are too large in total. The interpreter limits single values only, and
    /// does not check all limits when an item is added.
    fn weigh(&self, scope: &Scope<'_>) -> Outcome<()> {
        if self.weigh_in.load(Relaxed) > 0 {
            return Ok(());
        }
        self.weigh_in.store(WEIGH_EVERY, Relaxed);
        let mut room = MAX_WEIGHT;
        for (_, _, value) in scope.iter_raw() {
            room = room.saturating_sub(weight(value, room));
        }
        self.charge.store(1 + ((MAX_WEIGHT - room) / ITEMS_AN_OPERATION) as u64, Relaxed);
        if room > 0 {
            return Ok(());
        }
        let token = Dynamic::from(format!("more than {MAX_WEIGHT} items in the variables"));
        Err(Box::new(EvalAltResult::ErrorTerminated(token, Position::NONE)))
    }

    fn show(&self, scope: &Scope<'_>) {
        let mut variables = self.variables.lock().unwrap_or_else(PoisonError::into_inner);
        let mut room = MAX_SHOWN;
        for (name, _, value) in scope.iter_raw() {
            let value = shown(value, &mut room);
            if variables.len() < MAX_SHOWN || variables.contains_key(name) {
                variables.insert(name.to_owned(), value);
            }
        }
    }
}

/// Registers the robot's functions, the bounds on work, and the publication of variables.
fn register(mut engine: Engine, link: &Arc<Link>) -> Engine {
    let with = || Arc::clone(link);

    let l = with();
    // Called for each operation.
    engine.on_progress(move |_| {
        if l.over.load(Relaxed) {
            return Some(Dynamic::UNIT);
        }
        let _ = l.weigh_in.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1));
        l.spend(l.charge.load(Relaxed)).err().map(|_| Dynamic::UNIT)
    });

    // Variables are published after a call has returned and before the next one.
    let l = with();
    #[expect(deprecated, reason = "marked so by its authors only because it may change")]
    engine.register_debugger(
        |_, debugger| debugger,
        move |mut context, event, node, _, _| {
            // A function's exit is reported with a scope that is not the caller's.
            if matches!(event, DebuggerEvent::Start | DebuggerEvent::Step) {
                let name = match node {
                    ASTNode::Stmt(Stmt::FnCall(call, _)) | ASTNode::Expr(Expr::FnCall(call, _)) => {
                        &*call.name
                    }
                    _ => "",
                };
                l.weigh(context.scope_mut())?;
                if l.stale.swap(false, Relaxed) || CALLS.contains(&name) {
                    l.show(context.scope_mut());
                }
            }
            Ok(DebuggerCommand::StepInto)
        },
    );

    let l = with();
    engine.register_fn("comm_recv", move |port: &str| -> Outcome<Array> {
        match l.call(Call::Receive { port: port.to_owned() })? {
            Answer::Frame { id, values } => {
                let id = id.map(|id| match id {
                    CanId::Standard(id) => Dynamic::from(INT::from(id)),
                    CanId::Extended(id) => Dynamic::from(INT::from(id)),
                });
                Ok(id.into_iter().chain(values.into_iter().map(dynamic)).collect())
            }
            _ => Ok(Array::new()),
        }
    });

    let l = with();
    engine.register_fn("comm_send", move |port: &str, values: Array| -> Outcome<bool> {
        let values = numbers(&values)?;
        l.call(Call::Send { port: port.to_owned(), id: None, values }).map(was_sent)
    });
    let l = with();
    engine.register_fn("comm_send", move |port: &str, id: INT, values: Array| -> Outcome<bool> {
        let values = numbers(&values)?;
        l.call(Call::Send { port: port.to_owned(), id: Some(id), values }).map(was_sent)
    });

    let l = with();
    engine.register_fn("get", move |name: &str| -> Outcome<Dynamic> {
        Ok(match l.call(Call::Get { name: name.to_owned() })? {
            Answer::Value(value) => dynamic(value),
            Answer::Bit(on) => Dynamic::from(on),
            _ => Dynamic::UNIT,
        })
    });
    let l = with();
    engine.register_fn("set", move |name: &str, value: Dynamic| -> Outcome<()> {
        let value = number(&value)?;
        l.call(Call::Set { name: name.to_owned(), value }).map(|_| ())
    });

    let l = with();
    engine.register_fn("movej", move |target: Array, speed: Dynamic| -> Outcome<()> {
        let numbers = numbers(&target)?;
        let Ok(target) = <[f64; 6]>::try_from(numbers.as_slice()) else {
            return Err(format!("movej takes 6 joint positions, not {}", numbers.len()).into());
        };
        l.call(Call::MoveJ { target, speed_rad_s: number(&speed)? }).map(|_| ())
    });

    let l = with();
    engine.register_fn("wait_ms", move |time: Dynamic| -> Outcome<()> {
        let ms = number(&time)?;
        if !(0.0..=MAX_WAIT_MS).contains(&ms) {
            return Err(format!("wait_ms takes 0 to {MAX_WAIT_MS} ms, not {ms}").into());
        }
        l.call(Call::Wait(Duration::from_micros((ms * 1_000.0).round() as u64))).map(|_| ())
    });

    let l = with();
    engine.register_fn("log", move |value: Dynamic| -> Outcome<()> {
        l.call(Call::Log(one_line(&value.to_string()))).map(|_| ())
    });
    // `print` and `debug` cannot fail: see `Link::over`.
    let l = with();
    engine.on_print(move |text| {
        let _ = l.call(Call::Log(one_line(text)));
    });
    let l = with();
    engine.on_debug(move |text, _, _| {
        let _ = l.call(Call::Log(one_line(text)));
    });

    // The interpreter's own functions would block the model, or read the machine's clock.
    engine.register_fn("sleep", |_: INT| -> Outcome<()> { Err("sleep: use wait_ms".into()) });
    engine.register_fn("sleep", |_: FLOAT| -> Outcome<()> { Err("sleep: use wait_ms".into()) });
    engine.register_fn("timestamp", || -> Outcome<()> { Err("timestamp: programs have no clock".into()) });
    engine
}

/// What `comm_send` returns (D28).
fn was_sent(answer: Answer) -> bool {
    answer != Answer::Bit(false)
}

/// An error that a script cannot catch.
fn terminated() -> Box<EvalAltResult> {
    Box::new(EvalAltResult::ErrorTerminated(Dynamic::UNIT, Position::NONE))
}

fn number(value: &Dynamic) -> Outcome<f64> {
    if let Ok(whole) = value.as_int() {
        return Ok(whole as f64);
    }
    if let Ok(on) = value.as_bool() {
        return Ok(f64::from(u8::from(on)));
    }
    value.as_float().map_err(|_| format!("a number is needed here, not {value}").into())
}

fn numbers(values: &[Dynamic]) -> Outcome<Vec<f64>> {
    values.iter().map(number).collect()
}

fn dynamic(value: Scalar) -> Dynamic {
    match value {
        Scalar::Float(_) | Scalar::Double(_) => Dynamic::from(value.as_f64() as FLOAT),
        // Every integer type of a recipe fits.
        _ => Dynamic::from(value.as_f64() as INT),
    }
}

/// The value for statistics, with at most `room` items.
fn shown(value: &Dynamic, room: &mut usize) -> serde_json::Value {
    use serde_json::Value;
    if *room == 0 {
        return Value::String("...".to_owned());
    }
    *room -= 1;
    if let Some(items) = value.read_lock::<Array>() {
        return Value::Array(items.iter().map_while(|item| (*room > 0).then(|| shown(item, room))).collect());
    }
    if let Some(map) = value.read_lock::<rhai::Map>() {
        let items =
            map.iter().map_while(|(name, item)| (*room > 0).then(|| (name.to_string(), shown(item, room))));
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

/// Number of items in a value, including itself; a long string counts as several. At most `limit`.
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

/// The text on one line, not too long for a reply.
fn one_line(text: &str) -> String {
    let mut line: String =
        text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(MAX_LINE).collect();
    line.truncate(line.trim_end().len());
    line
}

/// Functions that call the model.
const CALLS: [&str; 7] = ["comm_recv", "comm_send", "get", "set", "movej", "wait_ms", "log"];
/// Maximum number of items in all variables.
const MAX_WEIGHT: usize = 65_536;
/// Operations between two checks of it.
const WEIGH_EVERY: u64 = 1_000;
/// Number of items that can be copied in the time of one operation.
const ITEMS_AN_OPERATION: usize = 16;
const MAX_WAIT_MS: f64 = 1e9;
/// Maximum length of a log line or error text, in characters.
const MAX_LINE: usize = 200;
/// Maximum number of variables and items in statistics.
const MAX_SHOWN: usize = 1_024;
