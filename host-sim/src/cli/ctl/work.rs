//! What each command does: once its files are read, at one gateway or at many.

use std::io::Write;
use std::path::Path;

use recipe_ctl::{
    Answer, Client, Configuration, Failure, Firmware, Member, Names, Rollout, Slot, Stop, TrialOptions,
    Update, Verdict, Watched, WithoutTrial, edge, key_file, signing_key, update,
};
use recipe_runtime::out::print_stderr;

use super::act::{Act, UpdateArgs};
use super::updating::Updating;
use super::{RequestOptions, write};

/// A request to one gateway.
type QueryFn<'a> = Box<dyn Fn(&Client, RequestOptions) -> Result<Answer, Failure> + Sync + 'a>;
/// A command that prints as it runs.
type Follow<'a> = Box<dyn Fn(&Client, RequestOptions, &mut dyn Write) -> Result<Verdict, Failure> + 'a>;

/// A command that iterates over an inventory itself.
type Through<'a> =
    Box<dyn Fn(&[Member], &Stop, RequestOptions, &mut dyn Write) -> Result<Verdict, Failure> + 'a>;

/// A command without a gateway.
type Alone<'a> = Box<dyn FnOnce(RequestOptions, &mut dyn Write) -> Result<Verdict, Failure> + 'a>;

/// A command whose files have been read.
pub(super) enum CtlWork<'a> {
    /// Needs no gateway.
    Alone(Alone<'a>),
    /// One request to each gateway.
    Query(QueryFn<'a>, Many),
    /// For one gateway.
    Follow(Follow<'a>),
    /// For an inventory, even of one gateway.
    Through(Through<'a>),
}

/// How the answers of many gateways are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Many {
    /// A table with a row for each.
    Rows,
    /// One below the other.
    Sections,
}

impl Act {
    /// Reads the files of the command, which is for an inventory or for one gateway.
    pub(super) fn prepare(&self, is_for_inventory: bool) -> Result<CtlWork<'_>, Failure> {
        Ok(match self {
            Self::Info => rows(|client, _| recipe_ctl::info(client)),
            Self::Status { watch: false } => rows(|client, run| recipe_ctl::status(client, run.view)),
            Self::Status { watch: true } => {
                CtlWork::Follow(Box::new(|client, run, out| watch(client, &Watched::Status, run, out)))
            }
            Self::Values { watch: false, filter } => {
                sections(move |client, run| recipe_ctl::values(client, filter, run.view))
            }
            Self::Values { watch: true, filter } => {
                let watched = Watched::Values(filter.clone());
                CtlWork::Follow(Box::new(move |client, run, out| watch(client, &watched, run, out)))
            }
            Self::Trace { port, file } => {
                let names = file.as_deref().map(Names::read).transpose()?;
                CtlWork::Follow(Box::new(move |client, run, out| {
                    recipe_ctl::trace(client, port.as_deref(), names.as_ref(), run.json, out)?;
                    Ok(Verdict::Well)
                }))
            }
            Self::Capture { file, port, time } => CtlWork::Follow(Box::new(move |client, run, out| {
                run.print(&recipe_ctl::capture(client, file, port.as_deref(), *time)?, out)
            })),
            Self::Doctor { time } => rows(move |client, _| recipe_ctl::doctor(client, *time)),
            Self::Metrics => sections(|client, _| recipe_ctl::metrics(client)),
            Self::Log { lines } => sections(move |client, _| recipe_ctl::log(client, *lines)),
            Self::Config { revision, output: None, .. } => {
                sections(move |client, _| recipe_ctl::config(client, *revision))
            }
            Self::Config { revision, output: Some(path), force } => save_config(*revision, path, *force),
            Self::Bundle { file, force } => save_bundle(file, *force),
            Self::Revisions => rows(|client, _| recipe_ctl::revisions(client)),
            Self::Push { file, apply, confirm_s, set, board, .. } => {
                let trial = apply.then_some(TrialOptions { confirm_s: *confirm_s, revision: None });
                let configuration = Configuration::read(file, set, *board)?;
                rows(move |client, _| recipe_ctl::push(client, &configuration, trial))
            }
            Self::Apply { revision, confirm_s, .. } => {
                let trial = TrialOptions { confirm_s: *confirm_s, revision: *revision };
                rows(move |client, _| recipe_ctl::apply(client, trial))
            }
            Self::Confirm { .. } => rows(|client, _| recipe_ctl::confirm(client)),
            Self::Rollback { previous } => {
                let without = if *previous { WithoutTrial::Previous } else { WithoutTrial::Refuse };
                rows(move |client, _| recipe_ctl::rollback(client, without))
            }
            Self::Update(update) => update.prepare(is_for_inventory)?,
            Self::Edge { file: Some(_), .. } if is_for_inventory => {
                return Err(Failure::wrong(
                    "a Sparkplug file names one node, and an inventory may have several gateways; give it with --to",
                ));
            }
            Self::Edge { file: None, off: false, restart: true } => {
                return Err(Failure::wrong("--restart is for a file or --off"));
            }
            Self::Edge { file: None, off: false, .. } => rows(|client, _| edge::shown(client)),
            Self::Edge { file, restart, .. } => set_edge(file.as_deref(), *restart)?,
            Self::Identify { seconds } => rows(move |client, _| recipe_ctl::identify(client, *seconds)),
            Self::Claim { file } => CtlWork::Follow(Box::new(move |client, run, out| {
                run.print(&recipe_ctl::claim(client, file, &mut |line| print_stderr(line))?, out)
            })),
            Self::Keygen { file, signing } => make_key(file, *signing),
            Self::Sign { signing_key, board, version, slot_a, slot_b, reads, writes, output, force } => {
                let firmware = Firmware {
                    key: signing_key.clone(),
                    board: board.clone(),
                    version: version.clone(),
                    slot_a: slot_a.clone(),
                    slot_b: slot_b.clone(),
                    reads: *reads,
                    writes: *writes,
                };
                sign(firmware, output, *force)
            }
            Self::Inspect { file, public_key, slot: None, .. } => {
                CtlWork::Alone(Box::new(move |run, out| {
                    run.print(&Update::read(file)?.inspect(public_key.as_deref(), run.view)?, out)
                }))
            }
            Self::Inspect { file, public_key, slot: Some(slot), output, force } => {
                inspect_slot(file, public_key.as_deref(), *slot, output.as_deref(), *force)
            }
        })
    }
}

impl UpdateArgs {
    fn prepare(&self, is_for_inventory: bool) -> Result<CtlWork<'_>, Failure> {
        let Some(file) = &self.file else {
            return Ok(match self {
                Self { back: true, .. } => CtlWork::Follow(Box::new(move |client, run, out| {
                    run.print(&update::taken_back(client, &mut |line| print_stderr(line))?, out)
                })),
                Self { confirm: true, .. } => rows(|client, _| update::confirmed(client)),
                _ => rows(|client, _| update::shown(client)),
            });
        };
        let downgrade = allowed(self.downgrade);
        if is_for_inventory && !self.try_it && !self.confirm {
            return Ok(roll_out(Updating {
                update: Update::read(file)?,
                trial_s: self.confirm_s.unwrap_or(TRIAL_S),
                downgrade,
                rollout: self.many.rollout(),
                report: self.report.as_deref(),
            }));
        }
        if !self.try_it && (self.confirm || self.confirm_s.is_some()) {
            return Err(Failure::wrong(
                "--confirm and --confirm-s with a file need --try: what was never tried is not kept",
            ));
        }
        if self.many.is_said() || self.report.is_some() {
            return Err(Failure::wrong(
                "--batch, --stop-on-failure and --report are for --inventory FILE without --try, where every board is \
                 tried and confirmed",
            ));
        }
        let trial_s = self.try_it.then_some(self.confirm_s.unwrap_or(TRIAL_S));
        update_one(file, update::Plan { trial_s, confirm: self.confirm, downgrade })
    }
}

