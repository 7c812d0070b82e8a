//! The state link: the 10 Hz stream of port 2001, for variables that no faster source has.

use heapless::Vec;

use super::connection::Connection;
use crate::config::StateValue;
use crate::engine::counters::{LinkCounters, add, bump};
use crate::engine::io::Transport;
use crate::engine::values::store::Store;
use crate::image::{GroupId, Image, InputSet, MAX_EXTRA};
use crate::link::{LinkTimings, Supervisor};
use crate::sysvar::{COUNT, SysVar};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;
use crate::wire::runs::{MAX_RUN, all_finite, copy};
use crate::wire::scalar::{Scalar, ScalarType};
use crate::wire::state::States;
use crate::wire::state::{StateStream, StateView};

/// The controller's states in the newest state packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct ControllerStatus {
    /// Mode, and the states of robot, program and safety.
    pub states: States,
    /// Age of that packet.
    pub age: Duration,
}

/// A stream that is silent for this long is reopened: twenty packets are missing.
const SILENCE: Duration = Duration::from_secs(2);
/// This many misaligned packets in a row end the connection (D8).
const MISALIGNED_IN_A_ROW: u32 = 3;

#[derive(Debug, Clone)]
pub(crate) struct StateLink {
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    port: u16,
    pub dialect: Dialect,
    pub group: GroupId,
    stream: StateStream,
    /// Variables taken from the stream.
    pub shown: Vec<SysVar, COUNT>,
    /// Input variables whose present value is read back while no port sends them.
    pub read_back: InputSet,
    /// Like `read_back`, for variables whose bits have owners.
    read_back_bits: InputSet,
    /// Codes of mode, robot, program and safety in the newest packet.
    pub codes: [u8; 4],
    /// Other values of the packet that ports show.
    pub kept: Vec<Kept, MAX_EXTRA>,
}

/// A value of the packet that is kept among the image's extra values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Kept {
    pub value: StateValue,
    /// Its place among the extra values.
    pub extra: u8,
    /// Its place in the packet.
    pub offset: u16,
    pub ty: ScalarType,
}

impl Kept {
    /// The value in a packet; NaN if it cannot be read.
    fn read(&self, view: &StateView<'_>) -> f64 {
        let bytes = view.as_bytes().get(usize::from(self.offset)..).unwrap_or(&[]);
        let bytes = bytes.get(..self.ty.size()).unwrap_or(&[]);
        Scalar::decode(self.ty, bytes).map_or(f64::NAN, |value| value.as_f64())
    }
}

impl StateLink {
    pub(crate) fn new(port: u16, dialect: Dialect, group: GroupId, read_back: InputSet) -> Self {
        Self {
            supervisor: Supervisor::new(const { &LinkTimings::TCP.with_silence(SILENCE) }),
            counters: LinkCounters::default(),
            port,
            dialect,
            group,
            stream: StateStream::new(),
            shown: Vec::new(),
            read_back,
            read_back_bits: InputSet::EMPTY,
            codes: [0; 4],
            kept: Vec::new(),
        }
    }

    /// The bits of these variables have owners.
    pub(crate) fn share(&mut self, bytes: &InputSet) {
        self.read_back_bits = self.read_back.and(bytes);
        self.read_back = self.read_back.minus(bytes);
    }

    pub(crate) fn transport(&self) -> Transport {
        Transport::Tcp { port: self.port }
    }

    /// Takes bytes that do not complete a packet; they only make deadlines later. False if [`Connection::received`] has
    /// to read them, or if the link is down; nothing was taken then.
    pub(crate) fn hold(&mut self, bytes: &[u8], now: Instant) -> bool {
        if !self.supervisor.is_up() || !self.stream.hold(bytes) {
            return false;
        }
        self.supervisor.heard(now);
        add(&mut self.counters.bytes_in, bytes.len());
        true
    }
}

impl Connection for StateLink {
    fn opened(&mut self, _store: &mut Store) {}

    fn lost(&mut self, _store: &mut Store) {
        self.stream.reset();
    }

