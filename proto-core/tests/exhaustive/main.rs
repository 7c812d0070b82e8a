//! Every sequence of events up to a depth, in cells that are small enough, against a model of what the
//! gateway promises (docs/engine.md sections 2, 5, 6, 7 and 9).
//!
//! The depth is short in the dev profile and longer with `--release`; `EXHAUSTIVE_DEPTH` sets it. What
//! takes long to reach is where a search begins: a cell that works, that was silent, that shares a link.
#![allow(unreachable_pub, reason = "one binary")]

#[path = "../rig/mod.rs"]
mod rig;

mod command_cell;
mod command_judge;
mod driver;
mod exchange_cell;
mod exchange_judge;
mod orders;
mod recipe_cell;
mod recipe_judge;
mod scribe;
mod search;
mod values;

use command_cell::CommandCell;
use exchange_cell::{Adapter, ExchangeCell};
use proto_core::engine::LinkId;
use proto_core::time::Instant;
use recipe_cell::{RecipeCell, Way};
use search::{Root, World, search};

/// How many events, and how many states there are at least in so many.
struct Size {
    depth: usize,
    states: usize,
}

const fn size(dev: (usize, usize), release: (usize, usize)) -> Size {
    let (depth, states) = if cfg!(debug_assertions) { dev } else { release };
    Size { depth, states }
}

#[track_caller]
fn check<W: World>(name: &str, roots: &[Root<W>], size: &Size) {
    let wanted = std::env::var("EXHAUSTIVE_DEPTH").ok();
    let depth = wanted.map_or(size.depth, |depth| depth.parse().expect("a number of events"));
    let findings = search(roots, depth, true);
    let (states, steps, sequences) = (findings.states, findings.steps, findings.sequences);
    println!("{name}, {depth} events: {sequences} sequences, {states} states, {steps} steps");
    let broken: Vec<String> =
        findings.broken.iter().map(|(what, way)| format!("{what}\n    {way}")).collect();
    assert!(broken.is_empty(), "the gateway\n{}", broken.join("\n"));
    assert!(
        depth != size.depth || states >= size.states,
        "only {states} states: what is not tried any more?"
    );
}

fn root<W>(name: &'static str, world: W, spared: usize) -> Root<W> {
    Root { name, world, spared }
}

/// Late enough that nothing is as old as the clock.
const START: Instant = Instant::from_millis(1_000_000);

fn command_roots(start: Instant) -> Vec<Root<CommandCell>> {
    use command_cell::Event::*;
    let links = [LinkId::COMMAND, LinkId::URGENT, LinkId::MODBUS].map(Up);
    let first = [Frame(0), Taken(LinkId::MODBUS), Answered];
    let cold = CommandCell::new(start).after(&[Tick]);
    let working = cold.clone().after(&[Back]).after(&links).after(&[Step; 3]).after(&first);
    let shared = working.clone().after(&[Down(LinkId::URGENT), Step, Taken(LinkId::MODBUS), Answered]);
    let shared = shared.after(&[Down(LinkId::URGENT)]).after(&first);
    // The safe value was asked for twice, and nobody answered.
    let silent = working.clone().after(&[Tick]);
    let unanswered = [Taken(LinkId::MODBUS), Acked(LinkId::MODBUS), Step, Step];
    let silent = silent.after(&unanswered).after(&unanswered).after(&unanswered[..2]);
    let command = [Frame(2), Taken(LinkId::COMMAND), Acked(LinkId::COMMAND), Taken(LinkId::MODBUS), Answered];
    let busy = working.clone().after(&command).after(&first);
    // A command is given up after 10 s.
    let unanswered = busy.clone().after(&[Tick, Taken(LinkId::MODBUS), Answered]);
    let unanswered = unanswered.after(&[Step; 21]).after(&first);
    // Both are unanswered on the connection that is left.
    let beside = shared.clone().after(&command).after(&[Frame(3), Taken(LinkId::COMMAND)]);
    let beside = beside.after(&[Taken(LinkId::MODBUS), Answered]);
    // A stop that is not answered, and is asked for again; and the same where there is one connection.
    let stop = |link| [Frame(3), Taken(link), Acked(link), Frame(0)];
    let stopping = working.clone().after(&stop(LinkId::URGENT)).after(&[Frame(3)]);
    let mute = shared.clone().after(&stop(LinkId::COMMAND)).after(&[Frame(3), Steady, Steady, Steady]);
    let mute = mute.after(&[Taken(LinkId::COMMAND), Acked(LinkId::COMMAND)]);
    vec![
        root("working", working, 0),
        root("cold", cold, 1),
        root("stopping", stopping, 1),
        root("mute", mute, 1),
        root("shared", shared, 1),
        root("silent", silent, 1),
        root("busy", busy, 1),
        root("unanswered", unanswered, 1),
        root("beside", beside, 1),
    ]
}

#[test]
fn commands_and_a_bit_by_modbus() {
    let roots = command_roots(START);
    check("commands and a bit by Modbus", &roots, &size((5, 25_000), (7, 1_220_000)));
}

