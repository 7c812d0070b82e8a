//! Every sequence of events up to a depth, breadth first, states that were seen before left out.
//!
//! In: a world with its events, and where to begin. Out: how many states and sequences that were, and
//! what was broken, each with the shortest sequence that leads there.

use std::collections::HashMap;
use std::fmt::Debug;

use crate::driver::Broken;

pub trait World: Clone {
    type Event: Copy + Debug + PartialEq;
    /// What can happen now.
    fn events(&self) -> Vec<Self::Event>;
    /// It happens; afterwards the engine has nothing more to do.
    fn happen(&mut self, event: Self::Event) -> Result<(), Broken>;
    /// The same for worlds that behave alike from now on; `unique` differs in every call.
    fn fingerprint(&self, unique: u64) -> u64;

    /// The same after these events.
    #[track_caller]
    fn after(mut self, events: &[Self::Event]) -> Self {
        for (nth, &event) in events.iter().enumerate() {
            assert!(self.events().contains(&event), "{event:?}, number {nth}, cannot happen");
            self.happen(event).unwrap_or_else(|broken| panic!("{event:?}, number {nth}: {broken}"));
        }
        self
    }
}

/// What a search came to.
#[derive(Debug)]
pub struct Findings {
    /// Different states, those at the last depth apart.
    pub states: usize,
    /// Events that were tried.
    pub steps: usize,
    /// Sequences of as many events as the depth allows, those that run through states that were known
    /// included; shorter ones are the beginnings of these.
    pub sequences: u128,
    /// What was broken, and the shortest sequence to it.
    pub broken: Vec<(Broken, String)>,
}

/// A state, by how it was reached first.
struct Node<E> {
    parent: u32,
    event: Option<E>,
    /// Where the states behind each of its events stand in the list of steps.
    steps: std::ops::Range<u32>,
}

/// The worlds on the way to one state, so that the next state nearby need not begin anew.
struct Path<W: World>(Vec<(u32, W)>);

/// Different ways to break something that are worth telling.
const MOST_BROKEN: usize = 12;

impl<W: World> Path<W> {
    /// The world of a state.
    fn to(&mut self, nodes: &[Node<W::Event>], roots: &[Root<W>], state: u32) -> W {
        let mut way = vec![state];
        loop {
            let last = way[way.len() - 1];
            if let Some(known) = self.0.iter().rposition(|(at, _)| *at == last) {
                self.0.truncate(known + 1);
                break;
            }
            if nodes[last as usize].event.is_none() {
                self.0 = vec![(last, roots[last as usize].world.clone())];
                break;
            }
            way.push(nodes[last as usize].parent);
        }
        way.pop();
        while let Some(next) = way.pop() {
            let mut world = self.0.last().expect("a root at least").1.clone();
            let event = nodes[next as usize].event.expect("not a root");
            world.happen(event).expect("it was done before");
            self.0.push((next, world));
        }
        self.0.last().expect("a root at least").1.clone()
    }
}

/// Where a search begins, and how much less deep than from elsewhere it goes.
pub struct Root<W> {
    pub name: &'static str,
    pub world: W,
    pub spared: usize,
}

/// Runs everything. With `merges`, states with the same fingerprint are one.
pub fn search<W: World>(roots: &[Root<W>], depth: usize, merges: bool) -> Findings {
    let mut nodes: Vec<Node<W::Event>> = Vec::new();
    let mut known: HashMap<u64, u32> = HashMap::new();
    let mut targets: Vec<u32> = Vec::new();
    let mut broken: Vec<(Broken, String)> = Vec::new();
    // Roots stand at the front, so that their places are those of their worlds.
    nodes.extend(roots.iter().map(|_| Node { parent: 0, event: None, steps: 0..0 }));
    let mut level = 0..0;
    let mut path = Path(Vec::new());
    for left in (0..depth).rev() {
        let begins = |nth: &usize| roots[*nth].spared == depth - 1 - left;
        for state in (0..roots.len()).filter(begins).chain(level.clone()) {
            let world = path.to(&nodes, roots, state as u32);
            let start = targets.len() as u32;
            for event in world.events() {
                let mut next = world.clone();
                let target = match next.happen(event) {
                    Err(what) => {
                        if !broken.iter().any(|(other, _)| *other == what) && broken.len() < MOST_BROKEN {
                            broken.push((what, way_to(&nodes, roots, state, event)));
                        }
                        continue;
                    }
                    // What is behind it is not looked at.
                    Ok(()) if left == 0 => u32::MAX,
                    Ok(()) => {
                        let unique = targets.len() as u64 + 1;
                        let print = if merges { next.fingerprint(unique) } else { unique };
                        let new = nodes.len() as u32;
                        let target = *known.entry(print).or_insert(new);
                        if target == new {
                            nodes.push(Node { parent: state as u32, event: Some(event), steps: 0..0 });
                        }
                        target
                    }
                };
                targets.push(target);
            }
            nodes[state].steps = start..targets.len() as u32;
        }
        level = level.end.max(roots.len())..nodes.len();
    }
    let sequences = count(&nodes, &targets, roots, depth);
    Findings { states: nodes.len(), steps: targets.len(), sequences, broken }
}

/// Sequences of `depth` events from the roots.
fn count<W: World>(nodes: &[Node<W::Event>], targets: &[u32], roots: &[Root<W>], depth: usize) -> u128 {
    // Of each state, the sequences of 0, 1, 2.. events that begin there.
    let mut longer = vec![1_u128; nodes.len()];
    let mut sequences = 0;
    for length in 1..=depth {
        let ways = |node: &Node<W::Event>| {
            let targets = &targets[node.steps.start as usize..node.steps.end as usize];
            targets.iter().map(|&target| longer.get(target as usize).copied().unwrap_or(1)).sum()
        };
        longer = nodes.iter().map(ways).collect();
        let whole = |(root, _): &(&Root<W>, &u128)| root.spared == depth - length;
        sequences += roots.iter().zip(&longer).filter(whole).map(|(_, ways)| ways).sum::<u128>();
    }
    sequences
}

fn way_to<W: World>(nodes: &[Node<W::Event>], roots: &[Root<W>], state: usize, last: W::Event) -> String {
    let mut way = vec![format!("{last:?}")];
    let mut at = state;
    while let Some(event) = nodes[at].event {
        way.push(format!("{event:?}"));
        at = nodes[at].parent as usize;
    }
    way.push(roots[at].name.to_owned());
    way.reverse();
    way.join(", ")
}
