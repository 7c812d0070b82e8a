//! What a soak prints: the table of results, a failure, the progress.

use std::time::Duration as WallTime;

use proto_core::time::Duration;
use recipe_cell::soak::{Level, PartFailure, Progress, Total};

/// The table of results. For one seed, only the two lines about wall time differ.
pub(super) fn table(total: &Total, seed: u64, faults: &str, wall: WallTime) -> String {
    let mut lines = vec![
        format!("virtual hours       {:.3}", in_hours(total.span)),
        format!("wall time           {:.1} s", wall.as_secs_f64()),
        format!("hours a minute      {:.1}", per_minute(total.span, wall)),
        format!("runs                {}", total.runs),
        format!("seed, faults        {seed}, {faults}"),
        format!("events              {}", total.events),
        format!("writes checked      {}", total.writes),
        String::new(),
        "cell                 runs   hours".to_owned(),
    ];
    for (cell, (runs, span)) in &total.cells {
        lines.push(format!("  {cell:<18} {runs:>4} {:>7.3}", in_hours(*span)));
    }
    lines.push(String::new());
    lines.push("port                                    frames in  frames out".to_owned());
    for ((cell, port), (received, sent)) in &total.ports {
        lines.push(format!("  {:<34} {received:>12} {sent:>11}", format!("{cell}: {port}")));
    }
    lines.push(String::new());
    lines.push("link                                         sent    received".to_owned());
    for (link, (sent, received)) in &total.links {
        lines.push(format!("  {link:<34} {sent:>12} {received:>11}"));
    }
    lines.push(String::new());
    lines.push("fault                                       times".to_owned());
    if total.faults.is_empty() {
        lines.push("  none".to_owned());
    }
    for (kind, times) in &total.faults {
        lines.push(format!("  {:<34} {times:>12}", kind.name()));
    }
    lines.push(String::new());
    lines.push("invariant                                  checks".to_owned());
    for (invariant, checks) in &total.checks {
        lines.push(format!("  {:<34} {checks:>12}", invariant.name()));
    }
    lines.push(String::new());
    if !total.outcomes.is_empty() {
        lines.push("outcome of an event                         times".to_owned());
        for (outcome, times) in &total.outcomes {
            lines.push(format!("  {outcome:<34} {times:>12}"));
        }
        lines.push(String::new());
    }
    lines.push(format!("trace hash          {:016x}\n", total.hash));
    lines.join("\n")
}

/// Which outcomes of events a long run did not have often enough to say anything about them; `None` if there is none.
pub(super) fn rare_outcomes(total: &Total, level: Level) -> Option<String> {
    let rare: Vec<_> =
        total.rare_outcomes(level).iter().map(|(name, times)| format!("{name} {times} times")).collect();
    (!rare.is_empty()).then(|| format!("FAIL  outcomes of events that were too rare: {}", rare.join(", ")))
}

/// A failed run, and the command that repeats it; `cells` are the words of `--cell`.
pub(super) fn failure(failure: &PartFailure, cells: &[String], faults: &str) -> String {
    let at = show_seconds(Duration::from_micros(failure.after_us));
    let cells: String = cells.iter().map(|cell| format!(" --cell {cell}")).collect();
    let faults = if faults == Level::Harsh.name() { String::new() } else { format!(" --faults {faults}") };
    let PartFailure { what, cell, seed, .. } = failure;
    format!(
        "FAIL  {what}\n      cell {cell}, seed {seed}, {at} s after its start; repeat it with\n\
         \n      host-sim soak{cells}{faults} --replay {seed}@{at} --trace"
    )
}

pub(super) fn progress_line(progress: Progress, hours: Duration, wall: WallTime) -> String {
    format!(
        "{:.2} of {:.2} virtual hours, {} runs, {:.0} virtual hours a minute",
        in_hours(progress.elapsed),
        in_hours(hours),
        progress.runs,
        per_minute(progress.elapsed, wall)
    )
}

fn in_hours(span: Duration) -> f64 {
    span.as_micros() as f64 / 3.6e9
}

fn per_minute(span: Duration, wall: WallTime) -> f64 {
    in_hours(span) * 60.0 / wall.as_secs_f64().max(1e-3)
}

pub(super) fn show_seconds(span: Duration) -> String {
    format!("{}.{:06}", span.as_micros() / 1_000_000, span.as_micros() % 1_000_000)
}
