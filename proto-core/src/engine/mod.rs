//! The gateway: one run loop over field ports and controller links, sans-IO
//! (docs/architecture.md sections 3 to 7).
//!
//! One rule: change the engine once with [`Engine::handle`], then drain [`Engine::poll_output`]
//! until it returns [`Output::Sleep`]. Polling early is harmless. The engine never reads a clock,
//! never sleeps, never does I/O and never allocates; the work of a call is bounded by the size of
//! the configuration and of what it was given.
//!
//! What a device or the controller sends wrong is counted and skipped; it is never an error of the
//! run loop, and never applied in part.

mod build;
mod command_link;
mod counters;
mod field_port;
mod io;
mod modbus_link;
mod outbox;
mod plan;
mod sender;
mod state_link;
mod store;
mod uplink;
mod user;

pub use build::BuildError;
pub use command_link::{COMMAND_QUEUE, MAX_COMMAND_BYTES, MAX_COMMAND_FIELDS};
pub use counters::{LinkCounters, PortCounters};
pub use field_port::ReplyCode;
pub use io::{BusState, Input, LinkId, LinkKind, Output, PortId};
pub use modbus_link::MAX_POLL_BLOCKS;
pub use outbox::EDGE_QUEUE;
pub use plan::{Plan, PlanError, Source, WayUp};
pub use store::MAX_INPUT_FRAMES;

use heapless::Vec;

use command_link::CommandLink;
use counters::{add, bump};
use field_port::{Codec, FieldPort, fields_before};
use modbus_link::ModbusLink;
use sender::{DIGEST_SEED, digest};
use state_link::StateLink;
use store::{SafeBytes, Store};
use uplink::Uplink;
use user::{Bindings, OutputBind, forget_commands, values};

use crate::config::MAX_SAFE_VALUES;
use crate::image::Image;
use crate::link::{LinkAction, LinkHistory, LinkState, Supervisor};
use crate::recipe::can::CanFrame;
use crate::recipe::model::{MAX_STREAM_FRAME, Mode};
use crate::time::{Duration, Instant};

/// Size of the buffer for [`Engine::poll_output`]: the longest stream frame; every request to the
/// controller is shorter.
pub const OUTPUT_BUFFER: usize = MAX_STREAM_FRAME;

/// The gateway engine for up to `PORTS` field ports, `UPLINKS` recipe links and, over all ports,
/// `FIELDS` user-defined input fields and as many output fields.
///
/// `Engine<4, 1, 128>` takes less than 32 KiB.
#[derive(Debug, Clone)]
pub struct Engine<const PORTS: usize = 8, const UPLINKS: usize = 4, const FIELDS: usize = 512> {
    store: Store<PORTS>,
    ports: Vec<FieldPort, PORTS>,
    bindings: Bindings<FIELDS>,
    safe_values: Vec<SafeBytes, MAX_SAFE_VALUES>,
    links: Links<UPLINKS>,
    /// Nothing depends on the clock before this.
    timer_at: Instant,
}

#[derive(Debug, Clone)]
struct Links<const UPLINKS: usize> {
    command: Option<CommandLink>,
    state: Option<StateLink>,
    modbus: Option<ModbusLink>,
    recipes: Vec<Uplink, UPLINKS>,
}

