//! The result of a command: as a document, as text, and as one row in a table of several gateways.

use serde_json::Value;

use crate::failure::Verdict;
use crate::table::{TableCell, TableView};

/// The outcome of a command at one gateway.
#[derive(Debug, Clone)]
pub struct Answer {
    pub(crate) document: Value,
    pub(crate) text: AnswerText,
    /// The row in a table of several gateways: headings and cells.
    pub(crate) row: Vec<(&'static str, TableCell)>,
    pub(crate) verdict: Verdict,
}

#[derive(Debug, Clone)]
pub(crate) enum AnswerText {
    /// Text of this program.
    Made(String),
    /// A document of the gateway that is text itself, such as a configuration.
    Document(String),
}

impl Answer {
    pub(crate) fn new(document: Value, text: String) -> Self {
        Self { document, text: AnswerText::Made(text), row: Vec::new(), verdict: Verdict::Well }
    }

    #[must_use]
    pub(crate) fn with_row(self, row: Vec<(&'static str, TableCell)>) -> Self {
        Self { row, ..self }
    }

    #[must_use]
    pub(crate) fn with_verdict(self, is_well: bool) -> Self {
        Self { verdict: if is_well { Verdict::Well } else { Verdict::Trouble }, ..self }
    }

    /// The verdict, which determines the exit code.
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// The result as a document on one line.
    pub fn json(&self) -> String {
        crate::shown::json(&self.document) + "\n"
    }

    /// The result as text. A document of the gateway goes to a file or pipe unchanged.
    pub fn text(&self, view: TableView) -> String {
        match &self.text {
            AnswerText::Made(text) => text.clone(),
            AnswerText::Document(text) if view.is_terminal => crate::shown::lines(text).into_owned(),
            AnswerText::Document(text) => text.clone(),
        }
    }
}
