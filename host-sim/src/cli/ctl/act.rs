//! The commands of `ctl` and their arguments.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use recipe_config::board::Board;
use recipe_ctl::{MAX_AT_ONCE, Rollout, Slot};

use super::super::run::parse_time;
use super::help;

/// Something that `ctl` does.
#[derive(Debug, Subcommand)]
pub(super) enum Act {
    /// Who and what it is: name, role, version, ports, revision
    Info,
    /// Health, ports, links, the controller's states, latencies
    #[command(after_help = help::STATUS)]
    Status {
        /// Go on, five times a second, until Ctrl-C
        #[arg(long)]
        watch: bool,
    },
    /// The known variables: value, age, and the port that owns them
    #[command(after_help = help::VALUES)]
    Values {
        /// Only variables whose names contain one of these
        filter: Vec<String>,
        /// Go on, five times a second, until Ctrl-C
        #[arg(long)]
        watch: bool,
    },
    /// Frames as they come and go, by name, until Ctrl-C
    #[command(after_help = help::TRACE)]
    Trace {
        /// Only those of this port
        port: Option<String>,
        /// A gateway file, for the names of frames and fields that a board does not have
        #[arg(long, value_name = "FILE")]
        file: Option<PathBuf>,
    },
    /// Say what is wrong: ports, devices, links, the controller's mode
    #[command(after_help = help::DOCTOR)]
    Doctor {
        /// How long a board is listened to, 6s at least; devices that speak rarely need longer
        #[arg(long = "for", value_name = "TIME", default_value = "6s", value_parser = parse_time)]
        time: Duration,
    },
    /// Frames as a file for Wireshark, until Ctrl-C
    #[command(after_help = help::CAPTURE)]
    Capture {
        /// The file, pcapng
        file: PathBuf,
        /// Only those of this port
        #[arg(long, value_name = "NAME")]
        port: Option<String>,
        /// For so long, such as 10s
        #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
        time: Option<Duration>,
    },
    /// Everything that somebody who helps wants to see, in one file
    #[command(after_help = help::BUNDLE)]
    Bundle {
        /// The file, JSON
        file: PathBuf,
        /// Replace a file that exists
        #[arg(long)]
        force: bool,
    },
    /// State, counters and latencies as OpenMetrics
    Metrics,
    /// The newest lines of its log
    Log {
        /// So many at most
        #[arg(short = 'n', long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=256))]
        lines: u32,
    },
    /// The configuration that runs, or another one that is kept
    #[command(after_help = help::CONFIG)]
    Config {
        /// Not the one that runs but this one
        #[arg(long, value_name = "N")]
        revision: Option<u32>,
        /// Write it to this file
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Replace a file that exists
        #[arg(long, requires = "output")]
        force: bool,
    },
    /// What is kept, what runs, what is on trial
    Revisions,
    /// Store a configuration
    #[command(after_help = help::PUSH)]
    Push {
        /// A gateway file, or for a board an image
        file: PathBuf,
        /// For a board: override one key of the file, such as controller.address=10.0.0.9
        #[arg(long, value_name = "KEY=VALUE")]
        set: Vec<String>,
        /// The board that it is for, nucleo-h743zi or mps2-an500: what it has not is refused before anything is sent
        #[arg(long, value_name = "BOARD")]
        board: Option<Board>,
        /// Put it on trial at once
        #[arg(long)]
        apply: bool,
        /// With --apply: seconds until it is taken back unless it is confirmed
        #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds, requires = "apply")]
        confirm_s: f64,
        #[command(flatten)]
        many: Many,
    },
    /// Run the stored configuration on trial
    #[command(after_help = help::APPLY)]
    Apply {
        /// Another one that is kept
        #[arg(long, value_name = "N")]
        revision: Option<u32>,
        /// Seconds until it is taken back unless it is confirmed
        #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds)]
        confirm_s: f64,
        #[command(flatten)]
        many: Many,
    },
    /// Keep what is on trial
    #[command(after_help = help::CONFIRM)]
    Confirm {
        #[command(flatten)]
        many: Many,
    },
    /// End the trial
    #[command(after_help = help::ROLLBACK)]
    Rollback {
        /// Without a trial, return to the revision that was live before, at once
        #[arg(long)]
        previous: bool,
    },
    /// Give a board another firmware, or show which one runs
    #[command(after_help = help::UPDATE)]
    Update(UpdateArgs),
    /// Let a board tell a broker what it knows, as an edge node of Sparkplug, or show how its node does
    #[command(after_help = help::EDGE)]
    Edge {
        /// The Sparkplug file; without it, how the node does
        file: Option<PathBuf>,
        /// It tells nothing any more
        #[arg(long, conflicts_with = "file")]
        off: bool,
        /// Start the board again, so that it counts at once
        #[arg(long)]
        restart: bool,
    },
    /// Show which one it is: a board lets its lamp blink, a host writes a line to its log
    Identify {
        /// For so many seconds
        #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=60))]
        seconds: u32,
    },
    /// Give a board its first key, which is made here and written to a file
    #[command(after_help = help::CLAIM)]
    Claim {
        /// The file for the key; one from an earlier attempt is used again
        file: PathBuf,
    },
    /// Make a key: 128 random bits in a new file of mode 0600
    #[command(after_help = help::KEYGEN)]
    Keygen {
        /// The file, which must not exist
        file: PathBuf,
        /// A key to sign firmware with; the public key goes to FILE.pub
        #[arg(long)]
        signing: bool,
    },
    /// Make an update of a board's firmware, signed
    #[command(after_help = help::SIGN, disable_version_flag = true)]
    Sign {
        /// The file with the private key, of `keygen --signing`
        #[arg(long, value_name = "FILE")]
        signing_key: PathBuf,
        /// The board, such as nucleo-h743zi
        #[arg(long, value_name = "NAME")]
        board: String,
        /// The version of the firmware, such as 0.3.0
        #[arg(long, value_name = "VERSION")]
        version: String,
        /// The program linked for slot A, ELF
        #[arg(long, value_name = "FILE")]
        slot_a: PathBuf,
        /// The program linked for slot B, ELF
        #[arg(long, value_name = "FILE")]
        slot_b: PathBuf,
        /// The versions of the configuration image that it reads, such as 1-3, if it is of another release
        #[arg(long, value_name = "OLDEST-NEWEST", value_parser = formats)]
        reads: Option<(u32, u32)>,
        /// The version of the configuration image that it writes; otherwise the newest that it reads
        #[arg(long, value_name = "N")]
        writes: Option<u32>,
        /// The update
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
        /// Replace a file that exists
        #[arg(long)]
        force: bool,
    },
    /// Show what an update contains, and whether it is whole
    #[command(after_help = help::INSPECT)]
    Inspect {
        /// The update
        file: PathBuf,
        /// The file with the public key that it has to be signed for
        #[arg(long, value_name = "FILE")]
        public_key: Option<PathBuf>,
        /// Write what a probe puts into this slot, a or b
        #[arg(long, value_name = "SLOT", value_parser = slot, requires = "output")]
        slot: Option<Slot>,
        /// With --slot: the file
        #[arg(short, long, value_name = "FILE", requires = "slot")]
        output: Option<PathBuf>,
        /// Replace a file that exists
        #[arg(long, requires = "output")]
        force: bool,
    },
}