/// How one link does.
#[derive(Debug, Clone, Copy)]
pub struct LinkInfo<'a> {
    /// The link.
    pub id: LinkId,
    /// What it is.
    pub kind: LinkKind,
    /// Where it stands.
    pub state: LinkState,
    /// How often it came and went.
    pub history: &'a LinkHistory,
    /// What went over it.
    pub counters: &'a LinkCounters,
}

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize> Engine<PORTS, UPLINKS, FIELDS> {
    /// Something happened, or time passed. `now` must not be earlier than in the call before.
    ///
    /// Inputs for a port or link that the configuration does not have are ignored.
    pub fn handle(&mut self, now: Instant, input: Input<'_>) {
        if now >= self.timer_at {
            self.advance(now);
        }
        match input {
            Input::PortBytes { port, bytes } => {
                let (store, command) = (&mut self.store, &mut self.links.command);
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.bytes(bytes, &self.bindings.inputs, store, command, now);
                }
                self.after_field(port, now);
            }
            Input::PortCan { port, frame } => {
                let (store, command) = (&mut self.store, &mut self.links.command);
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.can(&frame, &self.bindings.inputs, store, command, now);
                }
                self.after_field(port, now);
            }
            Input::PortSent { port } => {
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.sender.sent();
                }
            }
            Input::PortUp { port } => {
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.up();
                }
            }
            Input::PortDown { port } => {
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.down(&self.bindings.inputs, &mut self.links.command);
                }
            }
            Input::PortBus { port, state } => {
                if let Some(port) = find_port(&mut self.ports, port) {
                    port.bus_state(state);
                }
            }
            Input::LinkUp { link } => self.link_up(link, now),
            Input::LinkDown { link } => self.link_down(link, now),
            Input::LinkBytes { link, bytes } => self.link_bytes(link, bytes, now),
            Input::LinkSent { link } => {
                if let Some(uplink) = self.links.recipes.iter_mut().find(|uplink| uplink.id == link) {
                    uplink.sent();
                }
            }
            Input::Tick => {}
        }
        // Whatever happened may have set an earlier deadline: the next poll looks at all of them.
        self.timer_at = Instant::ZERO;
    }

    /// What the driver has to do next; call it again until it is [`Output::Sleep`].
    ///
    /// What brings field values to the controller comes first, then what keeps links up, then what
    /// goes to the field.
    pub fn poll_output<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        if now >= self.timer_at {
            self.advance(now);
        }
        if let Some((link, len)) = self.next_upward(&mut buf[..], now) {
            return Output::LinkSend { link, bytes: buf.get(..len).unwrap_or(&[]) };
        }
        if let Some((link, action)) = self.next_action() {
            return match action {
                LinkAction::Open => Output::LinkOpen { link },
                LinkAction::Close => Output::LinkClose { link },
            };
        }
        match self.next_downward(&mut buf[..], now) {
            Some((port, Downward::Bytes(len))) => {
                Output::PortSend { port, bytes: buf.get(..len).unwrap_or(&[]) }
            }
            Some((port, Downward::Can(frame))) => Output::PortSendCan { port, frame },
            None => {
                self.timer_at = self.next_deadline();
                Output::Sleep { until: self.timer_at }
            }
        }
    }

    /// The process image.
    pub fn image(&self) -> &Image {
        &self.store.image
    }

    /// What happened on a field port; `None` for a port that is none.
    pub fn port_counters(&self, port: PortId) -> Option<&PortCounters> {
        self.ports.iter().find(|other| other.id == port).map(|port| &port.counters)
    }

    /// How the newest command that a port's values picked went; `None` for a port that is none.
    pub fn reply_code(&self, port: PortId) -> Option<ReplyCode> {
        self.ports.iter().find(|other| other.id == port).map(|port| port.reply)
    }

    /// The field ports, in configuration order.
    pub fn field_ports(&self) -> impl Iterator<Item = PortId> + '_ {
        self.ports.iter().map(|port| port.id)
    }

    /// The links that the configuration needs.
    pub fn links(&self) -> impl Iterator<Item = LinkInfo<'_>> + '_ {
        let command = self
            .links
            .command
            .as_ref()
            .map(|link| info(LinkId::COMMAND, LinkKind::Command, &link.supervisor, &link.counters));
        let state = self
            .links
            .state
            .as_ref()
            .map(|link| info(LinkId::STATE, LinkKind::State, &link.supervisor, &link.counters));
        let modbus = self
            .links
            .modbus
            .as_ref()
            .map(|link| info(LinkId::MODBUS, LinkKind::Modbus, &link.supervisor, &link.counters));
        let recipes = self.links.recipes.iter();
        let recipes = recipes.map(|link| info(link.id, link.kind, &link.supervisor, &link.counters));
        command.into_iter().chain(state).chain(modbus).chain(recipes)
    }

    /// Everything that depends on the clock.
    fn advance(&mut self, now: Instant) {
        // At one instant the clock is looked at once: what is done now is due later.
        self.timer_at = now + Duration::from_micros(1);
        self.expire_frames(now);
        for index in 0..self.ports.len() {
            if let Some(port) = self.ports.get_mut(index) {
                port.advance(now);
            }
        }
        if let Some(link) = &mut self.links.command {
            link.advance(&mut self.ports, now);
            if link.supervisor.advance(now) {
                link.lost(&mut self.ports);
            }
        }
        if let Some(link) = &mut self.links.state
            && link.supervisor.advance(now)
        {
            link.lost();
        }
        if let Some(link) = &mut self.links.modbus {
            link.advance(&mut self.store, now);
            if link.supervisor.advance(now) {
                link.lost(&mut self.store);
            }
        }
        for link in &mut self.links.recipes {
            if link.supervisor.advance(now) {
                link.lost(&mut self.store);
            }
        }
    }

    fn expire_frames(&mut self, now: Instant) {
        while let Some(frame) = self.store.next_timeout(&self.safe_values, now) {
            if let Some(port) = self.ports.get_mut(usize::from(frame.port)) {
                bump(&mut port.counters.timeouts);
                forget_commands(port.inputs.of(&self.bindings.inputs), &mut self.links.command);
            }
        }
        let ports = &mut self.ports;
        self.store.expire_waiting(
            |port, dropped| {
                if let Some(port) = ports.get_mut(port) {
                    add(&mut port.counters.values_expired, dropped);
                }
            },
            now,
        );
    }

    /// After a field frame: bits that trigger, and frames that have to wait for their neighbours.
    fn after_field(&mut self, port: PortId, now: Instant) {
        self.image_changed();
        let dirty = self.store.outbox.dirty();
        let state = self.links.state.as_ref().map(|state| state.group);
        let waits = self.links.recipes.iter().any(|link| {
            link.supervisor.is_up()
                && !dirty.and(&link.set).is_empty()
                && !link.is_ready(&self.store, state, now)
        });
        if waits && let Some(port) = find_port(&mut self.ports, port) {
            bump(&mut port.counters.withheld);
        }
    }

    fn image_changed(&mut self) {
        for port in &mut self.ports {
            port.sender.image_changed(&self.store.image, &mut port.counters);
        }
    }

    fn link_up(&mut self, id: LinkId, now: Instant) {
        match id {
            LinkId::COMMAND => {
                if let Some(link) = &mut self.links.command {
                    link.supervisor.up(now);
                }
            }
            LinkId::STATE => {
                if let Some(link) = &mut self.links.state {
                    link.supervisor.up(now);
                }
            }
            LinkId::MODBUS => {
                if let Some(link) = &mut self.links.modbus
                    && link.supervisor.up(now)
                {
                    link.up(&mut self.store);
                }
            }
            _ => {
                if let Some(link) = self.links.recipes.iter_mut().find(|link| link.id == id)
                    && link.supervisor.up(now)
                {
                    link.up(&mut self.store, now);
                }
            }
        }
    }

    fn link_down(&mut self, id: LinkId, now: Instant) {
        match id {
            LinkId::COMMAND => {
                if let Some(link) = &mut self.links.command
                    && link.supervisor.down(now)
                {
                    link.lost(&mut self.ports);
                }
            }
            LinkId::STATE => {
                if let Some(link) = &mut self.links.state
                    && link.supervisor.down(now)
                {
                    link.lost();
                }
            }
            LinkId::MODBUS => {
                if let Some(link) = &mut self.links.modbus
                    && link.supervisor.down(now)
                {
                    link.lost(&mut self.store);
                }
            }
            _ => {
                if let Some(link) = self.links.recipes.iter_mut().find(|link| link.id == id)
                    && link.supervisor.down(now)
                {
                    link.lost(&mut self.store);
                }
            }
        }
    }

    /// Bytes of a link that is not up, as the engine sees it, are of a connection it gave up.
    fn link_bytes(&mut self, id: LinkId, bytes: &[u8], now: Instant) {
        match id {
            LinkId::COMMAND => {
                if let Some(link) = self.links.command.as_mut().filter(|link| link.supervisor.is_up()) {
                    link.bytes(bytes, &mut self.ports, now);
                }
            }
            LinkId::STATE => {
                if let Some(link) = self.links.state.as_mut().filter(|link| link.supervisor.is_up()) {
                    link.bytes(bytes, &mut self.store, now);
                }
            }
            LinkId::MODBUS => {
                if let Some(link) = self.links.modbus.as_mut().filter(|link| link.supervisor.is_up()) {
                    link.bytes(bytes, &mut self.store, now);
                }
            }
            _ => {
                let link = self.links.recipes.iter_mut().find(|link| link.id == id);
                if let Some(link) = link.filter(|link| link.supervisor.is_up()) {
                    link.bytes(bytes, &mut self.store, now);
                }
            }
        }
        self.image_changed();
    }

    /// What goes to the controller.
    fn next_upward(&mut self, out: &mut [u8], now: Instant) -> Option<(LinkId, usize)> {
        let state = self.links.state.as_ref().map(|state| state.group);
        for link in &mut self.links.recipes {
            if let Some(len) = link.next_frame(&mut self.store, state, out, now) {
                return Some((link.id, len));
            }
        }
        if let Some(link) = &mut self.links.modbus
            && let Some(len) = link.next_request(&mut self.store, out, now)
        {
            return Some((LinkId::MODBUS, len));
        }
        let link = self.links.command.as_mut()?;
        link.next_command(&mut self.ports, out, now).map(|len| (LinkId::COMMAND, len))
    }

    /// Links to be opened and closed.
    fn next_action(&mut self) -> Option<(LinkId, LinkAction)> {
        let Links { command, state, modbus, recipes } = &mut self.links;
        let command = command.as_mut().map(|link| (LinkId::COMMAND, &mut link.supervisor));
        let state = state.as_mut().map(|link| (LinkId::STATE, &mut link.supervisor));
        let modbus = modbus.as_mut().map(|link| (LinkId::MODBUS, &mut link.supervisor));
        let recipes = recipes.iter_mut().map(|link| (link.id, &mut link.supervisor));
        command
            .into_iter()
            .chain(state)
            .chain(modbus)
            .chain(recipes)
            .find_map(|(id, supervisor)| supervisor.take_action().map(|action| (id, action)))
    }

    /// What goes to the field.
    fn next_downward(&mut self, out: &mut [u8], now: Instant) -> Option<(PortId, Downward)> {
        let (image, bindings) = (&self.store.image, &self.bindings.outputs);
        for port in &mut self.ports {
            if port.may_send(now)
                && let Some(downward) = port.next_output(image, bindings, out, now)
            {
                return Some((port.id, downward));
            }
        }
        None
    }

    fn next_deadline(&self) -> Instant {
        let links = &self.links;
        let command = links.command.iter().map(|link| link.deadline().min(link.supervisor.deadline()));
        let state = links.state.iter().map(|link| link.supervisor.deadline());
        let modbus = links.modbus.iter().map(|link| link.deadline().min(link.supervisor.deadline()));
        let recipes = links.recipes.iter().map(|link| link.deadline().min(link.supervisor.deadline()));
        let ports = self.ports.iter().map(FieldPort::deadline);
        let all = command.chain(state).chain(modbus).chain(recipes).chain(ports);
        all.min().unwrap_or(Instant::NEVER).min(self.store.next_overdue)
    }
}