    fn received<'b>(&mut self, bytes: &'b [u8], store: &mut Store) -> &'b [u8] {
        let mut rest = bytes;
        while let Some(packet) = self.stream.next_packet(&mut rest) {
            match packet {
                Ok(view) => {
                    bump(&mut self.counters.received);
                    self.codes = view.state_codes();
                    let not_live = self.read_back.minus(&store.live);
                    let mut left = &self.shown[..];
                    while let Some((run, behind)) = next_run(left) {
                        left = behind;
                        if take_run(run, &view, &mut store.image).is_none() {
                            add(&mut self.counters.unreadable, take_each(run, &view, &mut store.image));
                        }
                    }
                    if !self.kept.is_empty() {
                        add(&mut self.counters.unreadable, keep(&self.kept, &view, &mut store.image));
                    }
                    for var in not_live.iter() {
                        if view.read_var(var).is_some_and(|value| store.image.set(var, value).is_ok()) {
                            store.read_back.insert(var);
                        } else {
                            // Its value is unknown, so it must not be written back.
                            store.read_back.remove(var);
                            if store.image.is_readable(var) {
                                bump(&mut self.counters.unreadable);
                            }
                        }
                    }
                    if store.bits.is_used {
                        read_bits(&view, &self.read_back_bits, store);
                    }
                    if !store.safe.is_empty() {
                        compare_safe(&view, store);
                    }
                    store.heard();
                    store.image.stamp(self.group, store.now);
                    if store.watches_bits {
                        return rest;
                    }
                }
                Err(_) => bump(&mut self.counters.malformed),
            }
            if self.stream.misaligned_in_a_row() >= MISALIGNED_IN_A_ROW {
                self.supervisor.give_up(store.now);
                self.lost(store);
                return &[];
            }
        }
        &[]
    }
}

/// The first variables that are consecutive in the table, and so in the packet and in the image; at most as many as are
/// copied at once.
fn next_run(shown: &[SysVar]) -> Option<(&[SysVar], &[SysVar])> {
    let first = shown.first()?;
    let most = first.left_in_row().min(MAX_RUN.checked_div(first.size()).unwrap_or(1));
    let places = first.ordinal()..;
    let len = shown.iter().zip(places).take(most).take_while(|(var, place)| var.ordinal() == *place).count();
    shown.split_at_checked(len.max(1))
}

/// Copies a run of words or floats. `None`, with nothing changed, if its variables have to be checked one by one: bits,
/// values that are not finite, or variables that had such a value.
fn take_run(run: &[SysVar], view: &StateView<'_>, image: &mut Image) -> Option<()> {
    let first = run.first()?;
    if first.is_bits() || image.has_unreadable() {
        return None;
    }
    let len = run.len().saturating_mul(first.size());
    let from = view.as_bytes().get(usize::from(first.stream()?.offset)..)?.get(..len)?;
    if first.ty() == ScalarType::Float && !all_finite(from) {
        return None;
    }
    copy(image.bytes_mut().get_mut(first.image_offset()..)?.get_mut(..len)?, from);
    Some(())
}

/// Takes a run's variables one by one; returns how many are unreadable.
fn take_each(run: &[SysVar], view: &StateView<'_>, image: &mut Image) -> usize {
    let is_unreadable =
        |var: &&SysVar| !view.read_var(**var).is_some_and(|value| image.receive(**var, value));
    run.iter().filter(is_unreadable).count()
}

/// Reads back the bits that no port has sent.
fn read_bits(view: &StateView<'_>, bytes: &InputSet, store: &mut Store) {
    for var in bytes.iter() {
        if let Some(Scalar::Byte(shown)) = view.read_var(var) {
            store.show_bits(var, shown);
            store.read_back.insert(var);
        }
    }
}

/// Keeps other values of the packet that ports show; returns how many are unreadable.
fn keep(kept: &[Kept], view: &StateView<'_>, image: &mut Image) -> usize {
    let unreadable = kept.iter().filter(|kept| !image.receive_extra(kept.extra, kept.read(view)));
    unreadable.count()
}

/// Confirms safe values that the controller shows. A value that an old packet confirmed, or that late data has
/// overwritten, becomes unconfirmed again.
fn compare_safe(view: &StateView<'_>, store: &mut Store) {
    let (may_confirm, may_unconfirm) = (store.may_confirm(), store.may_unconfirm());
    for var in store.safe.iter() {
        let Some(shown) = view.read_var(var) else { continue };
        if store.bits.bytes.contains(var) {
            let Scalar::Byte(shown) = shown else { continue };
            store.compare_bits(var, shown, may_confirm, may_unconfirm);
            continue;
        }
        let is_there = shown == store.image.value(var);
        match store.unconfirmed.contains(var) {
            true if is_there && may_confirm => store.confirm(&InputSet::from_iter([var])),
            false if !is_there && may_unconfirm => store.unconfirm(var),
            _ => {}
        }
    }
}
