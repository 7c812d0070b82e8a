//! Configurations that the model cannot judge, and why.

use proto_core::config::{
    Bus, ConfigView, Echo, Exchange, FieldSpec, GatewayConfig, OutputBinding, Outside, Parts, Port, Recipe,
    Transaction,
};
use proto_core::device::Boundary;

use super::device::{is_written_by_model, varies};
use super::frame::Frame;
use super::spec::exchanges::RowSpec;
use super::spec::{LinkSpec, PortSpec, Share, Spec};
use super::varying::can_be_the_same;

/// Why the model cannot judge a configuration; `None` if it can.
pub(crate) fn unmodelled(config: &GatewayConfig) -> Option<&'static str> {
    if config.ports.iter().any(|port| port.bus.is_modbus_tcp()) {
        return Some("a soak cannot judge ports of Modbus TCP");
    }
    let reason = in_blocks(config).or_else(|| in_exchanges(config)).or_else(|| in_varying_frames(config));
    reason.or_else(|| {
        let spec = Spec::new(config);
        in_requests(&spec.ports).or_else(|| in_bits(config, &spec))
    })
}

/// Why the model cannot judge the blocks of a configuration; `None` if it can.
fn in_blocks(config: &GatewayConfig) -> Option<&'static str> {
    let served = config.exchanges.iter().filter_map(|exchange| match exchange.transaction {
        Transaction::Served { read, written, .. } => Some([read, written]),
        Transaction::Rtu { .. } | Transaction::Frames { .. } => None,
    });
    let mut fields = served.flatten().flat_map(|span| span.of(&config.fields));
    let is_odd = |field: &FieldSpec| match *field {
        FieldSpec::Fixed { .. } => true,
        FieldSpec::DeviceOutput { encoding, from, .. } => {
            !is_written_by_model(&encoding) || matches!(from, OutputBinding::Reply)
        }
        FieldSpec::System(_)
        | FieldSpec::UserInput { .. }
        | FieldSpec::UserOutput { .. }
        | FieldSpec::DeviceInput { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::Checksum(_)
        | FieldSpec::TextInput { .. }
        | FieldSpec::TextOutput { .. }
        | FieldSpec::Length(_)
        | FieldSpec::Limits(_)
        | FieldSpec::Mapped(_)
        | FieldSpec::InputRule(_) => false,
    };
    fields
        .any(is_odd)
        .then_some("a soak cannot judge constants, digits and reply codes in the blocks of a slave")
}

/// Why the model cannot judge the exchanges of a configuration; `None` if it can.
fn in_exchanges(config: &GatewayConfig) -> Option<&'static str> {
    let serves = |port: &&Port| {
        let exchanges = config.view().exchanges_of(recipe_of(config.view(), port));
        exchanges.iter().any(|exchange| matches!(exchange.transaction, Transaction::Served { .. }))
    };
    let has_echo = |port: &Port| matches!(&port.bus, Bus::Rs485(line) if line.echo == Echo::Yes);
    if config.ports.iter().filter(serves).any(has_echo) {
        return Some("a soak cannot judge a gateway that is a slave on a line that echoes");
    }
    let requests = config.exchanges.iter().filter_map(|exchange| match exchange.transaction {
        Transaction::Rtu { written, .. } => Some(written),
        Transaction::Frames { request, .. } => {
            config.frames.get(usize::from(request?)).map(|frame| frame.fields)
        }
        Transaction::Served { .. } => None,
    });
    let may_refuse = |field: &FieldSpec| match field {
        FieldSpec::Limits(limits) => limits.outside == Outside::Refuse,
        FieldSpec::Mapped(_) => true,
        FieldSpec::System(_)
        | FieldSpec::UserInput { .. }
        | FieldSpec::UserOutput { .. }
        | FieldSpec::DeviceInput { .. }
        | FieldSpec::DeviceOutput { .. }
        | FieldSpec::Fixed { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::Checksum(_)
        | FieldSpec::TextInput { .. }
        | FieldSpec::TextOutput { .. }
        | FieldSpec::Length(_)
        | FieldSpec::InputRule(_) => false,
    };
    let is_dialogue = |exchange: &Exchange| {
        let is_mixed = exchange.when.rising.is_some()
            && (exchange.when.every.is_some() || exchange.when.change || exchange.when.start);
        exchange.stop
            || exchange.follow.is_some()
            || is_mixed
            || exchange.outcome.variables().next().is_some()
    };
    let is_step = |recipe: &Recipe| {
        let exchanges = config.view().exchanges_of(recipe);
        exchanges.iter().enumerate().any(|(nth, own)| {
            let is_same = |other: &Exchange| (other.peer, other.when.rising) == (own.peer, own.when.rising);
            own.when.rising.is_some() && exchanges[..nth].iter().any(is_same)
        })
    };
    let has_values = |exchange: &Exchange| match exchange.transaction {
        Transaction::Frames { refusal: Some(refusal), .. } => {
            let fields = config.frames.get(usize::from(refusal)).map(|frame| frame.fields.of(&config.fields));
            fields.is_some_and(|fields| fields.iter().any(FieldSpec::has_value))
        }
        Transaction::Frames { refusal: None, .. } | Transaction::Rtu { .. } | Transaction::Served { .. } => {
            false
        }
    };
    let is_more = |exchange: &Exchange| {
        exchange.pending.is_some() || exchange.restarted.is_some() || has_values(exchange)
    };
    if config.exchanges.iter().any(is_more) {
        return Some(
            "a soak cannot judge pending answers, values in refusals and numbers that tell of a restart",
        );
    }
    if config.exchanges.iter().any(is_dialogue) || config.recipes.iter().any(is_step) {
        return Some(
            "a soak cannot judge stops, dialogues, outcomes and events that are states as well of other cells \
             than its own",
        );
    }
    if requests.flat_map(|span| span.of(&config.fields)).any(may_refuse) {
        return Some("a soak cannot judge requests with values that are not sent");
    }
    let asks = |port: &&Port| !config.view().exchanges_of(recipe_of(config.view(), port)).is_empty();
    let answers = |port: &Port| recipe_of(config.view(), port).send == proto_core::config::SendOn::Frame;
    if config.ports.iter().filter(asks).any(answers) {
        return Some("a soak cannot judge exchanges beside an output part that is sent for each frame");
    }
    None
}

