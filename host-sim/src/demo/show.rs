//! What the demo prints: each example as it happens, and its verdict.

use std::io;

use anstream::println;
use anstyle::{AnsiColor, Style};

const HEADING: Style = Style::new().bold();
const QUIET: Style = Style::new().dimmed();
const GOOD: Style = AnsiColor::Green.on_default().bold();
const BAD: Style = AnsiColor::Red.on_default().bold();

/// The printer; it counts verdicts.
#[derive(Debug, Default)]
pub(super) struct Show {
    passed: usize,
    failed: usize,
}

impl Show {
    /// A whole example.
    pub(super) fn heading(&self, text: &str) {
        println!("\n{HEADING}{text}{HEADING:#}");
    }

    /// Bytes on their way into the cell.
    pub(super) fn sends(&self, who: &str, bytes: &[u8], meaning: &str) {
        self.line(who, '>', &hex(bytes), meaning);
    }

    /// Bytes that came out of it.
    pub(super) fn sees(&self, who: &str, bytes: &[u8], meaning: &str) {
        self.line(who, '<', &hex(bytes), meaning);
    }

    /// A command and its reply, a variable, a coil.
    pub(super) fn notes(&self, who: &str, what: &str, meaning: &str) {
        self.line(who, ' ', what, meaning);
    }

    /// Runs one half of an example and prints its verdict.
    pub(super) fn judge(&mut self, what: &str, run: impl FnOnce(&Self) -> io::Result<()>) {
        println!("  {what}");
        match run(self) {
            Ok(()) => {
                self.passed += 1;
                println!("  {GOOD}PASS{GOOD:#}  {what}");
            }
            Err(error) => {
                self.failed += 1;
                println!("  {BAD}FAIL{BAD:#}  {what}: {error}");
            }
        }
    }

    /// The last lines; true when everything passed.
    pub(super) fn verdict(&self, seconds: f64) -> bool {
        let Self { passed, failed } = self;
        let (style, word) = if *failed == 0 { (GOOD, "PASS") } else { (BAD, "FAIL") };
        println!("\n{style}{word}{style:#}  {passed} passed, {failed} failed, in {seconds:.1} s");
        *failed == 0
    }

    fn line(&self, who: &str, arrow: char, what: &str, meaning: &str) {
        let mut what = what.to_owned();
        // A long frame keeps its explanation on a line of its own.
        if what.len() > WIDTH && !meaning.is_empty() {
            println!("    {who:<8}{arrow} {what}");
            what.clear();
            println!("    {:<8}  {what:<WIDTH$}  {QUIET}{meaning}{QUIET:#}", "");
        } else {
            println!("    {who:<8}{arrow} {what:<WIDTH$}  {QUIET}{meaning}{QUIET:#}");
        }
    }
}

/// Wide enough for a CAN frame and for the short stream frames.
const WIDTH: usize = 26;

/// `FF 01`, as the specification prints bytes.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}
