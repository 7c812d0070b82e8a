//! What an edge node publishes: its devices and its metrics.
//!
//! A catalog is fixed for the lifetime of a node; another catalog needs another node with another session. The places
//! of metrics count from 0: first the metrics of the node itself, then those of each device, without gaps.

use heapless::String;
use proto_core::time::Duration;

use crate::value::DataType;

/// The longest name of a metric in bytes.
pub const MAX_NAME: usize = 96;

/// Maximum number of devices of a node.
pub const MAX_DEVICES: usize = 32;

/// The owner of a metric or a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The node itself.
    Node,
    /// The device with this number, from 0.
    Device(u8),
}

/// What a birth message says about a metric.
#[derive(Debug, Clone, PartialEq)]
pub struct Metric<'a> {
    /// Its name, unique among the metrics of its owner; `/` separates folders.
    pub name: String<MAX_NAME>,
    /// Its type.
    pub data_type: DataType,
    /// Its unit, or empty.
    pub unit: &'a str,
    /// The lowest and the highest value, if they are known.
    pub range: Option<(f64, f64)>,
    /// What the metric means, or empty.
    pub description: &'a str,
}

/// When changes of a metric are published.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// A number is published if it differs by more than this from the last published one; 0: every change.
    pub dead_band: f64,
    /// The shortest time between two publications.
    pub min_interval: Duration,
}

impl Report {
    /// Publishes every change at once.
    pub const ALL: Self = Self { dead_band: 0.0, min_interval: Duration::ZERO };
}

/// The devices and metrics of a node.
pub trait Catalog {
    /// Number of devices, at most [`MAX_DEVICES`].
    fn devices(&self) -> usize;

    /// The name of a device. It must be an [`Id`](crate::topic::Id), and unique in the node.
    fn device(&self, nth: usize) -> &str;

    /// The number of metrics of an owner.
    fn metrics(&self, owner: Owner) -> usize;

    /// The metric at a place, the same at every call; `None` if there is none.
    fn metric(&self, place: usize) -> Option<Metric<'_>>;

    /// When changes of a metric are published.
    fn report(&self, place: usize) -> Report;
}
