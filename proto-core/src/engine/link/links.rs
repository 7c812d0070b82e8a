//! All links: which link an input is for, and the order in which they send.
//!
//! State, Modbus and recipe links have one connection each; [`Connection`] has their differences. The command link has
//! two connections and decides for both.

use heapless::{String, Vec, VecView};

use super::command::CommandLink;
use super::connection::Connection;
use super::device::DeviceLink;
use super::modbus::ModbusLink;
use super::other_text::OtherText;
use super::recipe::RecipeLink;
use super::state::StateLink;
use crate::engine::clock::Dirty;
use crate::engine::counters::{LinkCounters, add};
use crate::engine::io::{Endpoint, LinkId, LinkKind, Transport};
use crate::engine::values::store::Store;
use crate::image::{GroupId, InputSet};
use crate::link::{LinkAction, LinkHistory, LinkState, Supervisor};
use crate::time::Instant;

/// State of one link.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct LinkInfo<'a> {
    /// The link.
    pub id: LinkId,
    /// The configured name of a listening port's link; for other links [`LinkKind::name`].
    pub name: &'a str,
    /// Its kind.
    pub kind: LinkKind,
    /// Where it goes and how it is opened.
    pub endpoint: Endpoint<'a>,
    /// Its state, and since or until when.
    pub state: LinkState,
    /// How often it came up and was lost.
    pub history: &'a LinkHistory,
    /// Its counters.
    pub counters: &'a LinkCounters,
    /// For a connection to port 2000: the newest text that was not recognized as a reply.
    pub other_text: Option<OtherText<'a>>,
    /// The instant of the snapshot, for ages; zero outside a [`crate::engine::Status`].
    #[cfg(feature = "serde")]
    pub(crate) at: Instant,
}

/// One item or none. All zeros when empty, unlike an `Option` of a struct.
pub(crate) type Maybe<T> = Vec<T, 1>;

/// Maximum length of the controller's address or name.
pub(crate) const MAX_HOST: usize = 64;

/// Runs `$do` with the link `$id` as `$link`, if it is a link with one connection.
macro_rules! with_connection {
    ($links:expr, $id:expr, $link:ident => $do:expr) => {
        match $id {
            LinkId::STATE => $links.state.first_mut().map(|$link| $do),
            LinkId::MODBUS => $links.modbus.first_mut().map(|$link| $do),
            id => $links.recipes.iter_mut().find(|link| link.id == id).map(|$link| $do),
        }
    };
}

/// Runs `$do` with each link that has one connection as `$link`.
macro_rules! each_connection {
    ($links:expr, $link:ident => $do:expr) => {
        if let Some($link) = $links.state.first_mut() {
            $do
        }
        if let Some($link) = $links.modbus.first_mut() {
            $do
        }
        for $link in $links.recipes.iter_mut() {
            $do
        }
    };
}

/// The links that the configuration needs.
pub(crate) struct Links<'e> {
    pub host: &'e mut String<MAX_HOST>,
    pub command: &'e mut Maybe<CommandLink>,
    pub state: &'e mut Maybe<StateLink>,
    pub modbus: &'e mut Maybe<ModbusLink>,
    pub recipes: &'e mut VecView<RecipeLink>,
    /// At most as many as recipe links.
    pub devices: &'e mut VecView<DeviceLink>,
}

/// All links, read-only.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinksView<'a> {
    pub host: &'a str,
    pub command: Option<&'a CommandLink>,
    pub state: Option<&'a StateLink>,
    pub modbus: Option<&'a ModbusLink>,
    pub recipes: &'a [RecipeLink],
    pub devices: &'a [DeviceLink],
}

