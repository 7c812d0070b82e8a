//! What a gateway file of version 0.2 means now, where its meaning has changed.
//!
//! In: the configuration, and its recipes as frames. Out: sentences, each with its key. A key that 0.2 did not have
//! shows that the author knows the new meaning, so nothing is reported for it.

use proto_core::command::{Action, Keyword, Request};
use proto_core::config::{
    Bus, Echo, Exchange, FieldSpec, GatewayConfig, InputBinding, Port, Recipe, Span, Transaction,
};
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;

use crate::device::{DeviceField, DeviceRecipe, NamedExchange, NamedFrame};

/// The key, and the sentence about it.
type Placed = (Vec<String>, String);

/// What has another meaning than in version 0.2, in the order of the ports. `recipes` are the recipes of the file as
/// [`load_frames`](crate::file::load_frames) reads them.
pub fn changes_since_0_2(config: &GatewayConfig, recipes: &[Option<DeviceRecipe>]) -> Vec<Placed> {
    let mut told = Vec::new();
    for (_, port, recipe) in config.view().field_ports() {
        let frames = recipes.get(usize::from(port.recipe)).and_then(Option::as_ref);
        let exchanges = config.view().exchanges_of(recipe);
        let mut changes = PortChanges { config, port, recipe, exchanges, told: &mut told };
        changes.commands();
        changes.echo();
        changes.presence();
        changes.late();
        // Frames of recipes that the controller can have too are still rejected as a whole.
        let frames = frames.filter(|_| config.view().is_device(recipe));
        for (nth, frame) in (1..).zip(frames.iter().flat_map(|frames| &frames.input)) {
            changes.rejected_fields(nth, frame);
        }
        for nth in 0..exchanges.len() {
            changes.exchange(nth, frames.and_then(|frames| frames.exchanges.get(nth)));
        }
    }
    told
}

struct PortChanges<'a> {
    config: &'a GatewayConfig,
    port: &'a Port,
    recipe: &'a Recipe,
    exchanges: &'a [Exchange],
    told: &'a mut Vec<Placed>,
}

