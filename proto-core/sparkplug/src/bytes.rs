//! Writes bytes into a buffer of the caller, or only counts them.
//!
//! Bytes that do not fit are counted too, so one function both measures and writes.

#[derive(Debug)]
pub(crate) struct ByteWriter<'b> {
    buf: &'b mut [u8],
    len: usize,
}

impl<'b> ByteWriter<'b> {
    /// Writes from the beginning of the buffer.
    pub(crate) fn new(buf: &'b mut [u8]) -> Self {
        Self { buf, len: 0 }
    }

    /// The number of bytes that `write` writes.
    pub(crate) fn count(write: impl FnOnce(&mut ByteWriter<'_>)) -> usize {
        let mut out = ByteWriter { buf: &mut [], len: 0 };
        write(&mut out);
        out.len
    }

    pub(crate) fn put(&mut self, bytes: &[u8]) {
        let room = self.buf.get_mut(self.len..).unwrap_or_default();
        for (to, from) in room.iter_mut().zip(bytes) {
            *to = *from;
        }
        self.len = self.len.saturating_add(bytes.len());
    }

    pub(crate) fn byte(&mut self, byte: u8) {
        self.put(&[byte]);
    }

    /// Number of bytes so far, including those that did not fit.
    pub(crate) const fn len(&self) -> usize {
        self.len
    }

    /// The bytes that were written; `None` if they did not all fit.
    pub(crate) fn finish(self) -> Option<&'b [u8]> {
        let Self { buf, len } = self;
        buf.get(..len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_is_counted_and_not_given() {
        let mut buf = [0xA5; 4];
        let mut out = ByteWriter::new(&mut buf);
        out.put(b"abc");
        assert_eq!((out.len(), out.finish()), (3, Some(&b"abc"[..])));
        let mut out = ByteWriter::new(&mut buf);
        out.put(b"abc");
        out.put(b"de");
        assert_eq!((out.len(), out.finish()), (5, None));
        assert_eq!(ByteWriter::count(|out| out.put(&[0; 1000])), 1000);
    }
}
