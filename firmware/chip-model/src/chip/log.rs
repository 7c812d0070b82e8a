//! The program's log, as a debugger reads it.

use super::{Chip, RAM};
use crate::program::texts;

impl Chip {
    /// Empties the ring buffer of SEGGER RTT's first channel.
    pub(super) fn read_log(&mut self) {
        let engine = self.core.engine();
        let Some(channel) = self.program.rtt.map(|address| address + 24) else { return };
        let mut words = [0; 16];
        engine.read(channel + 4, &mut words);
        let word = |index: usize| u32::from_le_bytes(words[4 * index..][..4].try_into().expect("four"));
        let (buffer, size, write, read) = (word(0), word(1), word(2), word(3));
        let is_ring = buffer >= RAM[1].0 && size <= 0x1_0000 && write < size && read < size;
        if !is_ring || write == read {
            return;
        }
        let mut bytes = vec![0; size as usize];
        engine.read(buffer, &mut bytes);
        bytes.rotate_left(read as usize);
        bytes.truncate(((write + size - read) % size) as usize);
        engine.write(channel + 16, &write.to_le_bytes());
        if let Some(decoder) = &mut self.decoder {
            let now = self.board.now;
            self.log.extend(texts(decoder.as_mut(), &bytes).into_iter().map(|text| (now, text)));
        }
    }
}
