//! The network at the other end of the Ethernet cable: QEMU's user network (slirp) without a machine. QEMU is
//! started here and ends with this program, even if that is killed. Frames are sent over a stream, each after its
//! length (QEMU's `-netdev socket`), so none is lost.

use std::collections::VecDeque;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use rustix::event::PollFd;
use rustix::process::Signal;

use super::socket::Client;
use crate::device::*;
use crate::models::ethernet::Ethernet;

/// The first argument with which this program executes another one, which is killed when its parent ends.
pub(super) const END_WITH: &str = "--end-with";
/// Bytes per read.
const CHUNK: usize = 1 << 16;
/// QEMU's longest frame.
const LONGEST: usize = 1 << 16;
/// Frames that wait for the cable; more stay in the stream.
const WAITING: usize = 64;

/// QEMU, and the frames on their way to the chip.
#[derive(Debug)]
pub(super) struct Network {
    qemu: Child,
    qmp: Option<PathBuf>,
    stream: Client,
    unread: Vec<u8>,
    arriving: VecDeque<Vec<u8>>,
    free_at: Picos,
    /// Frames to the chip.
    pub(super) frames_in: u64,
    /// Frames from the chip.
    pub(super) frames_out: u64,
}

impl Network {
    /// Starts QEMU. `options` are those of its `-netdev user`; `qmp` is the path of its QMP socket.
    ///
    /// # Errors
    /// QEMU cannot be started.
    pub(super) fn new(options: &str, qmp: Option<&str>) -> Result<Self, String> {
        let failed = |error: std::io::Error| format!("qemu-system-arm: {error}");
        let (ours, its) = UnixStream::pair().map_err(failed)?;
        ours.set_nonblocking(true).map_err(failed)?;
        let us = std::env::current_exe().map_err(failed)?;
        let separator = if options.is_empty() { "" } else { "," };
        let mut command = Command::new(us);
        command
            .args([END_WITH, &std::process::id().to_string(), "qemu-system-arm"])
            .args(["-M", "none", "-display", "none", "-monitor", "none", "-serial", "none"])
            .args(["-netdev", &format!("user,id=u{separator}{options}"), "-netdev", "socket,id=s,fd=0"])
            .args(["-netdev", "hubport,hubid=0,id=a,netdev=u", "-netdev", "hubport,hubid=0,id=b,netdev=s"])
            // Ctrl-C must reach only this program, which then ends QEMU.
            .process_group(0)
            .stdin(Stdio::from(std::os::fd::OwnedFd::from(its)))
            .stdout(Stdio::null());
        if let Some(path) = qmp {
            command.args(["-qmp", &format!("unix:{path},server=on,wait=off")]);
        }
        let qemu = command.spawn().map_err(failed)?;
        let (unread, arriving) = (Vec::new(), VecDeque::new());
        let stream = Client::new(ours.into());
        let qmp = qmp.map(PathBuf::from);
        Ok(Self { qemu, qmp, stream, unread, arriving, free_at: 0, frames_in: 0, frames_out: 0 })
    }

    /// Moves frames both ways; those to the chip at 100 Mbit/s.
    ///
    /// # Errors
    /// QEMU has ended.
    pub(super) fn exchange(&mut self, ethernet: &mut Ethernet, now: Picos) -> Result<(), String> {
        while let Some(frame) = ethernet.sent.pop_front() {
            self.frames_out += 1;
            self.stream.write(&(frame.len() as u32).to_be_bytes());
            self.stream.write(&frame);
        }
        self.stream.flush();
        if self.arriving.len() < WAITING {
            self.unread.extend(self.stream.read(CHUNK));
        }
        while let Some((head, rest)) = self.unread.split_first_chunk() {
            let len = u32::from_be_bytes(*head) as usize;
            if len > LONGEST {
                return Err(format!("QEMU sent a frame of {len} bytes"));
            }
            let Some(frame) = rest.get(..len) else { break };
            self.arriving.push_back(frame.to_vec());
            self.unread.drain(..4 + len);
        }
        while self.free_at <= now
            && let Some(frame) = self.arriving.pop_front()
        {
            // Preamble, FCS and inter-frame gap are 24 bytes.
            self.free_at = self.free_at.max(now) + (frame.len() as u64 + 24) * 8 * cycle(100_000_000);
            ethernet.receive(&frame);
            self.frames_in += 1;
        }
        match self.stream.is_gone() {
            true => Err("the network has ended (QEMU)".into()),
            false => Ok(()),
        }
    }

    /// When the next waiting frame can arrive.
    pub(super) fn next(&self) -> Option<Picos> {
        (!self.arriving.is_empty()).then_some(self.free_at)
    }

    pub(super) fn poll(&self) -> PollFd<'_> {
        self.stream.poll(self.arriving.len() < WAITING)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
        if let Some(path) = &self.qmp {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// If the arguments are `--end-with PARENT PROGRAM ...`, executes the program so that it is killed when the
/// process PARENT ends. Otherwise returns.
///
/// # Errors
/// The program cannot be executed, or PARENT has ended.
pub fn exec_if_requested(mut arguments: impl Iterator<Item = String>) -> Result<(), String> {
    if arguments.next().as_deref() != Some(END_WITH) {
        return Ok(());
    }
    let (parent, program) = arguments.next().zip(arguments.next()).ok_or("not enough arguments")?;
    rustix::process::set_parent_process_death_signal(Some(Signal::KILL))
        .map_err(|error| error.to_string())?;
    // The parent may have ended before the signal was set.
    if rustix::process::getppid().map(|pid| pid.as_raw_pid().to_string()) != Some(parent) {
        return Err("the program that started this has ended".into());
    }
    Err(format!("{program}: {}", Command::new(&program).args(arguments).exec()))
}
