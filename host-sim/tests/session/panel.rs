//! The device at the gateway's port.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::Duration;

use recipe_test_kit::until;

/// A panel that sends its frame every 20 ms, and connects again when its connection is lost, until it is dropped.
pub(crate) struct Panel {
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Panel {
    pub(crate) fn start(connect: impl Fn() -> Option<Box<dyn Write>> + Send + 'static) -> Self {
        let end = Arc::<AtomicBool>::default();
        let ended = Arc::clone(&end);
        let (connected, is_connected) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let mut stream: Option<Box<dyn Write>> = None;
            while !ended.load(Relaxed) {
                if stream.as_mut().is_some_and(|stream| stream.write_all(&FRAME).is_ok()) {
                    let _ = connected.send(());
                } else {
                    stream = connect();
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        let panel = Self { end, thread: Some(thread) };
        until("the panel is connected", || is_connected.try_recv().ok());
        panel
    }
}

impl Drop for Panel {
    fn drop(&mut self) {
        self.end.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// It switches its outputs to 5.
const FRAME: [u8; 6] = [255, 255, 0, 5, 238, 238];
