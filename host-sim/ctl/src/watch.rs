//! `--watch`: prints state or variables from the gateway's stream until Ctrl-C.

use std::io::Write;

use serde_json::Value;

use crate::answer::Answer;
use crate::client::Client;
use crate::failure::Failure;
use crate::reading::{status_of, values_of};
use crate::table::TableView;

/// The watched data.
#[derive(Debug, Clone)]
pub enum Watched {
    /// State, ports, links.
    Status,
    /// Variables whose names contain one of these.
    Values(Vec<String>),
}

/// Prints the data of the stream: on a terminal in place of the previous data, elsewhere one after the other. With
/// `json`, prints one document per line.
pub fn watch(
    client: &Client,
    what: &Watched,
    json: bool,
    view: TableView,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    let mut events = client.stream("stream")?;
    let name = match what {
        Watched::Status => "status",
        Watched::Values(_) => "values",
    };
    while let Some(event) = events.next()? {
        if event.name != name {
            continue;
        }
        let document: Value = serde_json::from_str(&event.data)
            .map_err(|_| client.refused("an event is no JSON; is this a gateway?"))?;
        let answer = match what {
            Watched::Status => status_of(document, view),
            Watched::Values(filters) => values_of(document, filters, view),
        };
        print(&answer, json, view, out)?;
    }
    Ok(())
}

fn print(answer: &Answer, json: bool, view: TableView, out: &mut dyn Write) -> Result<(), Failure> {
    if json {
        out.write_all(answer.json().as_bytes())?;
    } else if view.is_terminal {
        // Moves to the upper left corner, overwrites the old text and erases the rest.
        let text = answer.text(view).replace('\n', "\x1b[K\n");
        write!(out, "\x1b[H{text}\x1b[J")?;
    } else {
        writeln!(out, "{}", answer.text(view))?;
    }
    out.flush()?;
    Ok(())
}

/// Clears a terminal before data is watched on it.
pub fn clear(view: TableView, out: &mut dyn Write) -> Result<(), Failure> {
    if view.is_terminal {
        write!(out, "\x1b[2J")?;
    }
    Ok(())
}
