//! What an edge node can tell: its devices and its metrics.
//!
//! A catalog is fixed as long as a node lives; what has others is another node with another session. Metrics have
//! places from 0 on: first those of the node itself, then those of each device, without gaps.

use heapless::String;
use proto_core::time::Duration;

use crate::value::DataType;

/// The longest name of a metric, in bytes.
pub const MAX_NAME: usize = 96;

/// Most devices of a node.
pub const MAX_DEVICES: usize = 32;

/// Whose a metric or a message is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The node itself.
    Node,
    /// The device with this number, from 0.
    Device(u8),
}

/// What a birth says about a metric.
#[derive(Debug, Clone, PartialEq)]
pub struct Metric<'a> {
    /// Its name, unique among its owner's metrics; `/` makes folders.
    pub name: String<MAX_NAME>,
    /// Its type.
    pub data_type: DataType,
    /// Its unit, or empty.
    pub unit: &'a str,
    /// The least and the greatest value, if they are known.
    pub range: Option<(f64, f64)>,
    /// What it is, or empty.
    pub description: &'a str,
}

/// When a change of a metric is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// A number is told when it is further than this from the last one told; 0: every change.
    pub dead_band: f64,
    /// The least time between two.
    pub min_interval: Duration,
}

impl Report {
    /// Every change at once.
    pub const ALL: Self = Self { dead_band: 0.0, min_interval: Duration::ZERO };
}

/// Devices and metrics of a node.
pub trait Catalog {
    /// Number of devices, at most [`MAX_DEVICES`].
    fn devices(&self) -> usize;

    /// The name of a device; it must be an [`Id`](crate::topic::Id), and unique in the node.
    fn device(&self, nth: usize) -> &str;

    /// The number of metrics of an owner.
    fn metrics(&self, owner: Owner) -> usize;

    /// A metric; `None` if there is none at this place. The same at every call.
    fn metric(&self, place: usize) -> Option<Metric<'_>>;

    /// When changes of a metric are told.
    fn report(&self, place: usize) -> Report;
}
