//! Tables and facts as text for people: aligned columns, unchanged names, colours only for good and bad states.
//!
//! Colours are ANSI sequences, which the program removes if the output is not a terminal.

use std::fmt::Write;

use anstyle::{AnsiColor, Style};

use crate::shown;

/// How text is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TableView {
    /// Columns of a line; `None` if lines may have any length.
    pub width: Option<usize>,
    /// Whether watched output replaces the previous output.
    pub is_terminal: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Look {
    #[default]
    Plain,
    Well,
    Wrong,
    Warning,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct TableCell {
    text: String,
    look: Look,
    /// Right-aligned, as numbers are.
    is_number: bool,
}

impl TableCell {
    pub(crate) fn of(text: impl AsRef<str>) -> Self {
        Self { text: shown::line(text.as_ref()).into_owned(), ..Self::default() }
    }

    pub(crate) fn number(text: impl ToString) -> Self {
        Self { is_number: true, ..Self::of(text.to_string()) }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.text.is_empty()
    }

    #[must_use]
    pub(crate) fn look(self, look: Look) -> Self {
        Self { look, ..self }
    }
}

impl From<&str> for TableCell {
    fn from(text: &str) -> Self {
        Self::of(text)
    }
}

impl From<String> for TableCell {
    fn from(text: String) -> Self {
        Self::of(text)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct TextTable {
    rows: Vec<Vec<TableCell>>,
}

impl TextTable {
    pub(crate) fn new(headings: &[&str]) -> Self {
        Self { rows: vec![headings.iter().map(|&heading| heading.into()).collect()] }
    }

    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = TableCell>) {
        self.rows.push(cells.into_iter().collect());
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.rows.len() <= 1
    }

    /// The lines. The last column is truncated to fit.
    pub(crate) fn show(&self, view: TableView) -> String {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            self.rows.iter().filter_map(|row| row.get(column)).map(|cell| shown::width(&cell.text)).max()
        };
        let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
        // A heading is aligned like its column.
        let numbers: Vec<bool> = (0..columns)
            .map(|column| {
                self.rows.iter().skip(1).filter_map(|row| row.get(column)).any(|cell| cell.is_number)
            })
            .collect();
        let mut text = String::new();
        for row in &self.rows {
            let mut line = String::new();
            let mut used = 0;
            for (nth, cell) in row.iter().enumerate() {
                if nth > 0 {
                    line.push_str("  ");
                    used += 2;
                }
                let left = view.width.map_or(usize::MAX, |width| width.saturating_sub(used));
                let is_last = nth + 1 == row.len();
                let words = if is_last { cut(&cell.text, left) } else { cell.text.clone() };
                let pad = " ".repeat(widths[nth].saturating_sub(shown::width(&words)));
                let painted = paint(&words, cell.look);
                // Writing to a `String` never fails.
                let _ = match (numbers[nth], is_last) {
                    (true, _) => write!(line, "{pad}{painted}"),
                    (false, true) => write!(line, "{painted}"),
                    (false, false) => write!(line, "{painted}{pad}"),
                };
                used += widths[nth];
            }
            text.push_str(line.trim_end());
            text.push('\n');
        }
        text
    }
}

/// Lines `name  value`.
pub(crate) fn facts(rows: impl IntoIterator<Item = (&'static str, TableCell)>) -> String {
    let rows: Vec<_> = rows.into_iter().collect();
    let width = rows.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let mut text = String::new();
    for (name, cell) in &rows {
        let _ = writeln!(text, "{name:width$}  {}", paint(&cell.text, cell.look));
    }
    text
}

pub(crate) fn paint(text: &str, look: Look) -> String {
    let colour = match look {
        Look::Plain => return text.to_owned(),
        Look::Well => AnsiColor::Green,
        Look::Wrong => AnsiColor::Red,
        Look::Warning => AnsiColor::Yellow,
    };
    let style = Style::new().fg_color(Some(colour.into()));
    format!("{style}{text}{style:#}")
}

/// Truncates a text to `width` columns.
fn cut(text: &str, width: usize) -> String {
    if shown::width(text) <= width {
        return text.to_owned();
    }
    let mut short = String::new();
    for c in text.chars() {
        if shown::width(&short) + shown::width(c.encode_utf8(&mut [0; 4])) + 1 > width {
            break;
        }
        short.push(c);
    }
    short + "…"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_and_the_last_one_is_cut() {
        let mut table = TextTable::new(&["port", "frames", "state"]);
        table.row(["力觉".into(), TableCell::number(1_234), TableCell::of("working").look(Look::Well)]);
        table.row([TableCell::of("rs485-1\u{1b}"), TableCell::number(7), "no frame since 12:00".into()]);
        let text = table.show(TableView { width: Some(40), is_terminal: true });
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[0], "port           frames  state");
        assert_eq!(lines[1], "力觉             1234  \u{1b}[32mworking\u{1b}[0m");
        assert_eq!(lines[2], "rs485-1\\u{1b}       7  no frame since 1…");
        assert_eq!(shown::width(lines[2]), 40);
    }
}