impl PortChanges<'_> {
    /// Reports a change at `key` of the recipe.
    fn tell(&mut self, key: &[&str], said: &str) {
        let place = key.iter().map(|key| format!(", {key}")).collect::<String>();
        let path = ["recipe", &self.recipe.name].into_iter().chain(key.iter().copied());
        let message = format!("port {:?}{place}: {said}", self.port.name);
        self.told.push((path.map(str::to_owned).collect(), message));
    }

    /// Reports a change at `key` of the exchange with this index.
    fn tell_of(&mut self, nth: usize, key: &str, said: &str) {
        let (recipe, number) = (self.recipe.name.to_string(), (nth + 1).to_string());
        let path = ["recipe", &recipe, "exchange", &number, key].map(str::to_owned).to_vec();
        self.told.push((path, format!("port {:?}, exchange {number}, {key}: {said}", self.port.name)));
    }

    /// Changes of replies of port 2000.
    fn commands(&mut self) {
        let changes = |table: Span| {
            table.of(&self.config.commands).iter().any(|command| {
                let request = Request::parse(command.text.as_bytes());
                request.is_ok_and(|request| {
                    use Action::{Disable, Enable, PowerOff, PowerOn};
                    matches!(request.keyword(), Keyword::Do(PowerOn | PowerOff | Enable | Disable))
                })
            })
        };
        let mut fields = self.config.view().fields_of(self.recipe, Direction::Input);
        let is_changed = fields.any(|(_, _, field)| match *field {
            FieldSpec::UserInput { to: InputBinding::Commands { table, .. }, .. }
            | FieldSpec::DeviceInput { to: InputBinding::Commands { table, .. }, .. } => changes(table),
            _ => false,
        });
        if is_changed {
            self.tell(
                &["commands"],
                "a reply such as `already poweron` is success, and words that nobody knows end nothing; in 0.2 both closed \
                 the connection after 10 s, and the commands behind were dropped",
            );
        }
    }

    fn echo(&mut self) {
        let Bus::Rs485(line) = &self.port.bus else { return };
        let may_be_echo = |exchange: &Exchange| match exchange.transaction {
            Transaction::Rtu { operation, .. } => operation.is_repeated_by_reply(),
            Transaction::Served { .. } | Transaction::Frames { .. } => true,
        };
        let concerned = |exchange: &Exchange| exchange.is_answered() && may_be_echo(exchange);
        if line.echo == Echo::Auto && self.exchanges.iter().any(concerned) {
            let name = self.port.name.to_string();
            let said = format!(
                "port {name:?}, echo: learned from a reply that differs from its request; until then one that equals it \
                 confirms nothing. In 0.2 a line had none; echo = false means that"
            );
            self.told.push((["port", &name, "echo"].map(str::to_owned).to_vec(), said));
        }
    }

    /// Changes of a frame of the input part; `nth` counts from 1.
    fn rejected_fields(&mut self, nth: usize, frame: &NamedFrame) {
        if let Some(said) = self.rejects(frame, self.port.timeout) {
            match frame.id {
                Some(_) => self.tell(&["input", "frame", &nth.to_string()], &said),
                None => self.tell(&["input"], &said),
            }
        }
    }

    /// Which fields of a frame are rejected alone; `None` if no other field of the frame could be accepted.
    fn rejects(&self, frame: &NamedFrame, timeout: Duration) -> Option<String> {
        let used = |field: &&DeviceField| !field.repeats && is_used(&field.spec);
        let rejected = frame.fields.iter().filter(used).filter(|field| may_be_rejected(field));
        let names: Vec<_> = rejected.map(|field| format!("{:?}", field.name)).collect();
        (!names.is_empty() && frame.fields.iter().filter(used).count() > 1).then(|| {
            let after = match timeout {
                Port::NEVER => "and the old value of that field holds".to_owned(),
                timeout => format!("and that field goes to its value of on_timeout after {timeout}, or holds"),
            };
            format!(
                "what does not fit, or cannot be read, rejects only its field ({}): the others are taken, {after}. In 0.2 \
                 it rejected the frame",
                names.join(", ")
            )
        })
    }

    fn exchange(&mut self, nth: usize, named: Option<&NamedExchange>) {
        let Some(&exchange) = self.exchanges.get(nth) else { return };
        self.event(nth, &exchange);
        self.start(nth, &exchange);
        self.refusals(nth, &exchange);
        if let Some(reply) = named.and_then(|named| named.reply.as_ref())
            && let Some(said) = self.rejects(reply, exchange.overdue.unwrap_or(self.port.timeout))
        {
            let is_modbus = matches!(exchange.transaction, Transaction::Rtu { .. });
            self.tell_of(nth, if is_modbus { "read" } else { "reply" }, &said);
        }
        if exchange.is_answered() && named.is_some_and(is_sdo_without_refusal) {
            self.tell_of(
                nth,
                "refusal",
                "an abort of the object that was asked for is an answer: the node is there and refuses. In 0.2 it was no \
                 reply",
            );
        }
    }

    fn event(&mut self, nth: usize, exchange: &Exchange) {
        if exchange.is_event() && exchange.when.rising.is_some() && exchange.trigger.is_none() {
            let trigger = exchange.trigger(self.port.timeout);
            let said = format!(
                "a rise is sent once, with its values, within {trigger} (trigger_ms), or not at all. In 0.2 it was sent \
                 whenever that became possible, with the values of then"
            );
            self.tell_of(nth, "on", &said);
        }
        // Without the key, the file's value is 0 for events and 1 for states.
        let has_no_retries = exchange.retries == 1 && exchange.event_retries == 0;
        let is_changed = exchange.is_start_event() || exchange.is_event() && exchange.follow.is_none();
        if is_changed && exchange.is_answered() && has_no_retries {
            self.tell_of(
                nth,
                "retries",
                "it is not repeated when its reply is lost. In 0.2 it was, once; retries = 1 does that, and the device may \
                 carry it out twice",
            );
        }
        let before = self.exchanges.get(..nth).unwrap_or(&[]);
        let is_step = |other: &Exchange| {
            other.peer == exchange.peer && other.when.rising == exchange.when.rising && !other.stop
        };
        if exchange.when.rising.is_some()
            && !exchange.stop
            && let Some(first) = before.iter().rposition(is_step)
        {
            let said = format!(
                "exchange {} has the same bit, so this one is sent only after the good answer to it. In 0.2 it was sent \
                 whatever the answer",
                first + 1
            );
            self.tell_of(nth, "on", &said);
        }
    }

    fn start(&mut self, nth: usize, exchange: &Exchange) {
        if exchange.when.start {
            let said = format!(
                "what the start asks for is asked again only when the device was away for {} or more (absent_ms of the \
                 port). In 0.2 lost replies were enough",
                self.port.absent
            );
            self.tell_of(nth, "on", &said);
        }
    }

    /// Reports the waits for late replies: for each group that looks alike, and together for all others.
    fn late(&mut self) {
        let mut alone = Vec::new();
        for (nth, exchange) in self.exchanges.iter().enumerate() {
            let alike = self.config.view().held_back_by(self.recipe, exchange);
            let is_first = alike.trailing_zeros() as usize == nth;
            if !exchange.is_answered() || exchange.late.is_some() || exchange.stop || !is_first {
                continue;
            }
            if alike.count_ones() == 1 {
                alone.push(nth);
                continue;
            }
            let numbers = numbers((0..64).filter(|bit| alike >> bit & 1 == 1));
            let said = format!(
                "the replies to exchanges {numbers} look alike, so none of these is asked for {} after a reply that did \
                 not come, and after the start. In 0.2 nothing waited; late_ms = 0 does not",
                exchange.late()
            );
            self.tell_of(nth, "late_ms", &said);
        }
        if let Some(&first) = alone.first() {
            let said = format!(
                "an exchange whose reply did not come is not asked again for three times its timeout_ms, at least 1 s \
                 ({}). In 0.2 nothing waited; late_ms = 0 does not",
                numbers(alone.into_iter())
            );
            self.tell_of(first, "late_ms", &said);
        }
    }

    fn refusals(&mut self, nth: usize, exchange: &Exchange) {
        let writes =
            matches!(exchange.transaction, Transaction::Rtu { operation, .. } if operation.written_len() > 0);
        let is_state = exchange.when.change && exchange.when.every.is_none() && !exchange.stop;
        if writes && is_state && exchange.is_answered() {
            self.tell_of(
                nth,
                "on",
                "a change that the device refuses as busy (6), or with 4, 8, 10 or 11, is written again. In 0.2 it was \
                 given up",
            );
        }
    }

    /// How an exchange that is never answered affects the other exchanges of its device.
    fn presence(&mut self) {
        let answered = |peer: u8| {
            let of_peer = move |one: &&Exchange| one.peer == peer && one.is_answered();
            self.exchanges.iter().filter(of_peer).count()
        };
        let first = self.exchanges.iter().position(|one| one.is_answered() && answered(one.peer) > 1);
        if let Some(first) = first {
            let is_modbus =
                self.exchanges.iter().any(|one| matches!(one.transaction, Transaction::Rtu { .. }));
            self.tell_of(
                first,
                if is_modbus { "slave" } else { "peer" },
                "a device is away when nothing is heard of it; an exchange that is never answered beside others is asked \
                 less often by itself. In 0.2 it made the whole device away",
            );
        }
    }
}