/// How a change goes through an inventory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Args)]
pub(super) struct Many {
    /// With --inventory: so many gateways at a time; the next ones begin once these have ended
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    batch: Option<u16>,
    /// With --inventory: begin no further batch once a gateway has failed
    #[arg(long)]
    stop_on_failure: bool,
}

impl Many {
    /// Whether anything was said of it.
    pub(super) fn is_said(self) -> bool {
        self.batch.is_some() || self.stop_on_failure
    }

    /// What was said of it.
    pub(super) fn rollout(self) -> Rollout {
        let batch = self.batch.map_or(MAX_AT_ONCE, usize::from);
        Rollout { batch, stop_on_failure: self.stop_on_failure }
    }
}

impl Act {
    /// How a change goes through an inventory, if that was said.
    pub(super) fn rollout(&self) -> Option<Rollout> {
        let (Self::Push { many, .. } | Self::Apply { many, .. } | Self::Confirm { many }) = self else {
            return None;
        };
        many.is_said().then(|| many.rollout())
    }

    /// Whether the key of the gateway is made by it.
    pub(super) fn makes_key(&self) -> bool {
        matches!(self, Self::Claim { .. })
    }
}

/// How long a trial may last, in seconds.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (1.0..=3_600.0).contains(&seconds) => Ok(seconds),
        _ => Err("not within 1 to 3600 s".into()),
    }
}

/// Two versions of the configuration image.
fn formats(text: &str) -> Result<(u32, u32), String> {
    let versions =
        text.split_once('-').and_then(|(oldest, newest)| Some((oldest.parse().ok()?, newest.parse().ok()?)));
    versions.ok_or_else(|| "not two numbers such as 1-3".into())
}

fn slot(text: &str) -> Result<Slot, String> {
    match text {
        "a" | "A" => Ok(Slot::A),
        "b" | "B" => Ok(Slot::B),
        _ => Err("not a or b".into()),
    }
}

/// Arguments of `update`.
#[derive(Debug, Args)]
pub(super) struct UpdateArgs {
    /// The update, of `sign`; without it, what the board says
    pub(super) file: Option<PathBuf>,
    /// Run it on trial
    #[arg(long = "try", requires = "file")]
    pub(super) try_it: bool,
    /// With --try or --inventory: seconds until it is taken back unless it was confirmed [default: 300]
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(60..=3600), requires = "file")]
    pub(super) confirm_s: Option<u32>,
    /// Keep what is on trial; with --try, once it does as well as the one before
    #[arg(long, conflicts_with = "back")]
    pub(super) confirm: bool,
    /// Take back what is on trial
    #[arg(long, conflicts_with = "file")]
    pub(super) back: bool,
    /// Take a firmware that is older than the one that runs
    #[arg(long, requires = "file")]
    pub(super) downgrade: bool,
    /// With --inventory: what became of each board, a JSON document; renewed after each batch
    #[arg(long, value_name = "FILE", requires = "file")]
    pub(super) report: Option<PathBuf>,
    #[command(flatten)]
    pub(super) many: Many,
}
