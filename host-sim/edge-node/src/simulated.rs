//! Many simulated nodes in one process, to test brokers and the clients that read from them.
//!
//! Each node has the metrics of a gateway with two field ports. Some values change with each sample, as in a real cell.

use std::cell::RefCell;
use std::io;
use std::rc::Rc;
use std::time::Duration;

use proto_core::time::Duration as CoreDuration;
use recipe_sparkplug::catalog::{Catalog, Metric, Owner, Report};
use recipe_sparkplug::node::{Credential, EdgeNode, NodeCounters, SessionFailure, Settings};
use recipe_sparkplug::topic::Id;
use recipe_sparkplug::value::{DataType, Value};
use tokio::sync::watch;
use tokio::task::LocalSet;

use crate::broker::Broker;
use crate::drive::{Listener, Sampled, Sampler, drive};

/// The nodes to simulate.
#[derive(Debug, Clone)]
pub struct Fleet {
    /// The broker of all nodes.
    pub broker: Broker,
    /// Number of nodes.
    pub nodes: usize,
    /// The group of the nodes, which are called `node-1` and so on.
    pub group: Id,
    /// User and password of all nodes.
    pub login: Option<(Credential, Credential)>,
    /// The time between two samples of a node.
    pub period: Duration,
    /// How long to simulate.
    pub length: Duration,
}

/// Counters of all nodes together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Nodes that are online.
    pub online: usize,
    /// Connections that the broker accepted.
    pub sessions: u64,
    /// Births of nodes.
    pub births: u64,
    /// Births of nodes that were requested by a command.
    pub rebirths: u64,
    /// Data messages.
    pub data: u64,
    /// Values that were published late.
    pub historical: u64,
    /// Values that were never published.
    pub lost: u64,
    /// Sessions and attempts that failed.
    pub failures: u64,
}

/// Memory of a node in bytes, without its connection.
pub const NODE_BYTES: usize = size_of::<SimulatedNode>();

type SimulatedNode = EdgeNode<METRICS, 64>;

impl Fleet {
    /// Runs the nodes, and calls `each_second` with the counters so far.
    ///
    /// # Errors
    /// If the runtime cannot be started, or there are too many nodes for their names.
    pub fn run(&self, mut each_second: impl FnMut(Totals)) -> io::Result<Totals> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let local = LocalSet::new();
        local.block_on(&runtime, async {
            let (end, ended) = watch::channel(false);
            let all = Rc::new(RefCell::new(vec![(NodeCounters::default(), false); self.nodes]));
            let mut tasks = tokio::task::JoinSet::new();
            for nth in 0..self.nodes {
                let name = Id::new(&format!("node-{}", nth + 1)).map_err(io::Error::other)?;
                let mut settings = Settings::new(self.group.clone(), name);
                settings.login.clone_from(&self.login);
                let seed = (nth as u64).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                let node = EdgeNode::new(settings, &SimulatedCatalog, None, seed);
                let mut node: Box<SimulatedNode> =
                    Box::new(node.map_err(|error| io::Error::other(format!("{error:?}")))?);
                let (broker, period, ended) = (self.broker.clone(), self.period, ended.clone());
                let mut sampler = SimulatedSampler { random: seed, step: 0, nth, all: Rc::clone(&all) };
                let mut listener = Watched { nth, all: Rc::clone(&all) };
                tasks.spawn_local(async move {
                    // Spreads the samples of the nodes over the period.
                    let offset = period.mul_f64((seed % 1_000) as f64 / 1_000.0);
                    tokio::time::sleep(offset).await;
                    drive(&mut node, &SimulatedCatalog, &broker, period, &mut sampler, &mut listener, ended)
                        .await;
                    sampler.note(node.counters());
                });
            }
            let sum = || {
                let all = all.borrow();
                all.iter().fold(Totals::default(), |sum, (counters, is_online)| Totals {
                    online: sum.online + usize::from(*is_online),
                    sessions: sum.sessions + u64::from(counters.sessions),
                    births: sum.births + u64::from(counters.births),
                    rebirths: sum.rebirths + u64::from(counters.rebirths),
                    data: sum.data + counters.data,
                    historical: sum.historical + counters.historical,
                    lost: sum.lost + counters.lost,
                    failures: sum.failures + u64::from(counters.failures),
                })
            };
            let until = tokio::time::Instant::now() + self.length;
            let mut seconds = tokio::time::interval(Duration::from_secs(1));
            seconds.tick().await;
            while tokio::time::Instant::now() < until {
                seconds.tick().await;
                each_second(sum());
            }
            let totals = sum();
            let _ = end.send(true);
            let _ = tokio::time::timeout(Duration::from_secs(10), async {
                while tasks.join_next().await.is_some() {}
            })
            .await;
            Ok(totals)
        })
    }
}

