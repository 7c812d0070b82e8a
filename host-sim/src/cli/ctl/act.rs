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
    /// Show the gateway's name, role, version, ports and revision
    Info,
    /// Show health, ports, links, the controller's states and latencies
    #[command(after_help = help::STATUS)]
    Status {
        /// Refresh five times a second until Ctrl-C
        #[arg(long)]
        watch: bool,
    },
    /// Show the known variables: value, age, and the port that owns them
    #[command(after_help = help::VALUES)]
    Values {
        /// Only variables whose names contain one of these texts
        filter: Vec<String>,
        /// Refresh five times a second until Ctrl-C
        #[arg(long)]
        watch: bool,
    },
    /// Show frames with named fields as they come and go, until Ctrl-C
    #[command(after_help = help::TRACE)]
    Trace {
        /// Only frames of this port
        port: Option<String>,
        /// Gateway file with the names of frames and fields, which a board does not know
        #[arg(long, value_name = "FILE")]
        file: Option<PathBuf>,
    },
    /// Report what is wrong with ports, devices, links and the controller's mode
    #[command(after_help = help::DOCTOR)]
    Doctor {
        /// How long to listen to a board, at least 6s; longer for devices that send rarely
        #[arg(long = "for", value_name = "TIME", default_value = "6s", value_parser = parse_time)]
        time: Duration,
    },
    /// Write frames to a file for Wireshark, until Ctrl-C
    #[command(after_help = help::CAPTURE)]
    Capture {
        /// The pcapng file to write
        file: PathBuf,
        /// Only frames of this port
        #[arg(long, value_name = "NAME")]
        port: Option<String>,
        /// Stop after this time, such as 10s
        #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
        time: Option<Duration>,
    },
    /// Write everything that support needs to one file
    #[command(after_help = help::BUNDLE)]
    Bundle {
        /// The JSON file to write
        file: PathBuf,
        /// Replace an existing file
        #[arg(long)]
        force: bool,
    },
    /// Print state, counters and latencies as OpenMetrics
    Metrics,
    /// Print the newest lines of the gateway's log
    Log {
        /// Number of lines at most, 1 to 256
        #[arg(short = 'n', long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=256))]
        lines: u32,
    },
    /// Print the running configuration, or a stored revision
    #[command(after_help = help::CONFIG)]
    Config {
        /// This revision instead of the running one
        #[arg(long, value_name = "N")]
        revision: Option<u32>,
        /// Write to this file instead of to stdout
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Replace an existing file
        #[arg(long, requires = "output")]
        force: bool,
    },
    /// Show which revisions are stored, running and on trial
    Revisions,
    /// Send a gateway a configuration to store
    #[command(after_help = help::PUSH)]
    Push {
        /// A gateway file; for a board also an image
        file: PathBuf,
        /// For a board: override a key of the file, such as controller.address=10.0.0.9; repeatable
        #[arg(long, value_name = "KEY=VALUE")]
        set: Vec<String>,
        /// Refuse, before anything is sent, what this board cannot run: nucleo-h743zi or mps2-an500
        #[arg(long, value_name = "BOARD")]
        board: Option<Board>,
        /// Start its trial at once
        #[arg(long)]
        apply: bool,
        /// With --apply: seconds until it is taken back unless confirmed, 1 to 3600
        #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds, requires = "apply")]
        confirm_s: f64,
        #[command(flatten)]
        many: Many,
    },
    /// Run the stored configuration on trial
    #[command(after_help = help::APPLY)]
    Apply {
        /// Run this stored revision instead of the newest
        #[arg(long, value_name = "N")]
        revision: Option<u32>,
        /// Seconds until it is taken back unless confirmed, 1 to 3600
        #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds)]
        confirm_s: f64,
        #[command(flatten)]
        many: Many,
    },
    /// Keep the configuration that is on trial
    #[command(after_help = help::CONFIRM)]
    Confirm {
        #[command(flatten)]
        many: Many,
    },
    /// End the trial and return to the live revision
    #[command(after_help = help::ROLLBACK)]
    Rollback {
        /// Without a trial: return at once to the revision that was live before
        #[arg(long)]
        previous: bool,
    },
    /// Update the firmware of a board, or show which one runs
    #[command(after_help = help::UPDATE)]
    Update(UpdateArgs),
    /// Set up a board as a Sparkplug edge node of an MQTT broker, or show the state of its node
    #[command(after_help = help::EDGE)]
    Edge {
        /// The Sparkplug file (docs/fleet.md); without it, show the node's state
        file: Option<PathBuf>,
        /// Switch the node off
        #[arg(long, conflicts_with = "file")]
        off: bool,
        /// Restart the board, so that the change takes effect at once
        #[arg(long)]
        restart: bool,
    },
    /// Identify a gateway: a board blinks its LED, a host writes a line to its log
    Identify {
        /// Number of seconds, 1 to 60
        #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=60))]
        seconds: u32,
    },
    /// Give a board its first key, which is generated here and written to a file
    #[command(after_help = help::CLAIM)]
    Claim {
        /// File for the key; a key from an earlier attempt is used again
        file: PathBuf,
    },
    /// Generate a key: 128 random bits in a new file of mode 0600
    #[command(after_help = help::KEYGEN)]
    Keygen {
        /// The file, which must not exist yet
        file: PathBuf,
        /// Generate a private key to sign firmware with; the public key goes to FILE.pub
        #[arg(long)]
        signing: bool,
    },
    /// Make a signed update of a board's firmware
    #[command(after_help = help::SIGN, disable_version_flag = true)]
    Sign {
        /// File with the private key, made by `keygen --signing`
        #[arg(long, value_name = "FILE")]
        signing_key: PathBuf,
        /// The board, such as nucleo-h743zi
        #[arg(long, value_name = "NAME")]
        board: String,
        /// The version of the firmware, such as 0.3.0
        #[arg(long, value_name = "VERSION")]
        version: String,
        /// The firmware linked for slot A (ELF)
        #[arg(long, value_name = "FILE")]
        slot_a: PathBuf,
        /// The firmware linked for slot B (ELF)
        #[arg(long, value_name = "FILE")]
        slot_b: PathBuf,
        /// Versions of the configuration image that it reads, such as 1-3; for firmware of another release only
        #[arg(long, value_name = "OLDEST-NEWEST", value_parser = formats)]
        reads: Option<(u32, u32)>,
        /// Version of the configuration image that it writes [default: the newest that it reads]
        #[arg(long, value_name = "N")]
        writes: Option<u32>,
        /// The update to write
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
        /// Replace an existing file
        #[arg(long)]
        force: bool,
    },
    /// Show what an update contains, and check that it is intact
    #[command(after_help = help::INSPECT)]
    Inspect {
        /// The update
        file: PathBuf,
        /// File with the public key to check its signature with
        #[arg(long, value_name = "FILE")]
        public_key: Option<PathBuf>,
        /// Write the bytes that a probe flashes to this slot, a or b
        #[arg(long, value_name = "SLOT", value_parser = slot, requires = "output")]
        slot: Option<Slot>,
        /// With --slot: the file to write
        #[arg(short, long, value_name = "FILE", requires = "slot")]
        output: Option<PathBuf>,
        /// Replace an existing file
        #[arg(long, requires = "output")]
        force: bool,
    },
}

