//! A run of an engine for the tests of recordings and replays: no sockets, and a clock of its own.

use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use proto_core::config::{GatewayConfig, image};
use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output, PortId, TapDirection, TapPlace, TapVerdict};
use proto_core::record::{Entry, totals};
use proto_core::time::Instant;
use recipe_config::file::Text;
use recipe_export::Model;
use recipe_test_kit::example;

use crate::decode::Decoder;
use crate::frame::Frame;
use crate::record::{Cell, Epoch, Record, What};
use crate::watch::Watch;

/// The file whose gateway runs: frames of five bytes on a serial line.
pub(crate) const FILE: &str = "rs485-system.toml";

/// A gateway that tells a watch what it does.
pub(crate) struct TestRun {
    pub(crate) engine: Box<Engine>,
    pub(crate) watch: Watch,
    pub(crate) at: Instant,
}

impl TestRun {
    pub(crate) fn begin(watch: &Watch) -> Self {
        Self::begin_with(watch, &std::fs::read_to_string(example(FILE)).unwrap())
    }

    /// The engine of a file with this text begins.
    pub(crate) fn begin_with(watch: &Watch, toml: &str) -> Self {
        let config = recipe_test_kit::toml::gateway(toml);
        let model = Model::parse(Text { name: "cell.toml", toml }, &[]).unwrap();
        let engine = Box::new(Engine::new(&*config).unwrap());
        let at = Instant::from_millis(1_000);
        let wall = UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        let cell = Cell::new(&config, &engine, Epoch { at, wall }, Arc::new(Decoder::new(&model)));
        watch.give(Record { at, lost: 0, what: What::Began(Arc::new(cell)) });
        let mut bytes = vec![0; image::MAX_IMAGE];
        let len = image::encode(&*config, &mut bytes).unwrap();
        let mut run = Self { engine, watch: watch.clone(), at };
        run.entries(&[Entry::Start { image: &bytes[..len] }], 0);
        run.input(Input::Tick, 0);
        run.input(Input::PortUp { port: PortId(0) }, 0);
        run
    }

    /// A frame arrives, a millisecond after what was before.
    pub(crate) fn frame(&mut self, value: u8) {
        let bytes = [0xFF, 0xFF, value, 0xEE, 0xEE];
        self.pass(1);
        self.input(Input::PortBytes { port: PortId(0), bytes: &bytes }, 0);
        let (place, verdict) = (TapPlace::Port(PortId(0)), TapVerdict::Taken);
        let frame =
            Frame { place, direction: TapDirection::In, verdict, can_id: None, len: 5, bytes: bytes.into() };
        self.watch.give(Record { at: self.at, lost: 0, what: What::Frame(frame) });
    }

    pub(crate) fn pass(&mut self, millis: u64) {
        self.at = Instant::from_micros(self.at.as_micros() + 1_000 * millis);
        self.input(Input::Tick, 0);
    }

    /// One call; `lost` others were lost before it.
    pub(crate) fn input(&mut self, input: Input<'_>, lost: u32) {
        let mut bytes = encoded(&[Entry::Input { at: self.at, input }]);
        let mut buf = [0; OUTPUT_BUFFER];
        self.engine.handle(self.at, input);
        loop {
            let output = self.engine.poll_output(self.at, &mut buf);
            bytes.extend(encoded(&[Entry::Output(output)]));
            if let Output::Sleep { .. } = output {
                break;
            }
        }
        self.watch.give(Record { at: self.at, lost, what: What::Pass(bytes.into()) });
    }

    pub(crate) fn end(self) {
        let totals = totals(&*self.engine);
        self.entries(&[Entry::Totals(&totals)], 0);
    }

    fn entries(&self, entries: &[Entry<'_>], lost: u32) {
        self.watch.give(Record { at: self.at, lost, what: What::Pass(encoded(entries).into()) });
    }
}

fn encoded(entries: &[Entry<'_>]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for entry in entries {
        entry.encode(|piece| bytes.extend_from_slice(piece));
    }
    bytes
}

pub(crate) fn config() -> Box<GatewayConfig> {
    let text = std::fs::read_to_string(example(FILE)).unwrap();
    recipe_test_kit::toml::gateway(&text)
}