/// Numbers from 1, as files count.
fn numbers(indices: impl Iterator<Item = usize>) -> String {
    indices.map(|nth| (nth + 1).to_string()).collect::<Vec<_>>().join(", ")
}

/// Whether an input field is used for anything.
fn is_used(field: &FieldSpec) -> bool {
    match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            !matches!(to, InputBinding::Unused | InputBinding::Counter { .. })
        }
        FieldSpec::TextInput { to, .. } => to.is_some(),
        _ => false,
    }
}

/// Whether a field can have a value that does not fit its variable or is not a number. A field with limits, a map or
/// another rule has been edited since 0.2, which had none of these.
fn may_be_rejected(field: &DeviceField) -> bool {
    let may_be = match &field.spec {
        FieldSpec::DeviceInput { encoding, to: InputBinding::Variable { .. }, .. } => {
            !encoding.reads_integers() || encoding.is_digits() || field.spec.fitting().is_some()
        }
        FieldSpec::UserInput { .. } => field.spec.fitting().is_some(),
        FieldSpec::TextInput { .. } => true,
        _ => false,
    };
    may_be && field.sendable.is_empty()
}

/// Whether the exchange requests an object from a CANopen node, and the file does not say what a refusal is.
fn is_sdo_without_refusal(exchange: &NamedExchange) -> bool {
    let id = |frame: &Option<NamedFrame>| match frame.as_ref()?.id {
        Some(CanId::Standard(id)) => Some(id),
        _ => None,
    };
    match (id(&exchange.request), id(&exchange.reply)) {
        (Some(request @ 0x601..=0x67F), Some(reply)) => reply + 0x80 == request && exchange.refusal.is_none(),
        _ => false,
    }
}