/// How a change goes through an inventory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Args)]
pub(super) struct Many {
    /// With --inventory: number of gateways in a batch; the next batch begins once all have ended
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    batch: Option<u16>,
    /// With --inventory: begin no further batch after a failure
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
    /// The update, made by `sign`; without it, show what runs
    pub(super) file: Option<PathBuf>,
    /// Restart the board with it on trial
    #[arg(long = "try", requires = "file")]
    pub(super) try_it: bool,
    /// With --try or --inventory: seconds until it is taken back unless confirmed, 60 to 3600 [default: 300]
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(60..=3600), requires = "file")]
    pub(super) confirm_s: Option<u32>,
    /// Keep the firmware on trial; with --try, once it works as well as the one before
    #[arg(long, conflicts_with = "back")]
    pub(super) confirm: bool,
    /// Return to the firmware before the trial
    #[arg(long, conflicts_with = "file")]
    pub(super) back: bool,
    /// Accept firmware that is older than the running one
    #[arg(long, requires = "file")]
    pub(super) downgrade: bool,
    /// With --inventory: write each board's outcome to this JSON file, renewed after each batch
    #[arg(long, value_name = "FILE", requires = "file")]
    pub(super) report: Option<PathBuf>,
    #[command(flatten)]
    pub(super) many: Many,
}
