//! Escaping of frames: marks around a frame, and substitutes for its bytes that look like marks.
//!
//! In: a frame. Out: its bytes with escapes. [`Cutter`] does the reverse.
//!
//! [`Cutter`]: super::Cutter

/// A way to mark frames, and to escape bytes inside them that look like marks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Escape {
    /// DLE STX, the frame with every DLE doubled, DLE ETX.
    Dle,
    /// RFC 1055: END, the frame, END. END and ESC inside the frame become ESC and another byte.
    Slip,
    /// Consistent overhead byte stuffing: the encoded frame has no zeros, and a zero ends it.
    Cobs,
}

pub(super) const STX: u8 = 0x02;
pub(super) const ETX: u8 = 0x03;
pub(super) const DLE: u8 = 0x10;
pub(super) const END: u8 = 0xC0;
pub(super) const ESC: u8 = 0xDB;
pub(super) const ESC_END: u8 = 0xDC;
pub(super) const ESC_ESC: u8 = 0xDD;

impl Escape {
    /// Maximum number of bytes on the line for a frame of `len` bytes.
    pub const fn longest(self, len: usize) -> usize {
        match self {
            Self::Dle => len.saturating_mul(2).saturating_add(4),
            Self::Slip => len.saturating_mul(2).saturating_add(2),
            Self::Cobs => len.saturating_add(len / 254).saturating_add(2),
        }
    }

    /// Escapes the frame of `len` bytes at the front of `out` and returns the new length. `None` if `out` is too short.
    pub fn stuff(self, len: usize, out: &mut [u8]) -> Option<usize> {
        // The frame is moved to the end of the buffer and then written byte by byte to the front. If everything fits,
        // the write position never overtakes the read position.
        let from = out.len().checked_sub(len)?;
        if self.stuffed_len(out.get(..len)?) > out.len() {
            return None;
        }
        for at in (0..len).rev() {
            let byte = *out.get(at)?;
            *out.get_mut(from.saturating_add(at))? = byte;
        }
        let mut writer = EscapeWriter { out, len: 0 };
        match self {
            Self::Dle => {
                writer.put(&[DLE, STX])?;
                for at in 0..len {
                    match writer.read(from, at)? {
                        DLE => writer.put(&[DLE, DLE])?,
                        byte => writer.put(&[byte])?,
                    }
                }
                writer.put(&[DLE, ETX])?;
            }
            Self::Slip => {
                writer.put(&[END])?;
                for at in 0..len {
                    match writer.read(from, at)? {
                        END => writer.put(&[ESC, ESC_END])?,
                        ESC => writer.put(&[ESC, ESC_ESC])?,
                        byte => writer.put(&[byte])?,
                    }
                }
                writer.put(&[END])?;
            }
            Self::Cobs => {
                let (mut code_at, mut code) = (writer.len, 1_u8);
                writer.put(&[code])?;
                for at in 0..len {
                    let byte = writer.read(from, at)?;
                    if byte != 0 {
                        writer.put(&[byte])?;
                        code = code.saturating_add(1);
                    }
                    // The code of a full group implies no zero, and no zero follows the last group.
                    let is_last = at.saturating_add(1) == len;
                    if byte == 0 || code == u8::MAX && !is_last {
                        *writer.out.get_mut(code_at)? = code;
                        (code_at, code) = (writer.len, 1);
                        writer.put(&[code])?;
                    }
                }
                *writer.out.get_mut(code_at)? = code;
                writer.put(&[0])?;
            }
        }
        Some(writer.len)
    }

    fn stuffed_len(self, frame: &[u8]) -> usize {
        let count = |is_special: fn(u8) -> bool| frame.iter().filter(|&&byte| is_special(byte)).count();
        let len = frame.len();
        match self {
            Self::Dle => len.saturating_add(count(|byte| byte == DLE)).saturating_add(4),
            Self::Slip => len.saturating_add(count(|byte| matches!(byte, END | ESC))).saturating_add(2),
            Self::Cobs => self.longest(len),
        }
    }
}

struct EscapeWriter<'a> {
    out: &'a mut [u8],
    len: usize,
}

impl EscapeWriter<'_> {
    fn put(&mut self, bytes: &[u8]) -> Option<()> {
        for &byte in bytes {
            *self.out.get_mut(self.len)? = byte;
            self.len = self.len.saturating_add(1);
        }
        Some(())
    }

    fn read(&self, from: usize, at: usize) -> Option<u8> {
        self.out.get(from.saturating_add(at)).copied()
    }
}