type All = Rc<RefCell<Vec<(NodeCounters, bool)>>>;

struct SimulatedSampler {
    random: u64,
    step: u64,
    nth: usize,
    all: All,
}

impl SimulatedSampler {
    fn note(&self, counters: NodeCounters) {
        if let Some((known, _)) = self.all.borrow_mut().get_mut(self.nth) {
            *known = counters;
        }
    }
}

impl Sampler for SimulatedSampler {
    async fn sample(&mut self, node: &NodeCounters, values: &mut [Option<Value>]) -> Sampled {
        self.note(*node);
        self.step += 1;
        for (place, value) in values.iter_mut().enumerate() {
            self.random =
                self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            // One value in four changes.
            let is_new = value.is_none() || self.random >> 62 == 0;
            let number = (self.random >> 33) as u32;
            *value = match kind(place) {
                MetricKind::Uptime => Some(Value::UInt64(self.step)),
                MetricKind::Alive => Some(Value::Boolean(true)),
                MetricKind::Word => Some(Value::Word("working")),
                MetricKind::Count if is_new => Some(Value::UInt32(number)),
                MetricKind::Float if is_new => Some(Value::Float(number as f32 / 1_000.0)),
                MetricKind::Count | MetricKind::Float => continue,
            };
        }
        Sampled::Alive(0b11)
    }
}

struct Watched {
    nth: usize,
    all: All,
}

impl Watched {
    fn show(&self, is_online: bool) {
        if let Some((_, known)) = self.all.borrow_mut().get_mut(self.nth) {
            *known = is_online;
        }
    }
}

impl Listener for Watched {
    fn keep(&mut self, _: u8) {}

    fn online(&mut self) {
        self.show(true);
    }

    fn failed(&mut self, _: SessionFailure, _: Option<&io::Error>) {
        self.show(false);
    }
}

/// The metrics of a gateway.
struct SimulatedCatalog;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MetricKind {
    Uptime,
    Alive,
    Word,
    Count,
    Float,
}

/// Number of metrics of the node, and of each of its two devices.
const OF_NODE: usize = 12;
const OF_DEVICE: usize = 10;
const METRICS: usize = OF_NODE + 2 * OF_DEVICE;

/// The owner of a metric, and its number among the metrics of this owner.
fn place_in(place: usize) -> (Owner, usize) {
    match place.checked_sub(OF_NODE) {
        None => (Owner::Node, place),
        Some(rest) => (Owner::Device((rest / OF_DEVICE) as u8), rest % OF_DEVICE),
    }
}

fn kind(place: usize) -> MetricKind {
    match place_in(place) {
        (Owner::Node, 0) => MetricKind::Uptime,
        (Owner::Node, 1 | 2) => MetricKind::Alive,
        (Owner::Node, 3..=5) | (Owner::Device(_), 0) => MetricKind::Word,
        (Owner::Device(_), 1..=3) => MetricKind::Count,
        _ => MetricKind::Float,
    }
}

impl Catalog for SimulatedCatalog {
    fn devices(&self) -> usize {
        2
    }

    fn device(&self, nth: usize) -> &str {
        ["rs485-1", "can-1"].get(nth).copied().unwrap_or_default()
    }

    fn metrics(&self, owner: Owner) -> usize {
        match owner {
            Owner::Node => OF_NODE,
            Owner::Device(_) => OF_DEVICE,
        }
    }

    fn metric(&self, place: usize) -> Option<Metric<'_>> {
        let (owner, nth) = place_in(place);
        let (data_type, folder) = match kind(place) {
            MetricKind::Uptime => (DataType::UInt64, "Node Info/Uptime"),
            MetricKind::Alive => (DataType::Boolean, "port/alive"),
            MetricKind::Word => (DataType::String, "state"),
            MetricKind::Count => (DataType::UInt32, "frames"),
            MetricKind::Float if owner == Owner::Node => (DataType::Float, "controller/RobotState"),
            MetricKind::Float => (DataType::Float, "FloatInputReg"),
        };
        let name = heapless::String::try_from(format!("{folder}/{nth}").as_str()).ok()?;
        Some(Metric { name, data_type, unit: "", range: None, description: "simulated" })
    }

    fn report(&self, _: usize) -> Report {
        Report { dead_band: 0.0, min_interval: CoreDuration::ZERO }
    }
}
