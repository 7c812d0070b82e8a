//! Builds an engine from a configuration.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use heapless::Vec;

use super::codecs::{can_codec, index_of, stream_codec, stream_layout};
use super::exchanges::Places;
use super::routes::{Plan, Route, Source, sent_by, shown_by, uplinks};
use crate::config::{
    Bus, ConfigView, Counted, FieldSpec, InputBinding, InputRule, MAX_SAFE_VALUES, MAX_SENDABLE, MIN_CYCLE,
    OutputBinding, Parts, Port, Recipe, SendOn, Span, listen_address,
};
use crate::engine::build_error::{BuildError, one_too_many};
use crate::engine::counters::PortCounters;
use crate::engine::dispatch::EngineView;
use crate::engine::field::bindings::{InputBind, InputTo, OutputBind, Sendable};
use crate::engine::field::codec::{Codec, DeviceCodec};
use crate::engine::field::line_timing::LineTiming;
use crate::engine::field::port::FieldPort;
use crate::engine::field::rules::{scale_word, words_of};
use crate::engine::field::sender::Sender;
use crate::engine::io::{BusState, LinkId, LinkKind, PortId, ReplyCode, Transport};
use crate::engine::link::command::CommandLink;
use crate::engine::link::command_tables::MAX_COMMAND_BYTES;
use crate::engine::link::device::DeviceLink;
use crate::engine::link::modbus::{MAX_POLL_BLOCKS, ModbusLink};
use crate::engine::link::recipe::{RecipeLink, RecipeLinkSetup};
use crate::engine::link::state::StateLink;
use crate::engine::values::bits::{MAX_SHARES, SafeBytes};
use crate::engine::values::counts::MAX_COUNTS;
use crate::engine::values::outbox::EdgeQueue;
use crate::engine::values::store::{InputFrame, MAX_INPUT_FRAMES};
use crate::engine::values::withheld::MAX_COMMAND_FIELDS;
use crate::image::{GroupId, InputSet, MAX_GROUPS};
use crate::link::LinkTimings;
use crate::recipe::model::Framing;
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::ScalarType;

/// Assigns groups in order, field frames first.
pub(crate) struct Groups(u8);

impl Groups {
    pub(crate) fn next(&mut self) -> Option<GroupId> {
        let group = GroupId(self.0);
        (usize::from(self.0) < MAX_GROUPS).then(|| self.0 = self.0.saturating_add(1))?;
        Some(group)
    }
}

