//! The messages of a node, as MQTT packets.

use super::{Birth, Dates, EdgeNode, Owner, Stage, has};
use crate::bytes::ByteWriter;
use crate::catalog::Catalog;
use crate::mqtt;
use crate::payload::{self, Details, PayloadMetric};
use crate::topic::{self, Verb};
use crate::value::Value;
use proto_core::time::Instant;

/// The longest metric in a birth, in bytes. Longer metrics are left out.
pub const MAX_METRIC: usize = 512;

/// The result of writing a piece of a birth.
pub(super) enum BirthPiece<'b> {
    /// Nothing to send yet.
    Later,
    /// These bytes, and more will follow.
    Part(&'b [u8]),
    /// The last bytes.
    Last(&'b [u8]),
    /// The lengths differ: the catalog has changed.
    Broken,
}

impl<const METRICS: usize, const HISTORY: usize> EdgeNode<METRICS, HISTORY> {
    pub(super) fn write_connect<'b>(&self, now: Instant, buf: &'b mut [u8]) -> Option<&'b [u8]> {
        let settings = &self.settings;
        let mut out = ByteWriter::new(buf);
        mqtt::packet(&mut out, mqtt::CONNECT, |out| {
            mqtt::text(out, b"MQTT");
            // Protocol level 4; clean session, and a will at QoS 1 that is not retained.
            let login = if settings.login.is_some() { 0xC0 } else { 0 };
            out.put(&[4, 0x02 | 0x04 | 0x08 | login]);
            out.put(&settings.keep_alive_s().to_be_bytes());
            mqtt::text(out, settings.client_id.as_str().as_bytes());
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Death, None));
            mqtt::text_of(out, |out| payload::death(out, self.clock.at(now), self.session()));
            if let Some((user, password)) = &settings.login {
                mqtt::text(out, user.as_str().as_bytes());
                mqtt::text(out, password.as_str().as_bytes());
            }
        });
        out.finish()
    }

    pub(super) fn write_subscribe<'b>(&self, buf: &'b mut [u8]) -> Option<&'b [u8]> {
        let mut out = ByteWriter::new(buf);
        mqtt::packet(&mut out, mqtt::SUBSCRIBE, |out| {
            out.put(&1_u16.to_be_bytes());
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Command, None));
            out.byte(1);
            if let Some(host) = &self.settings.primary_host {
                mqtt::text_of(out, |out| topic::write_state(out, host));
                out.byte(1);
            }
        });
        out.finish()
    }

    /// The death that the node publishes itself before it disconnects.
    pub(super) fn write_death<'b>(&self, now: Instant, buf: &'b mut [u8]) -> Option<&'b [u8]> {
        let mut out = ByteWriter::new(buf);
        mqtt::packet(&mut out, mqtt::PUBLISH, |out| {
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Death, None));
            payload::death(out, self.clock.at(now), self.session());
        });
        out.finish()
    }

    pub(super) fn write_device_death<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        nth: u8,
        buf: &'b mut [u8],
    ) -> Option<&'b [u8]> {
        let seq = self.next_seq();
        let mut out = ByteWriter::new(buf);
        mqtt::packet(&mut out, mqtt::PUBLISH, |out| {
            let device = Some(catalog.device(nth.into()));
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Death, device));
            payload::begin(out, self.clock.at(now));
            payload::end(out, seq);
        });
        out.finish()
    }

    pub(super) fn write_birth<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        birth: &mut Birth,
        buf: &'b mut [u8],
    ) -> BirthPiece<'b> {
        let room = buf.len();
        let places = self.places(birth.owner);
        if birth.stage == Stage::Begin {
            self.begin_birth(now, birth.owner);
            birth.stage = Stage::Measure { next: places.start, len: 0 };
        }
        let mut out = ByteWriter::new(buf);
        let is_first = matches!(birth.stage, Stage::Measure { .. });
        let (mut next, left) = match birth.stage {
            Stage::Begin => return BirthPiece::Broken,
            Stage::Measure { next, len } => {
                let end = next.saturating_add(MEASURED_AT_ONCE).min(places.end);
                let measured = (next..end).map(|place| self.birth_metric_len(catalog, place));
                let len = measured.fold(len, usize::saturating_add);
                if end < places.end {
                    birth.stage = Stage::Measure { next: end, len };
                    return BirthPiece::Later;
                }
                let device = device_name(catalog, birth.owner);
                let head = |out: &mut ByteWriter<'_>| {
                    mqtt::text_of(out, |out| self.write_topic(out, Verb::Birth, device));
                    payload::begin(out, self.dates.now_ms);
                    if birth.owner == Owner::Node {
                        self.write_own_metrics(out);
                    }
                };
                let end = ByteWriter::count(|out| payload::end(out, self.seq));
                let len = ByteWriter::count(head).saturating_add(len).saturating_add(end);
                if len > mqtt::MAX_BODY {
                    return BirthPiece::Broken;
                }
                mqtt::header(&mut out, mqtt::PUBLISH, len);
                let before = out.len();
                head(&mut out);
                (places.start, len.saturating_sub(out.len().saturating_sub(before)))
            }
            Stage::Metrics { next, left } => (next, left),
        };
        let before = out.len();
        while next < places.end {
            let len = self.birth_metric_len(catalog, next);
            if out.len().saturating_add(len).saturating_add(MAX_END) > room {
                break;
            }
            if len > 0 {
                self.write_birth_metric(&mut out, catalog, next);
            }
            next = next.saturating_add(1);
        }
        let is_last = next >= places.end;
        if is_last {
            payload::end(&mut out, self.seq);
        }
        let Some(left) = left.checked_sub(out.len().saturating_sub(before)) else {
            return BirthPiece::Broken;
        };
        birth.stage = Stage::Metrics { next, left };
        match out.finish() {
            Some(bytes) if is_last && left == 0 => BirthPiece::Last(bytes),
            Some(bytes) if !is_last && (is_first || !bytes.is_empty()) => BirthPiece::Part(bytes),
            _ => BirthPiece::Broken,
        }
    }

    /// Writes the pending values of one owner; `None` if there are none.
    pub(super) fn write_data<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        owner: Owner,
        buf: &'b mut [u8],
    ) -> Option<&'b [u8]> {
        let places = self.places(owner);
        let at = self.clock.at(self.sampled_at);
        let shown = |place: usize| {
            let slot = self.slots.get(place).filter(|slot| slot.is_pending)?;
            Some(data_metric(place, at, slot.current(), false))
        };
        let count = self.room_for(now, catalog, owner, buf.len(), places.clone().filter_map(shown));
        if count == 0 {
            return None;
        }
        let told = || places.clone().filter_map(shown).take(count);
        let written = self.write_metrics(now, catalog, owner, told, buf)?;
        let sampled_at = self.sampled_at;
        // The slots of the written metrics, in the same order.
        let slots = self.slots.iter_mut().take(places.end).skip(places.start);
        for slot in slots.filter(|slot| slot.is_pending).take(count) {
            slot.tell(sampled_at);
        }
        self.count_data();
        Some(written)
    }

    /// Writes the stored values of one owner; `None` if none can be published.
    pub(super) fn write_history<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        buf: &'b mut [u8],
    ) -> Option<&'b [u8]> {
        let (starts, born) = (&self.starts, self.born);
        let is_born = |owner: Owner| match owner {
            Owner::Node => true,
            Owner::Device(nth) => has(born, nth),
        };
        if !self.history.find(|past| is_born(owner_of(starts, past.place))) {
            return None;
        }
        let owner = owner_of(&self.starts, self.history.iter().next()?.place);
        let past = || {
            let of_owner = self.history.iter().take_while(|past| owner_of(&self.starts, past.place) == owner);
            of_owner.map(|past| {
                let place = usize::from(past.place);
                let value = self.slots.get(place).and_then(|slot| past.value.get(slot.data_type));
                data_metric(place, self.clock.at(past.at.get()), value, true)
            })
        };
        let count = self.room_for(now, catalog, owner, buf.len(), past());
        if count == 0 {
            return None;
        }
        let written = self.write_metrics(now, catalog, owner, || past().take(count), buf)?;
        self.history.drop_front(count);
        self.counters.historical = self.counters.historical.saturating_add(count as u64);
        self.count_data();
        Some(written)
    }

    /// How many of the metrics fit in a packet of `room` bytes.
    fn room_for<'m>(
        &self,
        now: Instant,
        catalog: &impl Catalog,
        owner: Owner,
        room: usize,
        metrics: impl Iterator<Item = PayloadMetric<'m>>,
    ) -> usize {
        let device = device_name(catalog, owner);
        let around = ByteWriter::count(|out| {
            mqtt::header(out, mqtt::PUBLISH, room);
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Data, device));
            payload::begin(out, self.clock.at(now));
        });
        let mut left = room.saturating_sub(around).saturating_sub(MAX_END);
        let mut count = 0_usize;
        for shown in metrics {
            match left.checked_sub(ByteWriter::count(|out| payload::metric(out, &shown))) {
                Some(less) => (left, count) = (less, count.saturating_add(1)),
                None => break,
            }
        }
        count
    }

    fn write_metrics<'b, 'm, I: Iterator<Item = PayloadMetric<'m>>>(
        &self,
        now: Instant,
        catalog: &impl Catalog,
        owner: Owner,
        metrics: impl Fn() -> I,
        buf: &'b mut [u8],
    ) -> Option<&'b [u8]> {
        let device = device_name(catalog, owner);
        let mut out = ByteWriter::new(buf);
        mqtt::packet(&mut out, mqtt::PUBLISH, |out| {
            mqtt::text_of(out, |out| self.write_topic(out, Verb::Data, device));
            payload::begin(out, self.clock.at(now));
            metrics().for_each(|shown| payload::metric(out, &shown));
            payload::end(out, self.seq.wrapping_add(1));
        });
        out.finish()
    }

    /// Counts a data message, and its sequence number.
    fn count_data(&mut self) {
        self.next_seq();
        self.counters.data = self.counters.data.saturating_add(1);
    }

    /// Fixes the time stamps, the values and the sequence number of a birth.
    fn begin_birth(&mut self, now: Instant, owner: Owner) {
        let sampled_at = self.sampled_at;
        self.dates = Dates {
            now_ms: self.clock.at(now),
            sampled_ms: self.clock.at(sampled_at),
            is_utc: self.clock.is_known(),
        };
        let places = self.places(owner);
        for slot in self.slots.iter_mut().take(places.end).skip(places.start) {
            slot.tell(sampled_at);
        }
        match owner {
            Owner::Node => self.seq = 0,
            Owner::Device(_) => {
                self.next_seq();
            }
        }
    }

    /// Writes the metrics that a birth of the node has in addition to the catalog. None has an alias, which a
    /// command could use to write it.
    fn write_own_metrics(&self, out: &mut ByteWriter<'_>) {
        let at = self.dates.sampled_ms;
        payload::metric(out, &payload::bd_seq_metric(at, self.session()));
        payload::metric(out, &payload::plain(payload::REBIRTH, at, Value::Boolean(false)));
        payload::metric(out, &payload::plain(UTC, at, Value::Boolean(self.dates.is_utc)));
    }

    /// The length of a metric in a birth; 0 if the metric is left out.
    fn birth_metric_len(&self, catalog: &impl Catalog, place: usize) -> usize {
        match ByteWriter::count(|out| self.write_birth_metric(out, catalog, place)) {
            len @ 0..=MAX_METRIC => len,
            _ => 0,
        }
    }

    fn write_birth_metric(&self, out: &mut ByteWriter<'_>, catalog: &impl Catalog, place: usize) {
        let (Some(metric), Some(slot)) = (catalog.metric(place), self.slots.get(place)) else { return };
        let shown = PayloadMetric {
            name: Some(&metric.name),
            data_type: Some(slot.data_type),
            details: Details { unit: metric.unit, range: metric.range, description: metric.description },
            ..data_metric(place, self.dates.sampled_ms, slot.published(), false)
        };
        payload::metric(out, &shown);
    }

    fn write_topic(&self, out: &mut ByteWriter<'_>, verb: Verb, device: Option<&str>) {
        topic::write(out, &self.settings.group, verb, &self.settings.node, device);
    }

    /// The range of places of an owner's metrics.
    pub(super) fn places(&self, owner: Owner) -> core::ops::Range<usize> {
        let index = match owner {
            Owner::Node => 0,
            Owner::Device(nth) => usize::from(nth).saturating_add(1),
        };
        let at = |index: usize| self.starts.get(index).copied().map_or(0, usize::from);
        at(index)..at(index.saturating_add(1))
    }

    fn next_seq(&mut self) -> u8 {
        self.seq = self.seq.wrapping_add(1);
        self.seq
    }

    fn session(&self) -> u8 {
        self.bd_seq.unwrap_or(0)
    }
}

