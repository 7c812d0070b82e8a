//! The functions that a script calls (docs/simulated-controller.md section 4).

use std::sync::Arc;

use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::Scalar;
use rhai::{Array, Dynamic, Engine, FLOAT, INT, NativeCallContext};

use super::link::{ScriptLink, ScriptResult};
use super::script::CALL_PROGRAM;
use super::text::one_line;
use super::{Call, CallReply};

pub(super) fn register(engine: &mut Engine, link: &Arc<ScriptLink>) {
    register_ports(engine, link);
    register_items(engine, link);
    register_moves(engine, link);
    register_flow(engine, link);
    register_log(engine, link);
}

fn register_ports(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    engine.register_fn("comm_recv", move |port: &str| -> ScriptResult<Array> {
        l.call(Call::Receive { port: port.to_owned(), limit: None }).map(frame)
    });
    let l = Arc::clone(link);
    engine.register_fn("comm_recv", move |port: &str, seconds: Dynamic| -> ScriptResult<Array> {
        let limit = span("comm_recv", number(&seconds)?, "s", 1_000_000.0)?;
        l.call(Call::Receive { port: port.to_owned(), limit: Some(limit) }).map(frame)
    });
    let l = Arc::clone(link);
    engine.register_fn("comm_send", move |port: &str, values: Array| -> ScriptResult<bool> {
        let values = numbers(&values)?;
        l.call(Call::Send { port: port.to_owned(), id: None, values }).map(was_sent)
    });
    let l = Arc::clone(link);
    engine.register_fn("comm_send", move |port: &str, id: INT, values: Array| -> ScriptResult<bool> {
        let values = numbers(&values)?;
        l.call(Call::Send { port: port.to_owned(), id: Some(id), values }).map(was_sent)
    });
}

fn register_items(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    engine.register_fn("get", move |name: &str| -> ScriptResult<Dynamic> {
        Ok(match l.call(Call::Get { name: name.to_owned() })? {
            CallReply::Value(value) => dynamic(value),
            CallReply::Bit(on) => Dynamic::from(on),
            _ => Dynamic::UNIT,
        })
    });
    let l = Arc::clone(link);
    engine.register_fn("set", move |name: &str, value: Dynamic| -> ScriptResult<()> {
        let value = number(&value)?;
        l.call(Call::Set { name: name.to_owned(), value }).map(|_| ())
    });
}

fn register_moves(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    engine.register_fn("movej", move |target: Array, speed: Dynamic| -> ScriptResult<()> {
        let target = six("movej", "joint positions", &target)?;
        l.call(Call::MoveJ { target, speed_rad_s: number(&speed)? }).map(|_| ())
    });
    let l = Arc::clone(link);
    engine.register_fn("movel", move |target: Array, speed: Dynamic| -> ScriptResult<()> {
        let pose = six("movel", "values of a pose", &target)?;
        l.call(Call::MoveL { pose, speed_m_s: number(&speed)? }).map(|_| ())
    });
}

fn register_flow(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    engine.register_fn("wait_ms", move |time: Dynamic| -> ScriptResult<()> {
        l.call(Call::Wait(span("wait_ms", number(&time)?, "ms", 1.0e3)?)).map(|_| ())
    });
    let l = Arc::clone(link);
    engine.register_fn(CALL_PROGRAM, move |context: NativeCallContext<'_>, name: &str| -> ScriptResult<()> {
        l.run_other(context.engine(), name)
    });
    engine.register_fn("raise", |reason: Dynamic| -> ScriptResult<()> { Err(reason.to_string().into()) });
    // The interpreter's own functions would block the model or read the machine's clock.
    engine.register_fn("sleep", |_: INT| -> ScriptResult<()> { Err("sleep: use wait_ms".into()) });
    engine.register_fn("sleep", |_: FLOAT| -> ScriptResult<()> { Err("sleep: use wait_ms".into()) });
    engine
        .register_fn("timestamp", || -> ScriptResult<()> { Err("timestamp: programs have no clock".into()) });
}

fn register_log(engine: &mut Engine, link: &Arc<ScriptLink>) {
    let l = Arc::clone(link);
    engine.register_fn("log", move |value: Dynamic| -> ScriptResult<()> {
        l.call(Call::Log(one_line(&value.to_string()))).map(|_| ())
    });
    // Overrides the interpreter's logarithm, which would be the better match for a float.
    let l = Arc::clone(link);
    engine.register_fn("log", move |value: FLOAT| -> ScriptResult<()> {
        l.call(Call::Log(Dynamic::from(value).to_string())).map(|_| ())
    });
    // `print` and `debug` cannot fail: see `ScriptLink::over`.
    let l = Arc::clone(link);
    engine.on_print(move |text| {
        let _ = l.call(Call::Log(one_line(text)));
    });
    let l = Arc::clone(link);
    engine.on_debug(move |text, _, _| {
        let _ = l.call(Call::Log(one_line(text)));
    });
}

/// The result of `comm_recv`: the list of values, on CAN after the id; empty if no frame came.
fn frame(answer: CallReply) -> Array {
    let CallReply::Frame { id, values } = answer else { return Array::new() };
    let id = id.map(|id| match id {
        CanId::Standard(id) => Dynamic::from(INT::from(id)),
        CanId::Extended(id) => Dynamic::from(INT::from(id)),
    });
    id.into_iter().chain(values.into_iter().map(dynamic)).collect()
}

/// The result of `comm_send` (D28).
fn was_sent(answer: CallReply) -> bool {
    answer != CallReply::Bit(false)
}

/// A time in units of `unit_us` µs, at most 1e6 s.
fn span(function: &str, value: f64, unit: &str, unit_us: f64) -> ScriptResult<Duration> {
    let most = MAX_WAIT_US / unit_us;
    if (0.0..=most).contains(&value) {
        return Ok(Duration::from_micros((value * unit_us).round() as u64));
    }
    Err(format!("{function} takes 0 to {most} {unit}, not {value}").into())
}

fn six(function: &str, what: &str, values: &[Dynamic]) -> ScriptResult<[f64; 6]> {
    let values = numbers(values)?;
    <[f64; 6]>::try_from(values.as_slice())
        .map_err(|_| format!("{function} takes 6 {what}, not {}", values.len()).into())
}

fn number(value: &Dynamic) -> ScriptResult<f64> {
    if let Ok(whole) = value.as_int() {
        return Ok(whole as f64);
    }
    if let Ok(on) = value.as_bool() {
        return Ok(f64::from(u8::from(on)));
    }
    value.as_float().map_err(|_| format!("a number is needed here, not {value}").into())
}

fn numbers(values: &[Dynamic]) -> ScriptResult<Vec<f64>> {
    values.iter().map(number).collect()
}

fn dynamic(value: Scalar) -> Dynamic {
    match value {
        Scalar::Float(_) | Scalar::Double(_) => Dynamic::from(value.as_f64() as FLOAT),
        // Every integer type of a recipe fits.
        _ => Dynamic::from(value.as_f64() as INT),
    }
}

const MAX_WAIT_US: f64 = 1e12;