fn recipe_roots(way: Way, start: Instant) -> Vec<Root<RecipeCell>> {
    use recipe_cell::Event::*;
    let cold = RecipeCell::new(way, start).after(&[Tick]);
    let up = cold.clone().after(&[Back, Up(way.link())]);
    let up = match way {
        Way::Udp => up.after(&[Up(LinkId::STATE), State(0)]),
        Way::UdpBoth => up.after(&[Taken, Up(LinkId::STATE), State(0), Shown(0)]),
        Way::Held => up.after(&[Taken, Up(LinkId::STATE), State(0), Shown(0), Frame(1)]),
        Way::Tcp => up.after(&[Shown(0)]),
    };
    let working = up.after(&[Frame(0), Taken]);
    let silent = working.clone().after(&[Tick, Tick]);
    let mut roots =
        vec![root("working", working.clone(), 0), root("cold", cold, 1), root("silent", silent, 1)];
    if way == Way::Tcp {
        // One more frame can be handed over before some are acknowledged.
        let full = working.clone().after(&[Frame(0), Taken].repeat(62));
        roots.push(root("full", full, 1));
    }
    if way == Way::Held {
        // The float's owner is silent beside the bit's; so is the controller then.
        let alone = working.clone().after(&[Frame(1), Taken, Steady, Taken]);
        let gap = alone.clone().after(&[Steady, Taken]);
        // Both are silent, and the controller talks, though not by the state stream.
        let long = (0..3).fold(working, |cell, _| cell.after(&[Step, Taken, Shown(0)]));
        roots.push(root("alone", alone.after(&[Shown(0)]), 1));
        roots.push(root("gap", gap, 1));
        roots.push(root("long", long, 1));
    }
    roots
}

#[test]
fn a_float_and_a_bit_by_udp() {
    check("a float and a bit by UDP", &recipe_roots(Way::Udp, START), &size((5, 11_000), (7, 510_000)));
}

#[test]
fn a_float_and_a_bit_by_udp_with_frames_back() {
    check("the same with frames back", &recipe_roots(Way::UdpBoth, START), &size((5, 15_800), (7, 910_000)));
}

#[test]
fn a_float_that_is_held_and_a_bit_by_udp() {
    check("a float that is held by UDP", &recipe_roots(Way::Held, START), &size((5, 13_800), (7, 740_000)));
}

#[test]
fn a_float_and_a_bit_by_tcp() {
    check("a float and a bit by TCP", &recipe_roots(Way::Tcp, START), &size((5, 4_900), (7, 122_000)));
}

fn exchange_roots(adapter: Adapter, start: Instant) -> Vec<Root<ExchangeCell>> {
    use exchange_cell::Event::*;
    use exchange_judge::Answer::Good;
    let cold = ExchangeCell::new(adapter, start).after(&[Tick]);
    let working = cold.clone().after(&[Back, Up, Frame(0)]).after(&[Step; 5]);
    let working = working.after(&[Newest(Good), Newest(Good), Frame(0)]);
    // The first register is asked.
    let asked = working.clone().after(&[Step, Step, Step]);
    // A rise waits for that.
    let rising = asked.clone().after(&[Frame(0), Frame(1)]);
    // It was asked twice in vain, and both replies may come.
    let outstanding = asked.clone().after(&[Step; 4]).after(&[Frame(0)]);
    // The slave has started, and did not say so.
    let started = working.clone().after(&[Frame(1), Step, Step, Frame(0)]);
    // Nobody confirms the stop.
    let stopping = working.clone().after(&[Frame(3)]).after(&[Step; 4]);
    // Neither register was answered, for long.
    let away = (0..10).fold(outstanding.clone(), |cell, _| cell.after(&[Step, Step, Frame(0)]));
    vec![
        root("working", working, 0),
        root("cold", cold, 1),
        root("rising", rising, 1),
        root("outstanding", outstanding, 1),
        root("started", started, 1),
        root("stopping", stopping, 1),
        root("away", away, 1),
    ]
}

#[test]
fn a_slave_that_is_read_started_and_stopped() {
    check("a slave", &exchange_roots(Adapter::Silent, START), &size((5, 7_800), (6, 45_500)));
}

#[test]
fn a_slave_behind_an_adapter_that_echoes() {
    check("a slave with echo", &exchange_roots(Adapter::Echoes, START), &size((4, 1_150), (6, 48_000)));
}

#[track_caller]
fn compare<W: World>(roots: &[Root<W>], later: &[Root<W>]) {
    for (root, later) in roots.iter().zip(later) {
        let name = root.name;
        assert_eq!(
            root.world.fingerprint(1),
            later.world.fingerprint(2),
            "{name}: an hour makes no difference"
        );
        for event in root.world.events() {
            let mut next = root.world.clone();
            next.happen(event).expect("the other tests tell");
            let mut again = later.world.clone();
            again.happen(event).expect("the other tests tell");
            assert_eq!(next.fingerprint(1), again.fingerprint(2), "{name}, {event:?}: nor does it then");
        }
    }
    // What merges states must not hide that they differ in what can happen, or in what is broken.
    let depth = if cfg!(debug_assertions) { 3 } else { 5 };
    let (merged, apart) = (search(roots, depth, true), search(roots, depth, false));
    assert_eq!(merged.sequences, apart.sequences);
    assert_eq!(merged.broken, apart.broken);
    assert!(merged.states < apart.states);
}

#[test]
fn states_that_are_merged_behave_alike() {
    let later = START + proto_core::time::Duration::from_secs(3600);
    compare(&command_roots(START), &command_roots(later));
    for way in [Way::Udp, Way::UdpBoth, Way::Held, Way::Tcp] {
        compare(&recipe_roots(way, START), &recipe_roots(way, later));
    }
    for adapter in [Adapter::Silent, Adapter::Echoes] {
        compare(&exchange_roots(adapter, START), &exchange_roots(adapter, later));
    }
}
