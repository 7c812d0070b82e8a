//! Commands that field values select: each is sent once or not at all, and urgent ones go first
//! (proto-core/docs/engine.md section 7).

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proto_core::config::{CommandWhen, MAX_PORTS};
use proto_core::engine::{Engine, LinkId};
use proto_core::time::{Duration, Instant};

use super::Invariant;
use super::field::Accepted;
use super::invariant::Wrong;
use super::spec::Spec;

/// Maximum number of waiting commands.
const QUEUE: usize = 8;
/// A command that waits longer than this is dropped; an urgent one if it was not requested for this long.
const TTL: Duration = Duration::from_secs(1);

/// The place of a command field: indices of port, frame and field.
pub(super) type Place = (usize, usize, usize);

/// A command that a value selected.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Command {
    pub place: Place,
    value: i64,
    pub text: String,
    /// When the command was selected.
    pub picked: Instant,
    /// For an urgent command: since when it is no longer requested, or since when it waits again.
    since: Instant,
    /// When the command was sent, while it is unanswered.
    sent: Instant,
}

/// Waiting commands, unanswered commands, and counters.
#[derive(Debug, Clone, Default)]
pub(super) struct Commands {
    queue: VecDeque<Command>,
    urgent: Vec<Command>,
    unanswered: Vec<(LinkId, Command)>,
    /// Number of waiting commands that an urgent command has overtaken.
    overtaken: usize,
    /// The value in the previous frame.
    base: BTreeMap<Place, i64>,
    /// Fields that had a base when the gateway slept, and no frame since. The frame that changed their value may be
    /// discarded.
    woke: BTreeSet<Place>,
    /// The fields whose base survives silence.
    kept: BTreeSet<Place>,
    /// The results per port.
    pub counted: [Counted; MAX_PORTS],
    /// Text of the newest command sent.
    newest: Option<String>,
    /// Texts of the commands that were selected by frames that waited while the gateway slept.
    slept: Vec<String>,
    /// Number of replies that the engine has counted, and text received since, on each of the two links.
    answered: [u32; 2],
    heard: [String; 2],
}

/// The results of a port's command values.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Counted {
    pub picked: u32,
    pub dropped: u32,
    /// Number of values that are in no table.
    pub unknown: u32,
    /// Number of values that only set the base.
    pub based: u32,
}

impl Command {
    pub(super) fn is_urgent(&self) -> bool {
        is_urgent(&self.text)
    }
}

impl Commands {
    /// Queues the commands that an accepted frame selects; returns the urgent ones.
    pub(super) fn accepted(
        &mut self,
        spec: &Spec,
        nth: usize,
        frame: &Accepted,
        is_up: bool,
        now: Instant,
    ) -> Vec<Command> {
        let mut urgent = Vec::new();
        for &(field, table, when, value) in &frame.commands {
            let place = (nth, frame.frame, field);
            let (before, woke) = (self.base.insert(place, value), self.woke.remove(&place));
            let changed = before.is_some_and(|before| before != value);
            if changed {
                self.no_longer_asked(place, now);
            }
            if when == CommandWhen::Kept {
                self.kept.insert(place);
            }
            let acts = when == CommandWhen::Frame || changed;
            if !acts && before.is_some() {
                continue;
            }
            let table = table.of(&spec.commands);
            let counted = &mut self.counted[nth];
            let Some(entry) = table.iter().find(|entry| entry.has(value)) else {
                let is_idle = value == 0 && table.iter().all(|entry| !entry.text.is_empty());
                counted.unknown += u32::from(!is_idle);
                continue;
            };
            if entry.text.is_empty() {
                continue;
            }
            let text = plain(entry.text_for(value).as_bytes());
            let is_held_stop = woke && is_urgent(&text);
            if !acts && !is_held_stop {
                counted.based += 1;
                continue;
            }
            counted.picked += 1;
            let command = Command { place, value, text, picked: now, since: now, sent: Instant::ZERO };
            if command.is_urgent() {
                urgent.push(command.clone());
                match self.urgent.iter_mut().find(|other| other.same_kind(&command)) {
                    Some(other) => *other = command,
                    None => self.urgent.push(command),
                }
            } else if is_up && self.queue.len() < QUEUE {
                self.queue.push_back(command);
            } else {
                counted.dropped += 1;
            }
        }
        if !urgent.is_empty() {
            // Urgent commands overtake all others, including those of later fields of the frame.
            self.overtaken = self.queue.len();
        }
        urgent
    }

    /// Drops commands that an urgent command has overtaken.
    pub(super) fn drop_overtaken(&mut self) {
        for _ in 0..std::mem::take(&mut self.overtaken) {
            self.drop_first();
        }
    }

