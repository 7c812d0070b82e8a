//! One message of a CAN_RAW socket: a frame, and whether this socket sent it.
//!
//! The `socketcan` crate does not report the flag that marks the echo of a sent frame.

use std::io;
use std::mem::{size_of_val, zeroed};
use std::os::fd::{AsRawFd, BorrowedFd};

use proto_core::wire::can::{CanFrame, CanId};
use socketcan::CanErrorFrame;

#[derive(Debug)]
pub(super) struct CanMessage {
    pub(super) content: Content,
    /// The echo of a frame that this socket has sent.
    pub(super) is_own: bool,
    /// The frame was sent by a program on this machine, whether or not it got onto the bus.
    pub(super) is_local: bool,
}

#[derive(Debug)]
pub(super) enum Content {
    /// A data or remote frame.
    Frame(CanFrame),
    /// The interface's report about itself and the bus.
    Error(CanErrorFrame),
    /// A CAN FD frame.
    Fd,
    /// Not a message of the documented kinds.
    Unknown,
}

/// Reads the next message.
///
/// # Errors
/// `WouldBlock` if there is none; otherwise the error of the interface.
pub(super) fn receive(socket: BorrowedFd<'_>) -> io::Result<CanMessage> {
    let mut bytes = [0_u8; libc::CANFD_MTU];
    let mut part = libc::iovec { iov_base: bytes.as_mut_ptr().cast(), iov_len: size_of_val(&bytes) };
    // SAFETY: a `msghdr` consists of pointers and numbers, for which zero is valid.
    let mut header: libc::msghdr = unsafe { zeroed() };
    header.msg_iov = &raw mut part;
    header.msg_iovlen = 1;
    // SAFETY: the header points to `bytes`, with their length; both outlive the call.
    let count = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut header, libc::MSG_DONTWAIT) };
    let count = usize::try_from(count).map_err(|_| io::Error::last_os_error())?;
    Ok(CanMessage {
        content: match count {
            libc::CAN_MTU => classic(&bytes),
            libc::CANFD_MTU => Content::Fd,
            _ => Content::Unknown,
        },
        is_own: header.msg_flags & libc::MSG_CONFIRM != 0,
        is_local: header.msg_flags & libc::MSG_DONTROUTE != 0,
    })
}

/// A `struct can_frame`: id and flags, length, three unused bytes, data.
fn classic(bytes: &[u8; libc::CANFD_MTU]) -> Content {
    let [i0, i1, i2, i3, len, _, _, _, data @ ..] = bytes;
    let word = u32::from_ne_bytes([*i0, *i1, *i2, *i3]);
    let len = usize::from(*len).min(libc::CAN_MAX_DLEN);
    let data = &data[..len];
    if word & libc::CAN_ERR_FLAG != 0 {
        return CanErrorFrame::new_error(word, data).map_or(Content::Unknown, Content::Error);
    }
    let id = if word & libc::CAN_EFF_FLAG != 0 {
        CanId::Extended(word & libc::CAN_EFF_MASK)
    } else {
        CanId::Standard((word & libc::CAN_SFF_MASK) as u16)
    };
    let frame = match word & libc::CAN_RTR_FLAG {
        0 => CanFrame::new(id, data),
        _ => CanFrame::remote(id, len),
    };
    frame.map_or(Content::Unknown, Content::Frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw(word: u32, len: u8, data: [u8; 8]) -> [u8; libc::CANFD_MTU] {
        let mut bytes = [0xA5; libc::CANFD_MTU];
        bytes[..4].copy_from_slice(&word.to_ne_bytes());
        bytes[4] = len;
        bytes[8..16].copy_from_slice(&data);
        bytes
    }

    #[test]
    fn frames_keep_id_kind_and_data() {
        let data = [1, 2, 3, 4, 5, 6, 7, 8];
        let frame = |word, len| match classic(&raw(word, len, data)) {
            Content::Frame(frame) => frame,
            other => panic!("{other:?}"),
        };
        assert_eq!(Some(frame(0x7FF, 3)), CanFrame::new(CanId::Standard(0x7FF), &data[..3]));
        let extended = libc::CAN_EFF_FLAG | 0x1ABC_DEF0;
        assert_eq!(Some(frame(extended, 8)), CanFrame::new(CanId::Extended(0x1ABC_DEF0), &data));
        assert_eq!(Some(frame(libc::CAN_RTR_FLAG | 5, 4)), CanFrame::remote(CanId::Standard(5), 4));
        assert_eq!(frame(1, 255).data().len(), 8, "a length no kernel reports");
    }

    #[test]
    fn error_frames_are_distinguished() {
        let off = libc::CAN_ERR_FLAG | libc::CAN_ERR_BUSOFF;
        assert!(matches!(classic(&raw(off, 8, [0; 8])), Content::Error(_)));
    }
}