/// Why the model cannot judge the texts and frames of varying length of a configuration; `None` if it can.
fn in_varying_frames(config: &GatewayConfig) -> Option<&'static str> {
    let is_text = |field: &FieldSpec| {
        matches!(field, FieldSpec::TextInput { .. } | FieldSpec::TextOutput { .. }) || varies(field)
    };
    let asked = config.exchanges.iter().flat_map(|exchange| match exchange.transaction {
        Transaction::Rtu { written, read, .. } | Transaction::Served { written, read, .. } => {
            vec![written, read]
        }
        Transaction::Frames { .. } => Vec::new(),
    });
    let asked = asked.chain(config.frames.iter().map(|frame| frame.fields));
    let on_can = config.recipes.iter().flat_map(|recipe| match &recipe.parts {
        Parts::Can { input, output } => input.iter().chain(output).map(|frame| frame.fields).collect(),
        Parts::Stream { .. } => Vec::new(),
    });
    if asked.chain(on_can).any(|span| span.of(&config.fields).iter().any(is_text)) {
        return Some("a soak judges texts and frames of varying length only in the parts of a stream");
    }
    let is_sent = |field: &FieldSpec| matches!(field, FieldSpec::DeviceOutput { .. }) && varies(field);
    if config.fields.iter().any(is_sent) {
        return Some("a soak cannot judge sent digits of varying length");
    }
    for recipe in &config.recipes {
        let Parts::Stream { input, output } = &recipe.parts else { continue };
        if [input, output].into_iter().flatten().any(|part| part.escape.is_some()) {
            return Some("a soak cannot judge escape bytes");
        }
        let Some(part) = input.as_ref().filter(|part| part.framing == Boundary::Fields) else { continue };
        let fields = part.fields.of(&config.fields);
        let has_sum = fields.iter().any(|field| matches!(field, FieldSpec::Checksum(_)));
        let first = fields.iter().find(|field| varies(field));
        let is_led = matches!(first, None | Some(FieldSpec::Length(_)));
        if !is_led || first.is_some() && (!has_sum || part.head.is_empty() || !part.tail.is_empty()) {
            return Some(
                "a soak judges a searched frame of varying length only with a head, a length in front of what \
                 varies, a checksum and no tail",
            );
        }
    }
    None
}

/// Why the model cannot judge the requests of a configuration; `None` if it can.
fn in_requests(ports: &[PortSpec]) -> Option<&'static str> {
    let is_twice = |port: &PortSpec| {
        let rows = port.exchanges.iter().flat_map(|exchanges| &exchanges.rows);
        let requests: Vec<&RowSpec> =
            rows.filter(|row| row.frames.as_ref().is_none_or(|it| it.is_asked)).collect();
        let is_same = |one: &RowSpec, other: &RowSpec| match (&one.frames, &other.frames) {
            (Some(one), Some(other)) if one.remote.is_some() || other.remote.is_some() => {
                one.remote == other.remote
            }
            (Some(_), Some(_)) => match (&one.request, &other.request) {
                (Some(one), Some(other)) => can_be_the_same(one, other),
                _ => false,
            },
            _ => one.head == other.head,
        };
        let is_output = |row: &RowSpec| {
            let own = row.request.as_ref().filter(|_| row.frames.is_some());
            own.is_some_and(|own| port.outputs.iter().any(|output| can_be_the_same(own, output)))
        };
        requests
            .iter()
            .enumerate()
            .any(|(nth, row)| is_output(row) || requests[..nth].iter().any(|other| is_same(row, other)))
    };
    ports.iter().any(is_twice).then_some("a soak cannot judge two exchanges of a port with the same request")
}

/// Why the model cannot judge the bits of a configuration; `None` if it can.
fn in_bits(config: &GatewayConfig, spec: &Spec) -> Option<&'static str> {
    let carries = |link: &LinkSpec, var| link.input.as_ref().is_some_and(|up: &Frame| up.has(var));
    let is_odd = |share: &Share| {
        let safe = config.ports[share.port].on_timeout.of(&config.safe_values);
        let some_are_safe = safe.iter().any(|safe| safe.var == share.var && safe.mask & share.mask != 0);
        spec.links.iter().any(|link| carries(link, share.var))
            || spec.origin[share.var.ordinal()].is_some()
            || some_are_safe && share.safe.is_none()
    };
    spec.shares.iter().any(is_odd).then_some(
        "a soak cannot judge bits with owners in a byte that a recipe link carries or an output part shows, \
         nor safe values for only some of a frame's bits",
    )
}

fn recipe_of<'c>(config: ConfigView<'c>, port: &Port) -> &'c Recipe {
    &config.recipes[usize::from(port.recipe)]
}
