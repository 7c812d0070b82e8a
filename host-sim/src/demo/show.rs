//! The demo's output: each example as it runs, and its verdict.

use std::cell::RefCell;
use std::fmt::Arguments;
use std::io::{self, Stdout, Write};
use std::process::ExitCode;

use anstream::AutoStream;
use anstyle::{AnsiColor, Style};

use recipe_runtime::out::Out;

use super::cell::gateways_held_up;

const HEADING: Style = Style::new().bold();
const QUIET: Style = Style::new().dimmed();
const GOOD: Style = AnsiColor::Green.on_default().bold();
const BAD: Style = AnsiColor::Red.on_default().bold();

/// Prints, and counts verdicts.
#[derive(Debug)]
pub(super) struct Show {
    out: RefCell<Out<AutoStream<Stdout>>>,
    passed: usize,
    failed: usize,
}

impl Show {
    pub(super) fn new() -> Self {
        Self { out: RefCell::new(Out::new(anstream::stdout())), passed: 0, failed: 0 }
    }

    /// The introduction.
    pub(super) fn introduce(&self, text: &str) {
        self.print(format_args!("{text}"));
    }

    /// The heading of an example.
    pub(super) fn heading(&self, text: &str) {
        self.print(format_args!("\n{HEADING}{text}{HEADING:#}"));
    }

    /// Bytes that are sent into the cell.
    pub(super) fn sends(&self, who: &str, bytes: &[u8], meaning: &str) {
        self.line(who, '>', &hex(bytes), meaning);
    }

    /// Bytes that were received from it.
    pub(super) fn sees(&self, who: &str, bytes: &[u8], meaning: &str) {
        self.line(who, '<', &hex(bytes), meaning);
    }

    /// A command and its reply, a variable, a coil.
    pub(super) fn notes(&self, who: &str, what: &str, meaning: &str) {
        self.line(who, ' ', what, meaning);
    }

    /// Runs one half of an example and prints its verdict; does nothing if the reader is gone. It is run again
    /// if this machine kept the gateway from the processor for so long that it discarded what had waited.
    pub(super) fn judge(&mut self, what: &str, run: impl Fn(&Self) -> io::Result<()>) {
        if self.out.get_mut().has_failed() {
            return;
        }
        self.print(format_args!("  {what}"));
        let mut result = Ok(());
        for _ in 0..ATTEMPTS {
            let held_up = gateways_held_up();
            result = run(self);
            let is_late = result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::TimedOut);
            if !is_late || gateways_held_up() == held_up {
                break;
            }
            self.print(format_args!(
                "  this machine was too busy, and the gateway discarded what had waited; again"
            ));
        }
        match result {
            Ok(()) => {
                self.passed += 1;
                self.print(format_args!("  {GOOD}PASS{GOOD:#}  {what}"));
            }
            Err(error) => {
                self.failed += 1;
                self.print(format_args!("  {BAD}FAIL{BAD:#}  {what}: {error}"));
            }
        }
    }

    /// The last lines, and the exit code.
    pub(super) fn verdict(self, seconds: f64) -> ExitCode {
        let Self { passed, failed, .. } = self;
        let (style, word) = if failed == 0 { (GOOD, "PASS") } else { (BAD, "FAIL") };
        self.print(format_args!(
            "\n{style}{word}{style:#}  {passed} passed, {failed} failed, in {seconds:.1} s"
        ));
        if failed == 0 {
            self.print(format_args!("\n{HINTS}"));
        }
        let code = if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE };
        self.out.into_inner().finish(|_| code)
    }

    fn print(&self, line: Arguments<'_>) {
        // Keep the first error.
        let _ = writeln!(self.out.borrow_mut(), "{line}");
    }

    fn line(&self, who: &str, arrow: char, what: &str, meaning: &str) {
        let mut what = what.to_owned();
        // The explanation of a long frame is on a separate line.
        if what.len() > WIDTH && !meaning.is_empty() {
            self.print(format_args!("    {who:<8}{arrow} {what}"));
            what.clear();
            self.print(format_args!("    {:<8}  {what:<WIDTH$}  {QUIET}{meaning}{QUIET:#}", ""));
        } else if meaning.is_empty() {
            self.print(format_args!("    {who:<8}{arrow} {what}"));
        } else {
            self.print(format_args!("    {who:<8}{arrow} {what:<WIDTH$}  {QUIET}{meaning}{QUIET:#}"));
        }
    }
}

/// What to try next: command lines for the repository's root.
const HINTS: &str = "\
Next:
  cargo run -- check host-sim/configs/rs485-system.toml   what a file does, what to set on the pendant
  cargo run -- soak --hours 0.1                           cells under faults, in virtual time
  cargo run -- help                                       all commands; README.md has a first file";

/// How often one half of an example is run on a machine that is too busy.
const ATTEMPTS: usize = 3;

/// Wide enough for a CAN frame and for the short stream frames.
const WIDTH: usize = 26;

/// `FF 01`, as the specification prints bytes.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}
