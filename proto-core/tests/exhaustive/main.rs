//! Every sequence of events up to a depth, in cells that are small enough, against a model of what the
//! gateway promises (docs/architecture.md sections 3, 7 and 9).
//!
//! The depth is short in the dev profile and longer with `--release`; `EXHAUSTIVE_DEPTH` sets it. What
//! takes long to reach is where a search begins: a cell that works, that was silent, that shares a link.
#![allow(unreachable_pub, reason = "one binary")]

#[path = "../rig/mod.rs"]
mod rig;

mod command_cell;
mod driver;
mod orders;
mod recipe_cell;
mod scribe;
mod search;
mod values;

use command_cell::CommandCell;
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

fn start() -> Instant {
    Instant::from_millis(1_000_000)
}

#[test]
fn commands_and_a_bit_by_modbus() {
    use command_cell::Event::*;
    let links = [LinkId::COMMAND, LinkId::URGENT, LinkId::MODBUS].map(Up);
    let first = [Frame(0), Taken(LinkId::MODBUS), Answered];
    let cold = CommandCell::new(start()).after(&[Tick]);
    let working = cold.clone().after(&[Back]).after(&links).after(&[Step; 3]).after(&first);
    let shared = working.clone().after(&[Down(LinkId::URGENT), Step, Taken(LinkId::MODBUS), Answered]);
    let shared = shared.after(&[Down(LinkId::URGENT)]).after(&first);
    // The safe value was asked for twice, and nobody answered.
    let silent = working.clone().after(&[Tick]);
    let unanswered = [Taken(LinkId::MODBUS), Acked(LinkId::MODBUS), Step, Step];
    let silent = silent.after(&unanswered).after(&unanswered).after(&unanswered[..2]);
    let roots = [
        root("working", working, 0),
        root("cold", cold, 1),
        root("shared", shared, 1),
        root("silent", silent, 1),
    ];
    check("commands and a bit by Modbus", &roots, &size((5, 0), (7, 0)));
}

fn recipe_roots(way: Way) -> Vec<Root<RecipeCell>> {
    use recipe_cell::Event::*;
    let cold = RecipeCell::new(way, start()).after(&[Tick]);
    let up = cold.clone().after(&[Back, Up(way.link())]);
    let up = match way {
        Way::Udp => up.after(&[Up(LinkId::STATE), State(0)]),
        Way::UdpBoth => up.after(&[Taken, Up(LinkId::STATE), State(0), Shown(0)]),
        Way::Tcp => up.after(&[Shown(0)]),
    };
    let working = up.after(&[Frame(0), Taken]);
    vec![root("working", working, 0), root("cold", cold, 1)]
}

#[test]
fn a_float_and_a_bit_by_udp() {
    check("a float and a bit by UDP", &recipe_roots(Way::Udp), &size((5, 0), (7, 0)));
}

#[test]
fn a_float_and_a_bit_by_udp_with_frames_back() {
    check("the same with frames back", &recipe_roots(Way::UdpBoth), &size((5, 0), (7, 0)));
}

#[test]
fn a_float_and_a_bit_by_tcp() {
    check("a float and a bit by TCP", &recipe_roots(Way::Tcp), &size((5, 0), (7, 0)));
}