/// One thing for the field.
enum Downward {
    Bytes(usize),
    Can(CanFrame),
}

impl FieldPort {
    /// The frame that is due, if its values may be shown.
    fn next_output(
        &mut self,
        image: &Image,
        bindings: &[OutputBind],
        out: &mut [u8],
        now: Instant,
    ) -> Option<Downward> {
        if !self.sender.may_show(image, now) {
            bump(&mut self.counters.stale_cycles);
            self.sender.dismiss();
            return None;
        }
        match self.codec {
            Codec::Stream { .. } => self.next_stream(image, self.outputs.of(bindings), out),
            Codec::Can { .. } => self.next_can(image, self.outputs.of(bindings)),
        }
    }

    fn next_stream(&mut self, image: &Image, bindings: &[OutputBind], out: &mut [u8]) -> Option<Downward> {
        let Codec::Stream { output: Some(layout), .. } = &self.codec else {
            self.sender.dismiss();
            return None;
        };
        let encoded = match self.mode {
            Mode::Realtime => layout.encode(image.bytes(), out).ok(),
            Mode::User => {
                let values = values(bindings, image, self.sender.frames_sent, self.reply);
                layout.encode_values(&values, out).ok()
            }
        };
        let frame = encoded.and_then(|len| out.get(..len));
        match frame {
            Some(frame) if self.sender.is_news(digest(DIGEST_SEED, frame)) => {
                let len = frame.len();
                bump(&mut self.counters.frames_out);
                add(&mut self.counters.bytes_out, len);
                self.sender.handed_over();
                Some(Downward::Bytes(len))
            }
            _ => {
                self.sender.dismiss();
                None
            }
        }
    }

