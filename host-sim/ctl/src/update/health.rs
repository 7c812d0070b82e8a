//! The health of a board, to compare before with after.

use std::fmt;

use crate::client::Client;
use crate::failure::Failure;
use crate::shown;

/// The health of a board.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Health {
    /// One word, as in `status`: `running` if nothing is wrong.
    pub word: String,
    /// Number of links to the controller that are up.
    pub links_up: u64,
    /// Number of working field ports.
    pub ports_working: u64,
}

impl Health {
    /// Whether it is at least as good as `before`.
    pub fn is_as_good_as(&self, before: &Self) -> bool {
        self.links_up >= before.links_up && self.ports_working >= before.ports_working
    }
}

impl fmt::Display for Health {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { word, links_up, ports_working } = self;
        write!(f, "{word}, {links_up} links up, {ports_working} ports working")
    }
}

/// Reads the health of the board.
pub fn health(client: &Client) -> Result<Health, Failure> {
    let status = client.json("status")?;
    let count = |list: &str, is_well: &dyn Fn(&str) -> bool| {
        let all = status[list].as_object().into_iter().flatten();
        all.filter(|(_, one)| one["state"].as_str().is_some_and(is_well)).count() as u64
    };
    Ok(Health {
        word: shown::line(status["health"].as_str().unwrap_or("unknown")).into_owned(),
        links_up: count("links", &|state| matches!(state, "up" | "shared")),
        ports_working: count("ports", &|state| state == "working"),
    })
}