impl<'a> LinksView<'a> {
    pub(crate) fn infos(self) -> impl Iterator<Item = LinkInfo<'a>> {
        (0..).map_while(move |nth| self.nth(nth))
    }

    /// Since when the connection that brings a group's values is up; [`Instant::ZERO`] if it is down, or if the values
    /// do not come from the controller.
    pub(crate) fn up_since(self, group: GroupId) -> Instant {
        let state = self.state.into_iter().filter(|link| link.group == group).map(|link| &link.supervisor);
        let recipes =
            self.recipes.iter().filter(|link| link.group == Some(group)).map(|link| &link.supervisor);
        let modbus = self.modbus.into_iter().filter(|link| link.polls(group)).map(|link| &link.supervisor);
        match state.chain(recipes).chain(modbus).next().map(Supervisor::state) {
            Some(LinkState::Up { since }) => since,
            _ => Instant::ZERO,
        }
    }

    pub(crate) fn is_up(self, id: LinkId) -> bool {
        let supervisor = match id {
            LinkId::COMMAND => self.command.map(|link| &link.ordinary.supervisor),
            LinkId::URGENT => self.command.and_then(|link| Some(&link.urgent.as_ref()?.supervisor)),
            LinkId::STATE => self.state.map(|link| &link.supervisor),
            LinkId::MODBUS => self.modbus.map(|link| &link.supervisor),
            id => {
                let device = self.devices.iter().find(|link| link.id() == id).map(|link| &link.supervisor);
                device.or_else(|| self.recipes.iter().find(|link| link.id == id).map(|link| &link.supervisor))
            }
        };
        supervisor.is_some_and(Supervisor::is_up)
    }

    pub(crate) fn deadline(self) -> Instant {
        let mut first = self.deadline_of(LinkId::COMMAND);
        first = first.min(self.deadline_of(LinkId::STATE)).min(self.deadline_of(LinkId::MODBUS));
        for link in self.recipes {
            first = first.min(link.deadline()).min(link.supervisor.deadline());
        }
        for link in self.devices {
            first = first.min(link.deadline());
        }
        first
    }

    /// When something is due on one link without an input.
    pub(crate) fn deadline_of(self, id: LinkId) -> Instant {
        let of = |own: Instant, supervisor: &Supervisor| own.min(supervisor.deadline());
        let deadline = match id {
            LinkId::COMMAND | LinkId::URGENT => self.command.map(CommandLink::deadline),
            LinkId::STATE => self.state.map(|link| link.supervisor.deadline()),
            LinkId::MODBUS => self.modbus.map(|link| of(link.deadline(), &link.supervisor)),
            _ => {
                let link = self.recipes.iter().find(|link| link.id == id);
                link.map(|link| of(link.deadline(), &link.supervisor))
            }
        };
        deadline.unwrap_or(Instant::NEVER)
    }

    // Not a chain of iterators, whose code would be duplicated at each use.
    fn nth(self, mut nth: usize) -> Option<LinkInfo<'a>> {
        if let Some(link) = self.command {
            let session = match (nth, &link.urgent) {
                (0, _) => Some((LinkId::COMMAND, LinkKind::Command, &link.ordinary)),
                (1, Some(urgent)) => Some((LinkId::URGENT, LinkKind::Urgent, urgent)),
                _ => None,
            };
            if let Some((id, kind, session)) = session {
                let info = self.info(id, kind, link.transport(), &session.supervisor, &session.counters);
                return Some(LinkInfo { other_text: link.other_text_of(session), ..info });
            }
            nth = nth.saturating_sub(if link.urgent.is_some() { 2 } else { 1 });
        }
        if let Some(link) = self.state {
            if nth == 0 {
                let (id, kind) = (LinkId::STATE, LinkKind::State);
                return Some(self.info(id, kind, link.transport(), &link.supervisor, &link.counters));
            }
            nth = nth.saturating_sub(1);
        }
        if let Some(link) = self.modbus {
            if nth == 0 {
                let (id, kind) = (LinkId::MODBUS, LinkKind::Modbus);
                return Some(self.info(id, kind, link.transport(), &link.supervisor, &link.counters));
            }
            nth = nth.saturating_sub(1);
        }
        if let Some(link) = self.recipes.get(nth) {
            let info = self.info(link.id, link.kind, link.transport, &link.supervisor, &link.counters);
            return Some(LinkInfo { name: link.name.as_deref().unwrap_or(info.name), ..info });
        }
        let link = self.devices.get(nth.saturating_sub(self.recipes.len()))?;
        let info = self.info(link.id(), link.kind(), link.transport(), &link.supervisor, &link.counters);
        Some(LinkInfo { name: &link.name, endpoint: Endpoint::new(link.transport(), &link.host), ..info })
    }

    fn info(
        self,
        id: LinkId,
        kind: LinkKind,
        transport: Transport,
        supervisor: &'a Supervisor,
        counters: &'a LinkCounters,
    ) -> LinkInfo<'a> {
        let endpoint = Endpoint::new(transport, self.host);
        LinkInfo {
            id,
            name: kind.name(),
            kind,
            endpoint,
            state: supervisor.state(),
            history: supervisor.history(),
            counters,
            other_text: None,
            #[cfg(feature = "serde")]
            at: Instant::ZERO,
        }
    }
}

