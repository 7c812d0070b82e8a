//! Who watches a gateway, and who stalls.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use proto_core::engine::{TapDirection, TapVerdict};
use recipe_capture::{Interest, Next, Subscription, Watch, What};
use recipe_runtime::gateway;
use recipe_test_kit::{toml, until};

const FRAMES: Interest = Interest { frames: true, passes: false };

/// A serial port whose frames are answered.
const CELL: &str = r#"
[controller]
address = "127.0.0.1"
ports = { command = 1, state = 1, modbus = 1 }

[[recipe]]
name = "ask"
kind = "stream"
mode = "user"
[recipe.input]
head = [1, 2]
tail = [3, 4]
fields = [{ name = "number", type = "word", to = "WordInputReg[1]" }]
[recipe.output]
head = [5]
tail = [6]
send = "frame"
fields = [{ name = "count", type = "byte", from = "counter" }]

[[port]]
name = "line"
bus = "rs485"
baud = 4000000
recipe = "ask"
"#;

/// The numbers of the frames that came in.
fn numbers(subscription: &Subscription, wanted: usize) -> Vec<u16> {
    let mut numbers = Vec::new();
    until("all frames", || {
        while let Next::Record(arrived) = subscription.next(Duration::ZERO) {
            assert_eq!((arrived.missed, arrived.record.lost), (0, 0));
            if let What::Frame(frame) = &arrived.record.what
                && frame.direction == TapDirection::In
                && frame.verdict == TapVerdict::Taken
            {
                numbers.push(u16::from_le_bytes([frame.bytes[2], frame.bytes[3]]));
            }
        }
        (numbers.len() >= wanted).then_some(())
    });
    numbers
}

#[test]
fn a_subscriber_that_stalls_delays_neither_the_gateway_nor_another() {
    const COUNT: u16 = 2_000;
    let watch = Watch::new();
    let stalled = watch.subscribe(FRAMES, 4);
    let other = watch.subscribe(FRAMES, 100_000);
    let binds = vec!["line=tcp-listen:127.0.0.1:0".parse().unwrap()];
    let gateway = gateway::start_watched(*toml::gateway(CELL), binds, &watch).unwrap();
    let mut line = TcpStream::connect(gateway.place("ports/line")).unwrap();
    line.set_nodelay(true).unwrap();
    line.set_read_timeout(Some(recipe_test_kit::PATIENCE)).unwrap();
    // Each frame is answered, so the gateway takes them one by one.
    for nth in 0..COUNT {
        let [low, high] = nth.to_le_bytes();
        line.write_all(&[1, 2, low, high, 3, 4]).unwrap();
        let mut answer = [0; 3];
        line.read_exact(&mut answer).unwrap();
        assert_eq!((answer[0], answer[2]), (5, 6));
    }
    assert_eq!(numbers(&other, usize::from(COUNT)), (0..COUNT).collect::<Vec<_>>());
    assert!(stalled.missed() >= u64::from(COUNT), "{}", stalled.missed());
    // Nobody is interested any more: nothing is recorded, and the gateway goes on.
    drop((stalled, other));
    assert_eq!(gateway.watch().wanted(), Interest::default());
    line.write_all(&[1, 2, 0, 0, 3, 4]).unwrap();
    line.read_exact(&mut [0; 3]).unwrap();
    // Who comes later is told what it is.
    let late = watch.subscribe(FRAMES, 100);
    let Next::Record(first) = late.next(recipe_test_kit::PATIENCE) else { panic!("nothing") };
    let What::Began(cell) = &first.record.what else { panic!("{first:?}") };
    assert_eq!(cell.ports[0].name, "line");
    gateway.shutdown().unwrap();
}

#[test]
fn one_watch_tells_of_gateways_one_after_the_other() {
    let watch = Watch::new();
    let all = watch.subscribe(Interest { frames: true, passes: true }, 100_000);
    for _ in 0..2 {
        let binds = vec!["line=tcp-listen:127.0.0.1:0".parse().unwrap()];
        let gateway = gateway::start_watched(*toml::gateway(CELL), binds, &watch).unwrap();
        gateway.shutdown().unwrap();
    }
    watch.close();
    let mut began = 0;
    let mut starts = 0;
    while let Next::Record(arrived) = all.next(Duration::ZERO) {
        match &arrived.record.what {
            What::Began(_) => began += 1,
            What::Pass(bytes) => starts += usize::from(bytes.first() == Some(&1)),
            What::Frame(_) => {}
        }
    }
    assert_eq!((began, starts), (2, 2), "everything was given when the gateway had ended");
}