/// A metric in a data message. Aliases begin at 1, because some readers take 0 for none.
fn data_metric<'m>(
    place: usize,
    timestamp: u64,
    value: Option<Value>,
    is_historical: bool,
) -> PayloadMetric<'m> {
    let alias = Some((place as u64).saturating_add(1));
    let details = Details::default();
    PayloadMetric { name: None, alias, timestamp, data_type: None, is_historical, value, details }
}

fn device_name(catalog: &impl Catalog, owner: Owner) -> Option<&str> {
    match owner {
        Owner::Node => None,
        Owner::Device(nth) => Some(catalog.device(nth.into())),
    }
}

/// Whose metric it is.
pub(super) fn owner_of(starts: &[u16], place: u16) -> Owner {
    let devices = starts.iter().skip(1).take_while(|start| **start <= place).count();
    match devices.checked_sub(1).and_then(|nth| u8::try_from(nth).ok()) {
        None => Owner::Node,
        Some(nth) => Owner::Device(nth),
    }
}

/// Says whether timestamps are UTC; if not, they count from the node's start, in 1970.
const UTC: &str = "Node Info/UTC";

/// Metrics of a birth that are measured in one call: less work than writing a piece.
const MEASURED_AT_ONCE: usize = 8;

/// The most bytes behind the metrics of a payload.
const MAX_END: usize = 3;
