//! The benchmark's CAN frames by a DBC file that is read at run time.

use dbc_rs::Dbc as Messages;

use crate::workload::{Can, FRAMES};

pub(crate) struct Dbc {
    messages: Messages,
    frames: Vec<(u32, Vec<u8>)>,
    /// The newest value of each signal of the newest frame.
    values: Vec<f64>,
}

/// The frames: id and data.
pub(crate) fn frames() -> Vec<(u32, Vec<u8>)> {
    Can::new().into_frames()
}

/// The ids of them, sorted.
pub(crate) fn ids() -> Vec<u32> {
    let mut ids: Vec<u32> = frames().iter().map(|frame| frame.0).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), 16);
    ids
}

/// A database of the messages, each of two floats.
pub(crate) fn database(ids: &[u32]) -> String {
    let mut text = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: Robot\n\n");
    for id in ids {
        text += &format!("BO_ {id} Frame{id}: 8 Robot\n");
        text += &format!(" SG_ First{id} : 0|32@1- (1,0) [0|0] \"\" Robot\n");
        text += &format!(" SG_ Second{id} : 32|32@1- (1,0) [0|0] \"\" Robot\n\n");
    }
    for id in ids {
        text += &format!("SIG_VALTYPE_ {id} First{id} : 1;\nSIG_VALTYPE_ {id} Second{id} : 1;\n");
    }
    text
}

impl Dbc {
    pub(crate) fn new() -> Self {
        let messages = Messages::parse(&database(&ids())).expect("a DBC file");
        let mut new = Self { messages, frames: frames(), values: Vec::new() };
        assert_eq!(new.decode(), FRAMES);
        assert_eq!(new.values.len(), 2);
        new
    }

    pub(crate) fn decode(&mut self) -> usize {
        let mut applied = 0;
        for (id, data) in &self.frames {
            let Ok(signals) = self.messages.decode(*id, data, false) else { continue };
            self.values.clear();
            self.values.extend(signals.iter().map(|signal| signal.value));
            applied += 1;
        }
        applied
    }
}