    /// A device's frame is overdue, or without `frame` the device is gone: its next value only sets
    /// the base, and its waiting commands are dropped. Silence is normal for fields that keep it.
    pub(super) fn forget(&mut self, nth: usize, frame: Option<usize>, now: Instant) {
        if frame.is_none() {
            self.woke.retain(|place| place.0 != nth);
        }
        let is_of = |place: &Place| place.0 == nth && frame.is_none_or(|frame| frame == place.1);
        let keeps = |place: &Place| frame.is_some() && self.kept.contains(place);
        let gone = self.base.keys().copied().filter(|place| is_of(place) && !keeps(place));
        let gone: Vec<Place> = gone.collect();
        self.lose(gone, now);
    }

    /// A command field was rejected for as long as its device may be silent.
    pub(super) fn forget_one(&mut self, place: Place, now: Instant) {
        let is_lost = self.base.contains_key(&place) && !self.kept.contains(&place);
        self.lose(is_lost.then_some(place), now);
    }

    fn lose(&mut self, gone: impl IntoIterator<Item = Place>, now: Instant) {
        for place in gone {
            self.base.remove(&place);
            self.no_longer_asked(place, now);
        }
        let (base, counted) = (&self.base, &mut self.counted);
        self.queue.retain(|command| {
            let stays = base.contains_key(&command.place);
            counted[command.place.0].dropped += u32::from(!stays);
            stays
        });
    }

    fn no_longer_asked(&mut self, place: Place, now: Instant) {
        for stop in self.urgent.iter_mut().filter(|stop| stop.place == place) {
            stop.since = now;
        }
    }

    /// Whether the device still sends the value that selected the command.
    pub(super) fn is_asked(&self, command: &Command) -> bool {
        self.base.get(&command.place) == Some(&command.value)
    }

    /// Drops commands that have waited too long.
    pub(super) fn tick(&mut self, now: Instant) {
        while self.queue.front().is_some_and(|first| now >= first.picked + TTL) {
            self.drop_first();
        }
        let is_old = |commands: &Self, stop: &Command| now >= stop.since + TTL && !commands.is_asked(stop);
        while let Some(old) = self.urgent.iter().position(|stop| is_old(self, stop)) {
            let old = self.urgent.remove(old);
            self.counted[old.place.0].dropped += 1;
        }
    }

    /// A link was lost: unanswered urgent commands wait again if they are still requested.
    pub(super) fn lost(&mut self, link: LinkId, now: Instant) {
        let gone: Vec<Command> = self
            .unanswered
            .iter()
            .filter(|(on, _)| *on == link)
            .map(|(_, command)| command.clone())
            .collect();
        self.unanswered.retain(|(on, _)| *on != link);
        // Of two equal commands, the newer one is sent again.
        for command in gone.into_iter().rev() {
            let waits = self.urgent.iter().any(|other| other.same_kind(&command));
            if command.is_urgent() && self.is_asked(&command) && !waits {
                self.urgent.push(Command { since: now, ..command });
            }
        }
        if link == LinkId::COMMAND {
            while !self.queue.is_empty() {
                self.drop_first();
            }
        }
        self.heard[side(link)].clear();
    }

    /// The gateway slept: commands selected before are dropped.
    pub(super) fn slept(&mut self, now: Instant) {
        self.woke.extend(std::mem::take(&mut self.base).into_keys());
        self.lost(LinkId::COMMAND, now);
        self.lost(LinkId::URGENT, now);
        for stop in std::mem::take(&mut self.urgent) {
            self.counted[stop.place.0].dropped += 1;
        }
        self.slept.clear();
    }

    /// Remembers the commands that a discarded frame would have selected.
    pub(super) fn waited_in_sleep(&mut self, spec: &Spec, frame: &Accepted) {
        for &(_, table, _, value) in &frame.commands {
            let picked = table.of(&spec.commands).iter().find(|entry| entry.has(value));
            self.slept.extend(picked.map(|entry| plain(entry.text_for(value).as_bytes())));
        }
    }

    fn drop_first(&mut self) {
        if let Some(command) = self.queue.pop_front() {
            self.counted[command.place.0].dropped += 1;
        }
    }

    /// The controller sends on one of the links to port 2000.
    pub(super) fn hears(&mut self, link: LinkId, bytes: &[u8]) {
        self.heard[side(link)].push_str(&String::from_utf8_lossy(bytes));
    }

