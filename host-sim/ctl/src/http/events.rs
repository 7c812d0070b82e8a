//! Server-sent events.
//!
//! In: the bytes of a stream, in pieces of any size. Out: events. An event longer than [`MAX_EVENT`] ends the stream.

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ServerEvent {
    pub(crate) name: String,
    pub(crate) data: String,
}

/// Maximum length of an event in bytes, including its framing.
pub(crate) const MAX_EVENT: usize = 1 << 20;

#[derive(Debug, Default)]
pub(crate) struct EventParser {
    line: Vec<u8>,
    /// The previous line ended with CR: a following LF belongs to its end.
    after_cr: bool,
    name: String,
    data: Option<String>,
    /// Number of bytes since the last event.
    len: usize,
}

/// An event is too long or is not text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct BrokenStream;

impl EventParser {
    /// Consumes bytes, and appends the events that end in them.
    pub(crate) fn push(&mut self, bytes: &[u8], events: &mut Vec<ServerEvent>) -> Result<(), BrokenStream> {
        for &byte in bytes {
            let after_cr = std::mem::replace(&mut self.after_cr, byte == b'\r');
            match byte {
                b'\n' if after_cr => {}
                b'\n' | b'\r' => self.end_line(events)?,
                _ => {
                    self.len += 1;
                    if self.len > MAX_EVENT {
                        return Err(BrokenStream);
                    }
                    self.line.push(byte);
                }
            }
        }
        Ok(())
    }

    fn end_line(&mut self, events: &mut Vec<ServerEvent>) -> Result<(), BrokenStream> {
        let line = std::mem::take(&mut self.line);
        if line.is_empty() {
            let name = std::mem::take(&mut self.name);
            self.len = 0;
            if let Some(data) = self.data.take() {
                events.push(ServerEvent { name, data });
            }
            return Ok(());
        }
        let line = String::from_utf8(line).map_err(|_| BrokenStream)?;
        let (field, value) = line.split_once(':').unwrap_or((&line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            // A comment, which shows that the stream is still there.
            "" => self.len = self.len.saturating_sub(line.len()),
            "event" => value.clone_into(&mut self.name),
            "data" => match &mut self.data {
                Some(data) => {
                    data.push('\n');
                    data.push_str(value);
                }
                data => *data = Some(value.to_owned()),
            },
            _ => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_the_same_however_the_stream_is_cut() {
        let stream = ": hello\nevent: status\ndata: {\"a\":1}\n\n:\n\nevent:values\r\ndata:{\r\ndata: }\r\nid: 3\r\n\r\nevent: none\n\ndata: x\r\r";
        for at_once in 1..=stream.len() {
            let (mut events, mut found) = (EventParser::default(), Vec::new());
            for piece in stream.as_bytes().chunks(at_once) {
                events.push(piece, &mut found).unwrap();
            }
            let found: Vec<_> = found.iter().map(|event| (&*event.name, &*event.data)).collect();
            assert_eq!(found, [("status", "{\"a\":1}"), ("values", "{\n}"), ("", "x")], "{at_once}");
        }
    }

    #[test]
    fn an_endless_event_ends_the_stream_and_endless_comments_do_not() {
        let mut events = EventParser::default();
        let mut found = Vec::new();
        for _ in 0..MAX_EVENT / 1_000 * 3 {
            events.push(&[b":".as_slice(), &[b'x'; 1_000], b"\n\n"].concat(), &mut found).unwrap();
        }
        for _ in 0..MAX_EVENT / 1_000 {
            events.push(&[b"data:".as_slice(), &[b'x'; 900], b"\n"].concat(), &mut found).unwrap();
        }
        let more = [b'x'; MAX_EVENT];
        assert_eq!(events.push(&more, &mut found), Err(BrokenStream));
        assert!(found.is_empty());
        assert_eq!(EventParser::default().push(b"data: \xff\n", &mut found), Err(BrokenStream));
    }
}
