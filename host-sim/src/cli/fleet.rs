//! `host-sim fleet`: many simulated edge nodes against a real broker.

use std::io::{Stdout, Write};
use std::net::IpAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use recipe_edge_node::broker::Broker;
use recipe_edge_node::file::read_login;
use recipe_edge_node::simulated::{Fleet, NODE_BYTES, Totals};
use recipe_runtime::out::{Out, print_stderr};
use recipe_sparkplug::topic::Id;

use super::run::parse_time;
use super::wrong;

pub(super) const EXAMPLES: &str = "\
Examples:
  host-sim fleet --gateways 1000 --broker 127.0.0.1:1883 --time 60s
  host-sim fleet --gateways 200 --broker broker.plant.example:8883 --ca ca.pem --login fleet.login

The nodes node-1, node-2 and so on publish what a gateway with two field ports does:
births of the node and its devices, data by exception, death. Each second a line shows
what all nodes together did in that second.

Exit code 1 if a node was not online at the end.";

/// Arguments of `fleet`.
#[derive(Debug, Args)]
pub(super) struct FleetArgs {
    /// Number of nodes, 1 to 20000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=20_000))]
    gateways: u32,
    /// The MQTT broker
    #[arg(long, value_name = "HOST:PORT", value_parser = parse_broker)]
    broker: (String, u16),
    /// Use TLS, and trust only the certificate authorities in this file (PEM)
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// File with two lines, user and password; only its owner may read it
    #[arg(long, value_name = "FILE")]
    login: Option<PathBuf>,
    /// Sparkplug group of the nodes
    #[arg(long, value_name = "NAME", default_value = "fleet", value_parser = parse_group)]
    group: Id,
    /// How long to run, such as 90s or 5m
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = parse_time)]
    time: Duration,
    /// How often each node gets new values, of which one in four changes
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = parse_time)]
    period: Duration,
}

pub(super) fn run(args: &FleetArgs, mut out: Out<Stdout>) -> ExitCode {
    let (host, port) = (&args.broker.0, args.broker.1);
    let broker = match &args.ca {
        Some(ca) => Broker::with_tls(host.as_str(), port, ca),
        None => Ok(Broker::plain(host.as_str(), port)),
    };
    let broker = match broker {
        Ok(broker) => broker,
        Err(error) => return wrong(format!("--ca: {error}")),
    };
    let login = match args.login.as_deref().map(read_login).transpose() {
        Ok(login) => login,
        Err(error) => return wrong(format!("--login: {error}")),
    };
    let nodes = args.gateways as usize;
    let (period, length) = (args.period, args.time);
    let fleet = Fleet { broker, nodes, group: args.group.clone(), login, period, length };
    let mut before = Totals::default();
    let (mut second, started) = (0_u64, resources());
    let ran = fleet.run(|now| {
        second += 1;
        let _ = writeln!(
            out,
            "{second:4} s: {:5} online, {:5} births, {:6} data messages, {:5} values told late, {:5} failures",
            now.online,
            now.births - before.births,
            now.data - before.data,
            now.historical - before.historical,
            now.failures - before.failures,
        );
        before = now;
    });
    let totals = match ran {
        Ok(totals) => totals,
        Err(error) => {
            print_stderr(error);
            return ExitCode::FAILURE;
        }
    };
    let ended = resources();
    let seconds = length.as_secs_f64();
    let _ = writeln!(
        out,
        "\nin all: {} sessions, {} births ({} asked for), {} data messages ({:.0}/s), {} values told late, {} lost",
        totals.sessions,
        totals.births,
        totals.rebirths,
        totals.data,
        totals.data as f64 / seconds,
        totals.historical,
        totals.lost,
    );
    let cpu = (ended.cpu - started.cpu).as_secs_f64();
    let _ = writeln!(
        out,
        "this process: {:.1} % of a processor, {:.3} % a node; {} KiB of memory a node at most, of it {} KiB the node itself",
        100.0 * cpu / seconds,
        100.0 * cpu / seconds / nodes as f64,
        (ended.peak_bytes - started.peak_bytes) / nodes as u64 / 1_024,
        NODE_BYTES / 1_024,
    );
    let is_whole = totals.online == nodes;
    out.finish(|_| if is_whole { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// What the process has used.
struct Resources {
    cpu: Duration,
    /// The most memory at once.
    peak_bytes: u64,
}

fn resources() -> Resources {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    // Processor time of all threads, in nanoseconds; behind it stand times of waiting.
    let cpu = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let cpu = cpu.filter_map(|task| {
        let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<u64>().ok()
    });
    let status = read("/proc/self/status");
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB"));
    let peak_kib: u64 = peak.and_then(|peak| peak.parse().ok()).unwrap_or(0);
    Resources { cpu: Duration::from_nanos(cpu.sum()), peak_bytes: peak_kib * 1_024 }
}

fn parse_broker(text: &str) -> Result<(String, u16), String> {
    let refused = || format!("{text:?} is not HOST:PORT");
    let (host, port) = text.rsplit_once(':').ok_or_else(refused)?;
    let port = port.parse().map_err(|_| refused())?;
    let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    match !host.is_empty() && (!host.contains(':') || host.parse::<IpAddr>().is_ok()) {
        true => Ok((host.to_owned(), port)),
        false => Err(refused()),
    }
}

fn parse_group(text: &str) -> Result<Id, String> {
    Id::new(text).map_err(|error| error.to_string())
}
