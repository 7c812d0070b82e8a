//! The benchmark's CAN frames by a DBC file that is read at run time.

use dbc_rs::Dbc as Messages;

use crate::workload::{Can, FRAMES};

pub(crate) struct Dbc {
    messages: Messages,
    frames: Vec<(u32, Vec<u8>)>,
    /// The newest value of each signal of the newest frame.
    values: Vec<f64>,
}

impl Dbc {
    pub(crate) fn new() -> Self {
        let frames = Can::new().into_frames();
        let mut ids: Vec<u32> = frames.iter().map(|frame| frame.0).collect();
        ids.sort_unstable();
        ids.dedup();
        let mut text = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: Robot\n\n");
        for id in &ids {
            text += &format!("BO_ {id} Frame{id} : 8 Robot\n");
            text += &format!(" SG_ First{id} : 0|32@1- (1,0) [0|0] \"\" Robot\n");
            text += &format!(" SG_ Second{id} : 32|32@1- (1,0) [0|0] \"\" Robot\n\n");
        }
        let messages = Messages::parse(&text).expect("a DBC file");
        let mut new = Self { messages, frames, values: Vec::new() };
        assert_eq!((ids.len(), new.decode()), (16, FRAMES));
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