/// Writes a stored configuration to a file.
fn save_config(revision: Option<u32>, path: &Path, force: bool) -> CtlWork<'_> {
    CtlWork::Follow(Box::new(move |client, _, out| {
        let stored = recipe_ctl::stored(client, revision)?;
        write(path, stored.bytes(), force)?;
        writeln!(out, "{}: {} bytes", path.display(), stored.bytes().len())?;
        Ok(Verdict::Well)
    }))
}

/// Writes all that a gateway says of itself to a file.
fn save_bundle(file: &Path, force: bool) -> CtlWork<'_> {
    CtlWork::Follow(Box::new(move |client, run, out| {
        let document = recipe_ctl::bundle(client)?;
        let text = format!("{document:#}\n");
        write(file, text.as_bytes(), force)?;
        run.print(&recipe_ctl::bundled(&document, &file.display().to_string(), text.len()), out)
    }))
}

/// Updates the boards of an inventory.
fn roll_out(updating: Updating<'_>) -> CtlWork<'_> {
    CtlWork::Through(Box::new(move |members, stop, run, out| updating.roll_out(members, stop, run, out)))
}

/// Sends an update to one board, and tries it if the plan says so.
fn update_one<'a>(file: &Path, plan: update::Plan) -> Result<CtlWork<'a>, Failure> {
    let file = Update::read(file)?;
    Ok(CtlWork::Follow(Box::new(move |client, run, out| {
        run.print(&update::update(client, &file, plan, &mut |line| print_stderr(line))?, out)
    })))
}

/// Gives a board the settings of its edge node; without a file it is switched off.
fn set_edge<'a>(file: Option<&Path>, restart: bool) -> Result<CtlWork<'a>, Failure> {
    let settings = match file {
        Some(file) => recipe_edge_node::board::settings(file).map_err(Failure::wrong)?,
        None => recipe_sparkplug::document::OFF.to_vec(),
    };
    let from = if restart { edge::From::Now } else { edge::From::NextStart };
    Ok(rows(move |client, _| edge::set(client, &settings, from)))
}

/// Makes a key of the API, or one to sign firmware with.
fn make_key(file: &Path, signing: bool) -> CtlWork<'_> {
    CtlWork::Alone(Box::new(move |_, out| {
        if signing {
            let (public, public_file) = signing_key::make(file)?;
            writeln!(out, "{}: a new key to sign with, for its owner alone", file.display())?;
            writeln!(out, "{}: its public key, for loaders: {public}", public_file.display())?;
        } else {
            key_file::make(file)?;
            writeln!(out, "{}: a new key, for its owner alone", file.display())?;
        }
        Ok(Verdict::Well)
    }))
}

