//! Replays a recording of the engine on a Cortex-M7, with the capacity of a board: `replay IN OUT`, given as
//! semihosting arguments (docs/cortex-m7.md section 2). OUT gets the output of this engine.
#![no_std]
#![no_main]

mod bare;

use firmware::tasks::gateway::SizedEngine as Engine;
use proto_core::config::GatewayConfig;
use proto_core::record::replay;
use semihosting::fs::File;
use semihosting::io::Write;
use static_cell::ConstStaticCell;

const CAPACITY: usize = 3 * 512 * 1024;

#[cortex_m_rt::entry]
fn main() -> ! {
    static RECORDING: ConstStaticCell<[u8; CAPACITY]> = ConstStaticCell::new([0; CAPACITY]);
    static ENGINE: ConstStaticCell<Engine> = ConstStaticCell::new(Engine::idle());
    static CONFIG: ConstStaticCell<GatewayConfig> = ConstStaticCell::new(GatewayConfig::empty());
    static BUFFER: ConstStaticCell<[u8; 8192]> = ConstStaticCell::new([0; 8192]);

    let recording = bare::read_file(1, RECORDING.take());
    let file = bare::with_path(2, |path| File::create(path));
    let Ok(file) = file else { bare::fail("output", &"cannot be made") };
    let mut output = Buffered { file, buffer: BUFFER.take(), len: 0 };
    let replayed = replay(recording, ENGINE.take(), CONFIG.take(), |piece| output.write(piece));
    output.flush();
    match replayed {
        Ok(done) => {
            semihosting::println!("{} inputs, {} outputs", done.inputs, done.outputs);
            semihosting::process::exit(0)
        }
        Err(error) => bare::fail("replay", &error),
    }
}

/// Buffers accesses to the file, because semihosting calls are slow.
struct Buffered {
    file: File,
    buffer: &'static mut [u8],
    len: usize,
}

impl Buffered {
    fn write(&mut self, mut piece: &[u8]) {
        while !piece.is_empty() {
            let buf = &mut self.buffer[self.len..];
            let count = buf.len().min(piece.len());
            buf[..count].copy_from_slice(&piece[..count]);
            self.len += count;
            piece = &piece[count..];
            if self.len == self.buffer.len() {
                self.flush();
            }
        }
    }

    fn flush(&mut self) {
        if self.file.write_all(&self.buffer[..self.len]).is_err() {
            bare::fail("output", &"cannot be written");
        }
        self.len = 0;
    }
}
