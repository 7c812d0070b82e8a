//! The small values: the key of the API, settings and bdSeq of the edge node, counters.

use crate::{Flash, FoundRecord, Put, PutError, RecordKey, Store};

impl Store {
    /// The access key of the API; `None` if the board has not been claimed.
    pub fn access_key(&self, flash: &impl Flash) -> Option<[u8; 16]> {
        let mut key = [0; 16];
        let len = self.get(flash, RecordKey::Access, &mut key)?.len();
        (len == key.len()).then_some(key)
    }

    /// Stores the access key of the API.
    ///
    /// # Errors
    /// It cannot be written; the previous value remains.
    pub fn set_access_key<'d>(&mut self, key: &'d [u8; 16]) -> Result<Put<'_, 'd>, PutError> {
        self.put(RecordKey::Access, 0, key)
    }

    /// A counter; 0 if it was never set.
    pub fn counter(&self, number: u8) -> u64 {
        self.find(RecordKey::Counter(number)).map_or(0, |found| found.tag)
    }

    /// Stores the value of a counter.
    ///
    /// # Errors
    /// It cannot be written, or there is no such counter.
    pub fn set_counter(&mut self, number: u8, value: u64) -> Result<Put<'_, 'static>, PutError> {
        self.put(RecordKey::Counter(number), value, &[])
    }

    /// The bdSeq of the last session; `None` if there was none.
    pub fn birth_sequence(&self) -> Option<u8> {
        self.find(RecordKey::BirthSequence).map(|found| found.tag.to_le_bytes()).map(|[low, ..]| low)
    }

    /// Stores the bdSeq of the session that begins.
    ///
    /// # Errors
    /// It cannot be written; the previous value remains.
    pub fn set_birth_sequence(&mut self, value: u8) -> Result<Put<'_, 'static>, PutError> {
        self.put(RecordKey::BirthSequence, value.into(), &[])
    }

    /// Record of the edge node's settings; `None` if there are none.
    pub fn edge(&self) -> Option<FoundRecord> {
        self.find(RecordKey::Edge).filter(|found| found.len > 0)
    }

    /// Stores the settings of the edge node; empty settings delete them.
    ///
    /// # Errors
    /// They cannot be written; the previous settings remain.
    pub fn set_edge<'d>(&mut self, settings: &'d [u8]) -> Result<Put<'_, 'd>, PutError> {
        self.put(RecordKey::Edge, 0, settings)
    }
}