/// Writes a signed update.
fn sign(firmware: Firmware, output: &Path, force: bool) -> CtlWork<'_> {
    CtlWork::Alone(Box::new(move |_, out| {
        let bytes = recipe_ctl::sign(&firmware)?;
        write(output, &bytes, force)?;
        let public = recipe_ctl::public_of(&firmware.key)?;
        writeln!(out, "{}: {}", output.display(), Update::of(bytes)?.summary(&public))?;
        Ok(Verdict::Well)
    }))
}

/// Writes what a probe puts into a slot, if the update is good.
fn inspect_slot<'a>(
    file: &'a Path,
    public_key: Option<&'a Path>,
    slot: Slot,
    output: Option<&'a Path>,
    force: bool,
) -> CtlWork<'a> {
    CtlWork::Alone(Box::new(move |run, out| {
        let update = Update::read(file)?;
        let answer = update.inspect(public_key, run.view)?;
        if answer.verdict() != Verdict::Well {
            return run.print(&answer, out);
        }
        let (address, bytes) = update.flat(slot)?;
        if let Some(output) = output {
            write(output, &bytes, force)?;
            writeln!(out, "{}: {} bytes for address {address:08X}", output.display(), bytes.len())?;
        }
        Ok(Verdict::Well)
    }))
}

fn allowed(downgrade: bool) -> update::Downgrade {
    match downgrade {
        true => update::Downgrade::Allowed,
        false => update::Downgrade::Refused,
    }
}

fn rows<'a>(query: impl Fn(&Client, RequestOptions) -> Result<Answer, Failure> + Sync + 'a) -> CtlWork<'a> {
    CtlWork::Query(Box::new(query), Many::Rows)
}

fn sections<'a>(
    query: impl Fn(&Client, RequestOptions) -> Result<Answer, Failure> + Sync + 'a,
) -> CtlWork<'a> {
    CtlWork::Query(Box::new(query), Many::Sections)
}

fn watch(
    client: &Client,
    what: &Watched,
    run: RequestOptions,
    out: &mut dyn Write,
) -> Result<Verdict, Failure> {
    if !run.json {
        recipe_ctl::clear(run.view, out)?;
    }
    recipe_ctl::watch(client, what, run.json, run.view, out)?;
    Ok(Verdict::Well)
}

impl RequestOptions {
    fn print(self, answer: &Answer, out: &mut dyn Write) -> Result<Verdict, Failure> {
        let text = if self.json { answer.json() } else { answer.text(self.view) };
        out.write_all(text.as_bytes())?;
        Ok(answer.verdict())
    }
}

/// Asks one gateway.
pub(super) fn at_one(
    work: CtlWork<'_>,
    client: &Client,
    run: RequestOptions,
    out: &mut dyn Write,
) -> Result<Verdict, Failure> {
    match work {
        CtlWork::Alone(alone) => alone(run, out),
        CtlWork::Query(query, _) => run.print(&query(client, run)?, out),
        CtlWork::Follow(follow) => follow(client, run, out),
        CtlWork::Through(_) => Err(Failure::wrong("this command is for an inventory")),
    }
}

/// Asks many gateways.
pub(super) fn at_many(
    (query, many): (&QueryFn<'_>, Many),
    members: &[Member],
    rollout: Option<Rollout>,
    stop: &Stop,
    run: RequestOptions,
    out: &mut dyn Write,
) -> Result<Verdict, Failure> {
    let outcomes = recipe_ctl::ask(members, rollout, run.timeout, stop, &|client| query(client, run));
    let text = match many {
        _ if run.json => outcomes.json(),
        Many::Rows => outcomes.table(run.view),
        Many::Sections => outcomes.sections(run.view),
    };
    out.write_all(text.as_bytes())?;
    out.flush()?;
    outcomes.verdict()
}

/// How long a firmware is on trial, in seconds, unless something else is said.
const TRIAL_S: u32 = 300;
