//! Prints log records to the console, with their time in seconds.

use log::{LevelFilter, Log, Metadata, Record};

struct LogOutput;

static OUTPUT: LogOutput = LogOutput;

impl Log for LogOutput {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn log(&self, record: &Record<'_>) {
        let micros = embassy_time::Instant::now().as_micros();
        let (seconds, rest) = (micros / 1_000_000, micros % 1_000_000);
        let level = record.level();
        super::console::print(format_args!("{seconds:5}.{rest:06} {level:5} {}\r\n", record.args()));
    }

    fn flush(&self) {}
}

pub(super) fn start() {
    let _ = log::set_logger(&OUTPUT);
    log::set_max_level(LevelFilter::Info);
}