impl EngineView<'_> {
    // Out of line, like the other parts that make large values: inlined into a run loop, their stack frames would be
    // held forever and add up.
    #[inline(never)]
    pub(crate) fn build(&mut self, config: ConfigView<'_>) -> Result<(), BuildError> {
        config.validate().map_err(BuildError::Config)?;
        // One copy of the plan, where `map_err` would make two.
        let plan = match Plan::new(config) {
            Ok(plan) => plan,
            Err(error) => return Err(BuildError::Plan(error)),
        };
        let dialect = Dialect::named(&config.controller.dialect).ok_or(BuildError::UnknownDialect)?;
        self.check_room(config)?;
        // Cannot fail: the configuration has the same maximum length.
        let _ = self.links.host.push_str(&config.controller.address);
        for value in config.safe_values {
            // Cannot fail: validation has refused more than fit.
            let _ = self.safe_values.push(SafeBytes::new(value));
        }
        for (index, port, recipe) in config.field_ports() {
            self.add_port(config, index, port, recipe, dialect)?;
            self.add_codec(config, port, recipe)?;
        }
        let mut groups = Groups(self.store.frames.len() as u8);
        for (id, recipe) in uplinks(config) {
            self.add_recipe_link(config, &plan, id, recipe, &mut groups)?;
        }
        if plan.needs_state() {
            let group = groups.next().ok_or(one_too_many(Counted::Groups, MAX_GROUPS))?;
            let mut link = StateLink::new(config.controller.state_port, dialect, group, plan.read_back());
            link.share(&self.store.bits.bytes);
            let _ = self.links.state.push(link);
        }
        if plan.needs_modbus() {
            let writes = SysVar::all().filter(|&var| plan.route(var) == Some(Route::Modbus)).collect();
            let link = ModbusLink::new(config.controller.modbus_port, dialect.modbus_unit, writes);
            let _ = self.links.modbus.push(link);
        }
        self.assign_read_back(&plan);
        self.assign_sources(config, &plan, &mut groups)?;
        self.assign_extra(&dialect)?;
        self.assign_health(config, &mut groups)?;
        self.assign_witnesses();
        Ok(())
    }

    /// Checks the capacities that only need counts.
    fn check_room(&self, config: ConfigView<'_>) -> Result<(), BuildError> {
        let (mut ports, mut frames, mut inputs, mut outputs, mut commands) =
            (0_usize, 0_usize, 0_usize, 0_usize, 0_usize);
        for (_, _, recipe) in config.field_ports() {
            ports = ports.saturating_add(1);
            frames = frames.saturating_add(config.frames_of(recipe, Direction::Input).count());
            for (_, _, field) in config.fields_of(recipe, Direction::Input) {
                let to = match field {
                    FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => *to,
                    _ if field.element().is_some() => InputBinding::Unused,
                    _ => {
                        // The rules of a field.
                        inputs = inputs.saturating_add(words_of(field).count());
                        continue;
                    }
                };
                inputs = inputs.saturating_add(1);
                commands = commands.saturating_add(usize::from(matches!(to, InputBinding::Commands { .. })));
            }
            outputs = config
                .fields_of(recipe, Direction::Output)
                .filter(|(_, _, field)| field.element().is_some())
                .fold(outputs, |count, _| count.saturating_add(1));
        }
        let is_tcp = |(_, port, _): &(u8, &Port, &Recipe)| port.bus.is_modbus_tcp();
        let devices = config.field_ports().filter(is_tcp).count();
        let texts = if commands == 0 { &[] } else { config.commands };
        let bytes = texts.iter().map(|entry| entry.text.len()).fold(0, usize::saturating_add);
        for (what, needed, room) in [
            (Counted::FieldPorts, ports, self.ports.capacity()),
            (Counted::InputFrames, frames, MAX_INPUT_FRAMES),
            (
                Counted::RecipeLinks,
                uplinks(config).count().saturating_add(devices),
                self.links.recipes.capacity(),
            ),
            (Counted::UserFields, inputs.max(outputs), self.bindings.inputs.capacity()),
            (Counted::CommandFields, commands, MAX_COMMAND_FIELDS),
            (Counted::CommandBytes, bytes, MAX_COMMAND_BYTES),
        ] {
            if needed > room {
                return Err(BuildError::TooMany { what, needed, room });
            }
        }
        Ok(())
    }

    #[inline(never)]
    fn add_port(
        &mut self,
        config: ConfigView<'_>,
        index: u8,
        port: &Port,
        recipe: &Recipe,
        dialect: Dialect,
    ) -> Result<(), BuildError> {
        let line = match &port.bus {
            Bus::Rs485(settings) => LineTiming::new(settings),
            _ => LineTiming::none(),
        };
        let first_frame = self.store.frames.len() as u8;
        if port.safe_at_start {
            self.store.overdue_from_start();
        }
        let next_rule = self.add_input_frames(config, port, recipe)?;
        let inputs = self.add_inputs(config, recipe, next_rule, dialect)?;
        self.add_rules(config, port, recipe)?;
        let outputs = self.add_outputs(config, recipe)?;
        self.store.watches_bits |= matches!(recipe.send, SendOn::Rising { .. });
        let has_output = recipe.part_frames(Direction::Output).next().is_some();
        let mut sender = Sender::new(recipe.send, recipe.on_stale, port.stale_after, port.cycle, has_output);
        sender.refresh = port.refresh.unwrap_or(Duration::MAX);
        if let Bus::ModbusTcp { host, port: tcp_port } = &port.bus {
            let link = DeviceLink::new(PortId(index), port.name.clone(), host.clone(), *tcp_port);
            let done = self.links.devices.push(link);
            done.map_err(|_| one_too_many(Counted::RecipeLinks, self.links.devices.capacity()))?;
        }
        let own = FieldPort {
            id: PortId(index),
            name: port.name.clone(),
            recipe: port.recipe,
            // `add_codec` sets that of the recipe.
            codec: Codec::Can { input: None, output: None },
            mode: recipe.mode,
            line,
            is_partial: false,
            sender,
            inputs,
            outputs,
            first_frame,
            is_up: false,
            bus: BusState::Active,
            reply: ReplyCode::None,
            counters: PortCounters::default(),
            last_rejection: None,
        };
        let full = one_too_many(Counted::FieldPorts, self.ports.capacity());
        self.ports.push(own).map_err(|_| full)?;
        self.store.edges.push(EdgeQueue::default()).map_err(|_| full)
    }

    /// Adds the input frames of a port to the store; returns where the rules after its bindings begin.
    fn add_input_frames(
        &mut self,
        config: ConfigView<'_>,
        port: &Port,
        recipe: &Recipe,
    ) -> Result<u16, BuildError> {
        let mut next_binding = self.bindings.inputs.len() as u16;
        let mut frames = config.frames_of(recipe, Direction::Input);
        while let Some((_, fields)) = frames.next() {
            let (is_expected, timeout) = match frames.exchange() {
                None => (true, port.timeout),
                Some((exchange, true)) => {
                    let is_steady = exchange.when.every.is_some() || exchange.is_never();
                    (is_steady, exchange.overdue.unwrap_or(port.timeout))
                }
                // A pending answer or a refusal is not sent regularly.
                Some((_, false)) => (false, Port::NEVER),
            };
            let fields = fields.of(config.fields);
            let whole: InputSet = fields.iter().flat_map(FieldSpec::variables).collect();
            let mut set = whole;
            for bit in fields.iter().filter_map(FieldSpec::bit) {
                set.insert(bit.var);
                let (frame, port) = (self.store.frames.len() as u8, self.ports.len() as u8);
                self.store.bits.add(bit, frame, port).ok_or(one_too_many(Counted::BitShares, MAX_SHARES))?;
            }
            let is_bound = |field: &&FieldSpec| field.element().is_some();
            let bound = fields.iter().filter(is_bound).count() as u16;
            let bindings = Span { start: next_binding, len: bound };
            next_binding = next_binding.saturating_add(bound);
            let frame = InputFrame {
                set,
                port: self.ports.len() as u8,
                bindings,
                overdue_at: if port.safe_at_start { Instant::ZERO } else { Instant::NEVER },
                timeout,
                is_expected: is_expected && timeout != Port::NEVER,
            };
            let group = GroupId(self.store.frames.len() as u8);
            self.store
                .frames
                .push(frame)
                .map_err(|_| one_too_many(Counted::InputFrames, MAX_INPUT_FRAMES))?;
            whole.iter().for_each(|var| self.store.image.assign(var, group));
        }
        Ok(next_binding)
    }

    /// Adds the bindings of a port's input fields; their rules begin at `next_rule`.
    fn add_inputs(
        &mut self,
        config: ConfigView<'_>,
        recipe: &Recipe,
        mut next_rule: u16,
        dialect: Dialect,
    ) -> Result<Span, BuildError> {
        let fields = self.bindings.inputs.capacity();
        let full = || one_too_many(Counted::UserFields, fields);
        let mut inputs = Span { start: self.bindings.inputs.len() as u16, len: 0 };
        for (frame, nth, field) in config.fields_of(recipe, Direction::Input) {
            let Some(element) = field.element() else {
                // Rules of the field that was added last.
                let words = words_of(field).count() as u16;
                let Some(InputBind { to, .. }) = self.bindings.inputs.last_mut().filter(|_| words > 0) else {
                    continue;
                };
                let new = match *to {
                    // One more for the scale, which comes first.
                    InputTo::Variable { var, .. } => Some((var, next_rule, 0, words.saturating_add(1))),
                    InputTo::Ruled { var, first, count } => Some((var, first, u16::from(count), words)),
                    _ => None,
                };
                if let Some((var, first, before, words)) = new {
                    let needed = before.saturating_add(words);
                    let count = u8::try_from(needed).map_err(|_| {
                        let (needed, room) = (needed.into(), u8::MAX.into());
                        BuildError::TooMany { what: Counted::UserFields, needed, room }
                    })?;
                    *to = InputTo::Ruled { var, count, first };
                    next_rule = next_rule.saturating_add(words);
                }
                continue;
            };
            let to = match *field {
                FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => to,
                _ => InputBinding::Unused,
            };
            let to = match to {
                InputBinding::Variable { var, scale, offset } => InputTo::Variable { var, scale, offset },
                InputBinding::Commands { table, when } => {
                    if self.links.command.is_empty() {
                        self.add_command_link(config, dialect)?;
                    }
                    let Some(link) = self.links.command.first_mut() else { continue };
                    let field = link.add_field(table, when, (frame, nth));
                    InputTo::Command(field.ok_or(one_too_many(Counted::CommandFields, MAX_COMMAND_FIELDS))?)
                }
                InputBinding::Bit { var, bit } => {
                    InputTo::Bits { var, mask: VarBit { var, bit }.mask().unwrap_or(0) }
                }
                InputBinding::Unused => InputTo::Unused,
                InputBinding::Counter { max } => {
                    let nth =
                        self.store.counts.add(max).ok_or(one_too_many(Counted::Counters, MAX_COUNTS))?;
                    InputTo::Counter(nth)
                }
            };
            self.bindings.inputs.push(InputBind::new(to, element)).map_err(|_| full())?;
            inputs.len = inputs.len.saturating_add(1);
        }
        Ok(inputs)
    }

    /// Adds the bindings of a port's output fields, and what they may send.
    fn add_outputs(&mut self, config: ConfigView<'_>, recipe: &Recipe) -> Result<Span, BuildError> {
        let fields = self.bindings.outputs.capacity();
        let full = || one_too_many(Counted::UserFields, fields);
        let mut outputs = Span { start: self.bindings.outputs.len() as u16, len: 0 };
        for (_, _, field) in config.fields_of(recipe, Direction::Output) {
            if let Some(sendable) = Sendable::new(field) {
                let done = self.bindings.may_send(sendable);
                done.ok_or(one_too_many(Counted::Sendable, MAX_SENDABLE))?;
            }
            let Some(element) = field.element() else { continue };
            // The element has constants and padding.
            let (ty, from) = match *field {
                FieldSpec::UserOutput { ty, from } => (ty, from),
                FieldSpec::DeviceOutput { from, .. } => (ScalarType::Double, from),
                _ => (ScalarType::Double, OutputBinding::Constant(0.0)),
            };
            self.bindings.outputs.push(OutputBind::new(ty, from, element)).map_err(|_| full())?;
            outputs.len = outputs.len.saturating_add(1);
        }
        Ok(outputs)
    }

    /// Adds the rules of a port's input fields after its bindings, in the order of the fields.
    fn add_rules(&mut self, config: ConfigView<'_>, port: &Port, recipe: &Recipe) -> Result<(), BuildError> {
        let fields = self.bindings.inputs.capacity();
        let mut scale = None;
        for (_, _, field) in config.fields_of(recipe, Direction::Input) {
            if field.element().is_some() {
                scale = match *field {
                    FieldSpec::UserInput { to: InputBinding::Variable { scale, offset, .. }, .. }
                    | FieldSpec::DeviceInput { to: InputBinding::Variable { scale, offset, .. }, .. } => {
                        Some(scale_word(scale, offset))
                    }
                    _ => None,
                };
            }
            let words = words_of(field);
            let first = scale.take_if(|_| field.is_of_field_before());
            for word in first.into_iter().chain(words) {
                self.bindings.inputs.push(word).map_err(|_| one_too_many(Counted::UserFields, fields))?;
            }
            // The variable that shows whether a value was taken becomes 0 when its port is overdue.
            let FieldSpec::InputRule(InputRule::ValidTo { var, bit }) = *field else { continue };
            let mask = bit.map_or(u8::MAX, |bit| VarBit { var, bit }.mask().unwrap_or(0));
            let own = port.on_timeout.of(config.safe_values);
            if own.iter().all(|safe| safe.var != var || safe.mask & mask == 0) {
                let safe = SafeBytes { var, bytes: [0; 4], mask };
                self.safe_values
                    .push(safe)
                    .map_err(|_| one_too_many(Counted::SafeValues, MAX_SAFE_VALUES))?;
            }
        }
        Ok(())
    }

    /// Lays out the frames of the port that was added last. In place, because a codec is large and is copied each time
    /// it is passed on.
    #[inline(never)]
    fn add_codec(&mut self, config: ConfigView<'_>, port: &Port, recipe: &Recipe) -> Result<(), BuildError> {
        let Some(own) = self.ports.last_mut() else { return Ok(()) };
        // Validation has refused recipes that the bus cannot carry.
        match &recipe.parts {
            _ if config.is_device(recipe) => {
                let line = match &port.bus {
                    Bus::Rs485(line) => Some(line),
                    _ => None,
                };
                let bindings = [own.inputs.start, own.outputs.start];
                own.codec = Codec::Device(DeviceCodec::new(config, port.recipe, recipe, bindings, line)?);
            }
            Parts::Stream { input, output } => {
                stream_codec(config, port.recipe, recipe, [input, output], &mut own.codec)?;
            }
            Parts::Can { input, output } => {
                can_codec(config, port.recipe, recipe, [input, output], &mut own.codec)?;
            }
        }
        let Codec::Device(device) = &own.codec else { return Ok(()) };
        if recipe.exchanges.len == 0 {
            return Ok(());
        }
        let of_parts = device.fields();
        let places = Places {
            inputs: own.inputs.start.saturating_add(of_parts.0),
            outputs: own.outputs.start.saturating_add(of_parts.1),
            slot: own.first_frame.saturating_add(device.inputs),
        };
        let line = self.add_exchanges(config, port, recipe, places)?;
        if let Some(FieldPort { codec: Codec::Device(device), .. }) = self.ports.last_mut() {
            device.line = Some(line);
        }
        Ok(())
    }

    #[inline(never)]
    fn add_command_link(&mut self, config: ConfigView<'_>, dialect: Dialect) -> Result<(), BuildError> {
        let link = CommandLink::new(config.controller.command_port, dialect, config.commands);
        let link = link.ok_or(one_too_many(Counted::CommandBytes, MAX_COMMAND_BYTES))?;
        let _ = self.links.command.push(link);
        Ok(())
    }

    #[inline(never)]
    fn add_recipe_link(
        &mut self,
        config: ConfigView<'_>,
        plan: &Plan,
        id: LinkId,
        recipe: &Recipe,
        groups: &mut Groups,
    ) -> Result<(), BuildError> {
        let port = id.port();
        let bus = port.and_then(|port| config.ports.get(usize::from(port.0))).map(|port| &port.bus);
        // Validation has refused everything that is not an address.
        let local = |listen: &str| {
            listen_address(listen).unwrap_or(SocketAddr::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0))
        };
        let (kind, transport) = match (bus, port) {
            (Some(Bus::TcpListen { listen }), Some(port)) => {
                (LinkKind::RecipeTcpListen { port }, Transport::TcpListen { local: local(listen) })
            }
            (Some(Bus::UdpListen { listen }), Some(port)) => {
                (LinkKind::RecipeUdpListen { port }, Transport::UdpListen { local: local(listen) })
            }
            _ => {
                let port = config.controller.recipe_link.map_or(0, |link| link.udp_port);
                (LinkKind::RecipeUdp, Transport::Udp { port })
            }
        };
        let framing = match kind {
            LinkKind::RecipeTcpListen { .. } => Framing::Bytes,
            _ => Framing::Datagram,
        };
        let index = index_of(config, recipe);
        let Parts::Stream { input, output } = &recipe.parts else { return Ok(()) };
        let input = stream_layout(config, index, recipe, input.as_ref(), Direction::Input, framing)?;
        let output = stream_layout(config, index, recipe, output.as_ref(), Direction::Output, framing)?;
        let group = match output {
            Some(_) => Some(groups.next().ok_or(one_too_many(Counted::Groups, MAX_GROUPS))?),
            None => None,
        };
        for (_, _, field) in config.fields_of(recipe, Direction::Output) {
            // Even if no port shows the variable: it may confirm a safe value in the controller.
            if let (Some(var), Some(group)) = (field.variable(), group)
                && self.store.image.group(var).is_none()
            {
                self.store.image.assign(var, group);
            }
        }
        let listens = matches!(kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. });
        let timings = match (listens, output.is_some()) {
            (true, true) => const { &LinkTimings::LISTENING.with_silence(Duration::from_secs(2)) },
            (true, false) => &LinkTimings::LISTENING,
            (false, _) => &LinkTimings::TCP,
        };
        let set: InputSet = config.written_by(recipe).collect();
        let writes: InputSet = set.iter().filter(|&var| plan.route(var) == Some(Route::Recipe(id))).collect();
        self.store.unanswered = self.store.unanswered.or(&writes);
        let owners = writes.iter().flat_map(|var| plan.owners(var));
        let timeouts =
            owners.filter_map(|port| config.ports.get(usize::from(port.0))).map(|port| port.timeout);
        // Ports whose values never expire do not count.
        let timeouts = timeouts.filter(|timeout| *timeout != Port::NEVER);
        let patience = timeouts.min().unwrap_or(PATIENCE).max(PATIENCE);
        let uplink = RecipeLink::new(RecipeLinkSetup {
            id,
            kind,
            name: id
                .port()
                .and_then(|port| config.ports.get(usize::from(port.0)))
                .map(|port| port.name.clone()),
            transport,
            timings,
            input,
            output,
            set,
            writes,
            group,
            patience,
        });
        let done = self.links.recipes.push(uplink);
        done.map_err(|_| one_too_many(Counted::RecipeLinks, self.links.recipes.capacity()))
    }

    /// Variables of recipe links that no port sends come from the state stream.
    fn assign_read_back(&mut self, plan: &Plan) {
        let Some(state) = self.links.state.first() else { return };
        for var in plan.read_back().iter().filter(|&var| plan.owner(var).is_none()) {
            self.store.image.assign(var, state.group);
        }
    }

    #[inline(never)]
    fn assign_sources(
        &mut self,
        config: ConfigView<'_>,
        plan: &Plan,
        groups: &mut Groups,
    ) -> Result<(), BuildError> {
        let mut periods = [None; crate::sysvar::COUNT];
        for (_, port, recipe) in config.field_ports() {
            for var in shown_by(config, recipe) {
                if let Some(period) = periods.get_mut(var.ordinal()) {
                    *period = Some(period.map_or(port.cycle, |before: Duration| before.min(port.cycle)));
                }
            }
        }
        // Sorted by Modbus address, so that neighbours join into one block.
        let mut polled: Vec<SysVar, { crate::sysvar::COUNT }> = Vec::new();
        for var in SysVar::all().filter(|&var| plan.source(var) == Some(Source::Modbus)) {
            let before = |other: &SysVar| modbus_address(*other) <= modbus_address(var);
            let place = polled.iter().rposition(before).map_or(0, |last| last.saturating_add(1));
            // `Vec::insert` can panic. Cannot fail: there is room for every variable.
            let mut moved = var;
            for behind in polled.iter_mut().skip(place) {
                core::mem::swap(behind, &mut moved);
            }
            let _ = polled.push(moved);
        }
        for &var in &polled {
            let period = periods.get(var.ordinal()).copied().flatten().unwrap_or(MIN_CYCLE);
            let Some(modbus) = self.links.modbus.first_mut() else { break };
            let group = modbus.poll_var(var, period, || groups.next());
            let group = group.ok_or(one_too_many(Counted::PollBlocks, MAX_POLL_BLOCKS))?;
            self.store.image.assign(var, group);
        }
        for var in SysVar::all() {
            let group = match plan.source(var) {
                Some(Source::Recipe(id)) => {
                    self.links.recipes.iter().find(|link| link.id == id).and_then(|link| link.group)
                }
                Some(Source::State) => self.links.state.first_mut().map(|state| {
                    // Cannot fail: there is room for every variable.
                    let _ = state.shown.push(var);
                    state.group
                }),
                _ => None,
            };
            if let Some(group) = group {
                self.store.image.assign(var, group);
            }
        }
        for ((_, _, recipe), port) in config.field_ports().zip(self.ports.iter_mut()) {
            for var in sent_by(config, recipe) {
                let Some(group) = self.store.image.group(var) else { continue };
                port.sender.sources.insert(group);
                port.sender.shown.insert(var);
            }
        }
        Ok(())
    }

    /// Notes which variables of a recipe link have an output that shows whether the controller has their safe value: in
    /// the state packet, or in a recipe link's frame.
    fn assign_witnesses(&mut self) {
        let has_state = !self.links.state.is_empty();
        let image = &self.store.image;
        for link in self.links.recipes.iter_mut() {
            let is_shown = |var: &SysVar| {
                has_state && var.stream().is_some()
                    || var.shown_by().is_some_and(|witness| image.group(witness).is_some())
            };
            link.shown = link.writes.iter().filter(is_shown).collect();
        }
    }
}

/// The minimum time in which a recipe frame must be acknowledged, however short the owners' timeouts are: peers
/// acknowledge up to 200 ms late.
const PATIENCE: Duration = Duration::from_millis(250);

fn modbus_address(var: SysVar) -> (u8, u16) {
    use crate::sysvar::ModbusPlace;
    match var.modbus() {
        Some(ModbusPlace::Coils { first, .. }) => (0, first),
        Some(ModbusPlace::Register { address } | ModbusPlace::Scaled { address, .. }) => (1, address),
        None => (2, 0),
    }
}