impl Links<'_> {
    pub(crate) fn view(&self) -> LinksView<'_> {
        LinksView {
            host: self.host,
            command: self.command.first(),
            state: self.state.first(),
            modbus: self.modbus.first(),
            recipes: self.recipes,
            devices: self.devices,
        }
    }

    /// The endpoint of a link of [`LinksView::infos`]; the host name is written to `buf`.
    pub(crate) fn endpoint<'b>(&self, id: LinkId, buf: &'b mut [u8]) -> Endpoint<'b> {
        let to = self.view().infos().find(|info| info.id == id).map(|info| info.endpoint);
        let to = to.unwrap_or(Endpoint::new(Transport::Tcp { port: 0 }, ""));
        let host = buf.get_mut(..to.host.len()).unwrap_or(&mut []);
        for (place, byte) in host.iter_mut().zip(to.host.bytes()) {
            *place = byte;
        }
        Endpoint::new(to.transport, core::str::from_utf8(host).unwrap_or(""))
    }

    /// Handles everything that depends on the time.
    pub(crate) fn advance(&mut self, store: &mut Store) {
        let now = store.now;
        if let Some(link) = self.command.first_mut() {
            link.advance(now);
            // Silence can complete a reply, too.
            self.note_failed(store);
        }
        each_connection!(self, link => {
            link.advance(store);
            if link.supervisor.advance(now) {
                link.lost(store);
            }
        });
    }

    /// The gateway itself slept: the age of data on its connections is unknown, so all of them are reopened.
    pub(crate) fn slept(&mut self, store: &mut Store) {
        let now = store.now;
        if let Some(link) = self.command.first_mut() {
            link.slept(now);
        }
        each_connection!(self, link => {
            link.supervisor.give_up(now);
            link.lost(store);
        });
        self.devices.iter_mut().for_each(|link| link.give_up(now));
    }

    /// The driver reports that a link is usable.
    pub(crate) fn up(&mut self, id: LinkId, store: &mut Store) {
        let now = store.now;
        if !store.safe.is_empty() {
            store.controller_was_away();
        }
        if let LinkId::COMMAND | LinkId::URGENT = id {
            self.command.iter_mut().for_each(|link| link.up(id, now));
            return;
        }
        with_connection!(self, id, link => {
            if link.supervisor.up(now) {
                link.opened(store);
            }
        });
    }

    /// The driver reports that a link is lost or could not be opened.
    pub(crate) fn down(&mut self, id: LinkId, store: &mut Store) {
        let now = store.now;
        if let LinkId::COMMAND | LinkId::URGENT = id {
            self.command.iter_mut().for_each(|link| link.down(id, now));
            return;
        }
        with_connection!(self, id, link => {
            if link.supervisor.down(now) {
                link.lost(store);
            }
        });
    }

    /// Notes bytes that arrived on a link. Returns whether [`Self::received`] has to read them: bytes of a link that is
    /// down belong to a connection that was given up.
    pub(crate) fn heard(&mut self, id: LinkId, len: usize, now: Instant) -> bool {
        if let LinkId::COMMAND | LinkId::URGENT = id {
            return self.command.first_mut().is_some_and(|link| link.heard(id, len, now));
        }
        with_connection!(self, id, link => {
            let is_up = link.supervisor.is_up();
            if is_up {
                link.supervisor.heard(now);
                add(&mut link.counters.bytes_in, len);
            }
            is_up
        })
        .unwrap_or(false)
    }

    /// Notes the controller's states for commands that have just failed.
    fn note_failed(&mut self, store: &Store) {
        if let Some(link) = self.command.first_mut()
            && link.failed.is_open
        {
            let newest = self.state.first();
            link.failed
                .note_states(newest.and_then(|link| Some((link.codes, store.image.stamp_of(link.group)?))));
        }
    }

    /// Reads the bytes; returns the rest if the image has to be checked first.
    pub(crate) fn received<'b>(&mut self, id: LinkId, bytes: &'b [u8], store: &mut Store) -> &'b [u8] {
        if let LinkId::COMMAND | LinkId::URGENT = id {
            self.command.iter_mut().for_each(|link| link.received(id, bytes, store.now));
            self.note_failed(store);
            return &[];
        }
        with_connection!(self, id, link => link.received(bytes, store)).unwrap_or(&[])
    }

    /// The transport has taken everything. Returns when something is due on the link without an input.
    pub(crate) fn sent(&mut self, id: LinkId) -> Instant {
        if let LinkId::COMMAND | LinkId::URGENT = id {
            self.command.iter_mut().for_each(|link| link.sent(id));
            return self.view().deadline_of(id);
        }
        let deadline = with_connection!(self, id, link => {
            link.sent();
            link.deadline()
        });
        deadline.unwrap_or(Instant::NEVER)
    }

    pub(crate) fn acked(&mut self, id: LinkId, left: u32, store: &mut Store) {
        if let LinkId::COMMAND | LinkId::URGENT = id {
            self.command.iter_mut().for_each(|link| link.acked(id, left));
            return;
        }
        with_connection!(self, id, link => link.acked(left, store));
    }

    /// The next output to the controller: commands that stop the robot, then field values, then other commands. Also
    /// returns the earliest of the link's deadlines that may have become earlier. Removes links from `ask` that have
    /// nothing to send before another event.
    pub(crate) fn next_link_frame(
        &mut self,
        ask: &mut Dirty,
        store: &mut Store,
        out: &mut [u8],
    ) -> Option<(LinkId, usize, Instant)> {
        if let Some(link) = self.command.first_mut()
            && let Some((id, len)) = link.next_stop(out, store.now)
        {
            return Some((id, len, link.deadline()));
        }
        if ask.has(Dirty::RECIPES) {
            let state = self.state.first().map(|state| state.group);
            let mut left = self.recipes.len();
            for link in self.recipes.iter_mut() {
                left = left.wrapping_sub(1);
                if let Some(len) = link.next_frame(store, state, out) {
                    // This link is busy now, and those before it had nothing to send.
                    if left == 0 {
                        ask.remove(Dirty::RECIPES);
                    }
                    return Some((link.id, len, link.deadline()));
                }
            }
            ask.remove(Dirty::RECIPES);
        }
        if ask.has(Dirty::MODBUS) {
            // One transaction at a time.
            ask.remove(Dirty::MODBUS);
            if let Some(link) = self.modbus.first_mut()
                && let Some(len) = link.next_request(store, out)
            {
                return Some((LinkId::MODBUS, len, link.answer_deadline()));
            }
        }
        let link = self.command.first_mut()?;
        link.next_command(out, store.now).map(|len| (LinkId::COMMAND, len, link.deadline()))
    }

    /// What may have an output after an event on this link. With a command link all links may, because it depends on
    /// what the others do.
    pub(crate) fn ask_of(&self, link: LinkId) -> Dirty {
        if !self.command.is_empty() {
            return Dirty::LINKS;
        }
        match link {
            LinkId::STATE => Dirty::NONE,
            LinkId::MODBUS => Dirty::MODBUS,
            _ => Dirty::RECIPES,
        }
    }

    /// What may have an output after bytes arrived on this link, and the earliest of its deadlines that may have become
    /// earlier.
    pub(crate) fn asked_by_bytes(
        &mut self,
        id: LinkId,
        waiting: &InputSet,
        now: Instant,
    ) -> (Dirty, Instant) {
        if self.command.is_empty() {
            match id {
                // Its only deadline is that of silence, which moves back.
                LinkId::STATE if self.state.first().is_some_and(|link| link.supervisor.is_up()) => {
                    return (Dirty::NONE, Instant::NEVER);
                }
                LinkId::MODBUS => {
                    if let Some(link) = self.modbus.first_mut()
                        && link.supervisor.is_up()
                    {
                        return (Dirty::MODBUS.when(link.may_ask(waiting, now)), link.deadline());
                    }
                }
                _ => {}
            }
        }
        let mut asked = self.ask_of(id);
        asked.add(Dirty::ACTIONS);
        (asked, self.view().deadline_of(id))
    }

    /// Adds the links that write one of the waiting variables.
    pub(crate) fn ask_for(&self, waiting: &InputSet, mut asked: Dirty) -> Dirty {
        if waiting.is_empty() {
            return asked;
        }
        let is_wanted = |writes: &InputSet| !waiting.and(writes).is_empty();
        asked.add(Dirty::RECIPES.when(self.recipes.iter().any(|link| is_wanted(&link.writes))));
        asked.add(Dirty::MODBUS.when(self.modbus.first().is_some_and(|link| is_wanted(&link.writes))));
        asked
    }

    /// Whether a command that stops the robot waits.
    pub(crate) fn has_stops(&self) -> bool {
        self.command.first().is_some_and(CommandLink::has_stops)
    }

    /// The next link to open or close.
    pub(crate) fn next_action(&mut self) -> Option<(LinkId, LinkAction)> {
        if let Some(link) = self.command.first_mut() {
            if let Some(action) = link.ordinary.supervisor.take_action() {
                return Some((LinkId::COMMAND, action));
            }
            if let Some(action) = link.urgent.as_mut().and_then(|link| link.supervisor.take_action()) {
                return Some((LinkId::URGENT, action));
            }
        }
        if let Some(action) = self.state.first_mut().and_then(|link| link.supervisor.take_action()) {
            return Some((LinkId::STATE, action));
        }
        if let Some(action) = self.modbus.first_mut().and_then(|link| link.supervisor.take_action()) {
            return Some((LinkId::MODBUS, action));
        }
        let mut recipes = self.recipes.iter_mut();
        let action = recipes.find_map(|link| link.supervisor.take_action().map(|action| (link.id, action)));
        action.or_else(|| {
            let mut devices = self.devices.iter_mut();
            devices.find_map(|link| link.supervisor.take_action().map(|action| (link.id(), action)))
        })
    }
}
