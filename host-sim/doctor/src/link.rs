//! Findings about links: whether the controller is reached, and whether it replies.

use proto_core::config::Parts;
use proto_core::engine::{LinkKind, Transport};

use crate::Case;
use crate::finding::{Cause, Finding, FindingPlace, Severity};
use crate::record::{LinkFacts, Reach};
use crate::state;

pub(crate) fn examine(case: &Case<'_>, findings: &mut Vec<Finding>) {
    for info in &case.status.links {
        // The first connection to port 2000 carries what the second cannot.
        if info.kind == LinkKind::Urgent {
            continue;
        }
        let facts = case.links.iter().find(|facts| facts.link == info.id);
        let place = FindingPlace::Link(info.name.clone());
        let link = LinkCase { case, info, facts, place };
        findings.extend(link.finding());
        findings.extend(link.strangers());
    }
}

struct LinkCase<'a> {
    case: &'a Case<'a>,
    info: &'a state::ObservedLink,
    facts: Option<&'a LinkFacts>,
    place: FindingPlace,
}

impl LinkCase<'_> {
    fn to(&self) -> String {
        match self.info.transport {
            Transport::Tcp { port } => format!("{} port {port} (TCP)", self.info.host),
            Transport::Udp { port } => format!("{} port {port} (UDP)", self.info.host),
            Transport::TcpListen { local } => format!("{local} (TCP)"),
            Transport::UdpListen { local } => format!("{local} (UDP)"),
            _ => self.info.host.clone(),
        }
    }

    /// The purpose of the port, and where to switch it on.
    fn service(&self) -> (&'static str, &'static str) {
        match self.info.kind {
            LinkKind::Command => ("the command port, usually 2000", "command"),
            LinkKind::State => ("the state stream, usually 2001", "state"),
            LinkKind::Modbus => ("the Modbus server, usually 502", "modbus"),
            LinkKind::ModbusDevice { .. } => ("the device's Modbus server, usually 502", "to"),
            _ => ("the recipe server, usually 2011", "udp2011"),
        }
    }

    fn is_up(&self) -> bool {
        self.info.is_up
    }

    fn finding(&self) -> Option<Finding> {
        let reach = self.facts.and_then(|facts| facts.reach.as_ref());
        match self.info.kind {
            LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. } => self.listening(reach),
            LinkKind::RecipeUdp => self.datagrams(reach),
            _ if reach == Some(&Reach::Reached) || self.is_up() => self.connected(),
            _ => self.not_connected(reach),
        }
    }

    fn not_connected(&self, reach: Option<&Reach>) -> Option<Finding> {
        let (what, key) = self.service();
        let tried = self.info.history.failed_opens;
        // The first attempt is still in progress.
        if reach.is_none()
            && tried == 0
            && self.info.history.losses == 0
            && self.case.running.as_millis() < 2_000
        {
            return None;
        }
        let (to, expected) = (self.to(), format!("a connection to {what}"));
        let host = &self.info.host;
        // Where the file has the address.
        let (address, port, where_on) = match self.info.kind {
            LinkKind::ModbusDevice { .. } => {
                ("to of the port".to_owned(), "to of the port".to_owned(), "device")
            }
            _ => ("controller.address".to_owned(), format!("controller.ports.{key} of the file"), "pendant"),
        };
        Some(match reach {
            Some(Reach::Refused) => self.place.fault(
                Cause::Refused,
                format!("{to} refuses the connection"),
                expected,
                "The machine is there and nobody listens at this port: another port number, or the service is \
                 off",
                format!("Check {port}, and that the service is on at the {where_on}"),
            ),
            Some(Reach::NoSuchHost) => self.place.fault(
                Cause::NoSuchHost,
                format!("the name {host} is not known"),
                expected,
                format!("{address} is misspelt, or no name server knows it"),
                match self.info.kind {
                    LinkKind::ModbusDevice { .. } => "Write the device's IP address",
                    _ => "Write the controller's IP address",
                },
            ),
            Some(Reach::Failed(error)) => self.place.fault(
                Cause::Unreachable,
                format!("{to}: {error}"),
                expected,
                "The network does not lead there",
                format!("Try `ping {host}`; check cable, address and mask"),
            ),
            _ => self.place.fault(Cause::Unreachable, format!("no answer from {to}"), expected, format!(
                    "{address} is another machine's or nobody's, a cable is unplugged, or a firewall drops it"
                ), format!("Try `ping {host}`; check cable, address and mask")),
        })
    }

    fn connected(&self) -> Option<Finding> {
        let counters = self.info.counters;
        let to = self.to();
        let (what, key) = self.service();
        let since = self.info.up_for.as_millis();
        let silences = self.info.history.silences;
        Some(match self.info.kind {
            LinkKind::State if counters.malformed > 0 && counters.malformed >= counters.received => {
                self.place.fault(
                    Cause::Dialect,
                    format!("{to} sends {} bytes that are no state packets", counters.bytes_in),
                    "packets of 1468 bytes",
                    "Another port, or a controller version with another packet",
                    format!("Check controller.ports.{key} and controller.dialect"),
                )
            }
            LinkKind::State if counters.received == 0 && (silences > 0 || since >= 1_500) => {
                self.place.fault(
                    Cause::LinkSilent,
                    format!("{to} is connected; {} bytes, 0 packets", counters.bytes_in),
                    "ten packets a second",
                    format!("This is not {what}, or the controller is still starting"),
                    format!("Check controller.ports.{key}"),
                )
            }
            LinkKind::Modbus if counters.refused > 0 && counters.refused >= counters.received => {
                self.place.fault(
                    Cause::LinkRefuses,
                    format!("{to} refuses {} of {} requests", counters.refused, counters.sent),
                    "answers",
                    "The controller's Modbus map lacks these registers: another software version",
                    "Check controller.dialect, and the variables that `host-sim check` sends over Modbus",
                )
            }
            LinkKind::Modbus if counters.timeouts > 0 && counters.received == 0 => self.place.fault(
                Cause::LinkSilent,
                format!("{to} answers none of {} requests", counters.sent),
                "answers of a Modbus server",
                format!("Something else than {what} listens there"),
                format!("Check controller.ports.{key}"),
            ),
            LinkKind::Command if counters.timeouts > 0 && counters.received == 0 => self.place.fault(
                Cause::Dialect,
                format!("{to} replies to none of {} commands", counters.sent),
                "a reply to each",
                format!("This is not {what}, or the controller wants another end of line"),
                format!("Check controller.ports.{key} and controller.dialect"),
            ),
            _ => return None,
        })
    }

    /// Whether the controller sends: the recipe of the link to its recipe server has an output part.
    fn expects_answers(&self) -> bool {
        let link = self.case.config.controller.recipe_link;
        let recipe = link.and_then(|link| self.case.config.recipes.get(usize::from(link.recipe)));
        matches!(recipe.map(|recipe| &recipe.parts), Some(Parts::Stream { output: Some(_), .. }))
    }

    fn datagrams(&self, reach: Option<&Reach>) -> Option<Finding> {
        let counters = self.info.counters;
        let (to, (what, key)) = (self.to(), self.service());
        let remedy = format!(
            "Check controller.ports.{key}, and that the recipe is assigned to the controller's UDP server at the pendant"
        );
        match reach {
            Some(Reach::Refused) => {
                return Some(self.place.fault(
                    Cause::Refused,
                    format!("{} sent, {} received; {to} refuses datagrams", counters.sent, counters.received),
                    format!("{what} of the controller"),
                    "The machine is there and nobody listens at this UDP port",
                    remedy,
                ));
            }
            Some(Reach::Untried) => {
                return Some(self.place.found(
                    Severity::Note,
                    Cause::OneWay,
                    format!("{to} was not tried: over UDP that takes a frame"),
                    "",
                    "The controller is given nothing here",
                    "Run the gateway with -v, which tells whether the controller answers",
                ));
            }
            Some(Reach::NoSuchHost | Reach::Failed(_)) if !self.is_up() => return self.not_connected(reach),
            _ => {}
        }
        if counters.received > 0 || counters.sent < MANY_SENT {
            return None;
        }
        let severity = if self.expects_answers() { Severity::Fault } else { Severity::Note };
        let seen = format!("{} sent, 0 received at {to}", counters.sent);
        Some(match severity {
            Severity::Fault => self.place.found(
                severity,
                Cause::OneWay,
                seen,
                "the controller's frames: the recipe has an output part",
                "Another UDP port than the controller's, no recipe assigned to it, or a firewall",
                remedy,
            ),
            _ => self.place.found(
                severity,
                Cause::OneWay,
                seen,
                "",
                "The recipe has no output part, so nothing shows whether the controller takes the frames",
                "An output part with any variable would show it",
            ),
        })
    }

    fn listening(&self, reach: Option<&Reach>) -> Option<Finding> {
        if self.is_up() || reach == Some(&Reach::Reached) || self.case.running.as_millis() < 3_000 {
            return None;
        }
        let seconds = self.case.running.as_millis() / 1000;
        Some(self.place.fault(
            Cause::NotConnected,
            format!("nobody has connected to {} for {seconds} s", self.to()),
            format!("the controller at {}", self.info.host),
            "The controller's recipe client is off or has another address or port",
            "Enter this machine's address and this port at the pendant; open the port in the firewall",
        ))
    }

    fn strangers(&self) -> Option<Finding> {
        let strangers = self.facts.map_or(0, |facts| facts.strangers);
        (strangers > 0 && !self.is_up()).then(|| {
            self.place.fault(
                Cause::Stranger,
                format!("{strangers} connections or datagrams from other addresses"),
                format!("the controller at {}", self.info.host),
                "The controller has another address than the file says, or another machine connects",
                "Correct controller.address; the log of -v names the peer",
            )
        })
    }
}

/// Number of datagrams without a reply that is no accident.
const MANY_SENT: u32 = 50;