    /// Matches the replies that the engine has counted with unanswered commands. A complete reply that the engine has
    /// not counted is an error.
    pub(super) fn match_replies(&mut self, engine: &Engine) -> Result<(), Wrong> {
        if self.unanswered.is_empty() {
            self.heard.iter_mut().for_each(String::clear);
            return Ok(());
        }
        for info in engine.links() {
            if info.id != LinkId::COMMAND && info.id != LinkId::URGENT {
                continue;
            }
            let place = side(info.id);
            let news = info.counters.received.wrapping_sub(self.answered[place]);
            self.answered[place] = info.counters.received;
            for _ in 0..news {
                let mine = |(on, _): &&(LinkId, Command)| *on == info.id;
                let is_named = |command: &Command| self.heard[place].contains(word(&command.text));
                let named = self.unanswered.iter().position(|sent| mine(&sent) && is_named(&sent.1));
                let first = self.unanswered.iter().position(|sent| mine(&sent));
                let Some(nth) = named.or(first) else { continue };
                let (_, command) = self.unanswered.remove(nth);
                // The same received piece may also contain the reply to another command.
                let heard = &mut self.heard[place];
                *heard = heard.replacen(word(&command.text), "", 1);
            }
            let mut unanswered = self.unanswered.iter().filter(|(on, _)| *on == info.id);
            let heard = &self.heard[place];
            if let Some((reply, text)) =
                unanswered.find_map(|(_, command)| Some((command.reply_in(heard)?, &command.text)))
            {
                return Err((Invariant::Counted, format!("{reply:?} came, and {text} is still unanswered")));
            }
            if self.unanswered.iter().all(|(on, _)| *on != info.id) {
                self.heard[place].clear();
            }
        }
        Ok(())
    }

    /// Checks a command that the engine sends, and returns it.
    pub(super) fn sent(&mut self, link: LinkId, bytes: &[u8], now: Instant) -> Result<Command, Wrong> {
        let text = plain(bytes);
        let shown = String::from_utf8_lossy(bytes).trim().to_owned();
        let command = if is_urgent(&text) {
            let Some(nth) = self.urgent.iter().position(|stop| stop.text == text) else {
                return Err(self.nobody_picked(&shown, &text));
            };
            let stop = self.urgent.remove(nth);
            if now >= stop.since + TTL && !self.is_asked(&stop) {
                return Err((Invariant::Once, format!("{shown} was sent too late")));
            }
            stop
        } else {
            if link == LinkId::URGENT {
                return Err((
                    Invariant::Once,
                    format!("{shown} was sent where only urgent commands may be sent"),
                ));
            }
            if !self.urgent.is_empty() || self.unanswered.iter().any(|(_, command)| command.is_urgent()) {
                let what = format!("{shown} was sent while an urgent command waits or is unanswered");
                return Err((Invariant::Once, what));
            }
            let Some(next) = self.queue.pop_front() else { return Err(self.nobody_picked(&shown, &text)) };
            if next.text != text {
                return Err((Invariant::Once, format!("{shown} was sent, but {} was next", next.text)));
            }
            if now >= next.picked + TTL {
                return Err((Invariant::Once, format!("{shown} was sent too late")));
            }
            next
        };
        self.newest = Some(text);
        self.unanswered.push((link, Command { sent: now, ..command.clone() }));
        Ok(command)
    }

    /// Until when an urgent command may wait because an equal one is unanswered, which is then given up.
    pub(super) fn waits_until(&self, command: &Command) -> Instant {
        let alike = self.unanswered.iter().filter(|(_, sent)| sent.text == command.text);
        alike.map(|(_, sent)| sent.sent + TTL).max().unwrap_or(Instant::ZERO)
    }

    fn nobody_picked(&self, shown: &str, text: &str) -> Wrong {
        if self.slept.iter().any(|slept| slept == text) {
            return (
                Invariant::FromSleep,
                format!("{shown} was picked by a frame that waited while the gateway slept"),
            );
        }
        let again = self.newest.as_deref() == Some(text);
        let what = if again { "once more than it was picked" } else { "although no value picked it" };
        (Invariant::Once, format!("{shown} was sent {what}"))
    }

    pub(super) fn len(&self) -> usize {
        self.queue.len() + self.urgent.len() + self.heard.iter().map(String::len).sum::<usize>()
    }
}

impl Command {
    /// The reply to this command in a text that the controller sent, in the format of any software version.
    fn reply_in(&self, heard: &str) -> Option<String> {
        let word = word(&self.text);
        let forms = match word {
            "run" => vec!["run start".to_owned(), "run success".to_owned(), "run fail".to_owned()],
            "speed" => vec!["set success".to_owned(), "set fail".to_owned()],
            _ => vec![format!("{word} success"), format!("{word} fail"), format!("already {word}")],
        };
        forms.into_iter().find(|reply| heard.contains(reply))
    }

    fn same_kind(&self, other: &Self) -> bool {
        self.place.0 == other.place.0 && self.text == other.text
    }
}

fn side(link: LinkId) -> usize {
    usize::from(link == LinkId::URGENT)
}

/// The keyword of the command.
fn word(text: &str) -> &str {
    text.split('(').next().unwrap_or(text)
}

fn is_urgent(text: &str) -> bool {
    matches!(text, "stop" | "pause" | "disable" | "poweroff")
}

/// The text of a command without the additions of dialects.
pub(super) fn plain(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    text.chars()
        .filter(|c| !c.is_whitespace() && !matches!(c, '"' | '\0'))
        .collect::<String>()
        .replace("()", "")
}