    fn next_can(&mut self, image: &Image, bindings: &[OutputBind]) -> Option<Downward> {
        if self.sender.next_can == 0 && !self.can_is_news(image, bindings) {
            self.sender.dismiss();
            return None;
        }
        let nth = self.sender.next_can;
        let Some((frame, is_last)) = self.can_frame(nth, image, bindings) else {
            self.sender.dismiss();
            return None;
        };
        bump(&mut self.counters.frames_out);
        add(&mut self.counters.bytes_out, frame.data().len());
        if is_last {
            self.sender.handed_over();
        } else {
            self.sender.next_can = nth.saturating_add(1);
        }
        Some(Downward::Can(frame))
    }

    /// The `nth` frame of the cycle, and whether it is the last.
    fn can_frame(&self, nth: usize, image: &Image, bindings: &[OutputBind]) -> Option<(CanFrame, bool)> {
        let Codec::Can { output: Some(layout), .. } = &self.codec else { return None };
        let frame = layout.frame(nth)?;
        let is_last = nth.saturating_add(1) >= layout.frame_count();
        let frame = match self.mode {
            Mode::Realtime => frame.encode(image.bytes()),
            Mode::User => {
                let row = bindings.get(fields_before(layout, nth)..).unwrap_or(&[]);
                let row = row.get(..frame.fields().count()).unwrap_or(&[]);
                let values = values(row, image, self.sender.frames_sent, self.reply);
                frame.encode_values(&values).ok()?
            }
        };
        Some((frame, is_last))
    }

    fn can_is_news(&mut self, image: &Image, bindings: &[OutputBind]) -> bool {
        if !self.sender.sends_changes() {
            return true;
        }
        let mut hash = DIGEST_SEED;
        let mut nth = 0_usize;
        while let Some((frame, _)) = self.can_frame(nth, image, bindings) {
            hash = digest(hash, frame.data());
            nth = nth.saturating_add(1);
        }
        self.sender.is_news(hash)
    }
}

fn info<'a>(
    id: LinkId,
    kind: LinkKind,
    supervisor: &'a Supervisor,
    counters: &'a LinkCounters,
) -> LinkInfo<'a> {
    LinkInfo { id, kind, state: supervisor.state(), history: supervisor.history(), counters }
}

fn find_port(ports: &mut [FieldPort], id: PortId) -> Option<&mut FieldPort> {
    ports.iter_mut().find(|port| port.id == id)
}
