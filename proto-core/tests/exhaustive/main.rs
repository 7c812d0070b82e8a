//! Every sequence of events up to a depth, in cells that are small enough, against a model of what the
//! gateway promises (docs/architecture.md sections 3, 7 and 9).

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

use command_cell::{CommandCell, Event};
use proto_core::engine::LinkId;
use proto_core::time::Instant;
use search::search;

/// How many events, unless `EXHAUSTIVE_DEPTH` says so.
fn depth(default: usize) -> usize {
    std::env::var("EXHAUSTIVE_DEPTH").map_or(default, |depth| depth.parse().expect("a number of events"))
}

#[test]
fn commands() {
    let cold = CommandCell::new(Instant::from_millis(1_000_000)).after(&[Event::Tick]);
    let up = [LinkId::COMMAND, LinkId::URGENT, LinkId::MODBUS].map(Event::Up);
    let working = cold.clone().after(&[Event::Back]).after(&up).after(&[
        Event::Step,
        Event::Step,
        Event::Step,
        Event::Frame(0),
        Event::Taken(LinkId::MODBUS),
        Event::Answered,
    ]);
    let start = std::time::Instant::now();
    let findings = search(&[cold, working], depth(4), true);
    println!(
        "{} states, {} steps, {} sequences, {:?}",
        findings.states,
        findings.steps,
        findings.sequences,
        start.elapsed()
    );
    for (what, way) in &findings.broken {
        println!("BROKEN {what}\n    {way}");
    }
    assert!(findings.broken.is_empty());
}

fn recipe(way: recipe_cell::Way) {
    use recipe_cell::{Event::*, RecipeCell};
    let cold = RecipeCell::new(way, Instant::from_millis(1_000_000)).after(&[Tick]);
    let mut working = cold.clone().after(&[Back, Up(way.link())]);
    if way != recipe_cell::Way::Tcp {
        working = working.after(&[Up(LinkId::STATE), State(0)]);
    }
    if way == recipe_cell::Way::UdpBoth {
        working = working.after(&[Taken]);
    }
    working = working.after(&[Frame(0), Taken]);
    let start = std::time::Instant::now();
    let findings = search(&[cold, working], depth(4), true);
    println!(
        "{way:?}: {} states, {} steps, {} sequences, {:?}",
        findings.states,
        findings.steps,
        findings.sequences,
        start.elapsed()
    );
    for (what, way) in &findings.broken {
        println!("BROKEN {what}\n    {way}");
    }
    assert!(findings.broken.is_empty());
}
#[test]
fn udp() {
    recipe(recipe_cell::Way::Udp)
}
#[test]
fn udp_both() {
    recipe(recipe_cell::Way::UdpBoth)
}
#[test]
fn tcp() {
    recipe(recipe_cell::Way::Tcp)
}
