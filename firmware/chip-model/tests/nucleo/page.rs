//! The web page, sent over the test's TCP to fast clients, one that does not read, and one that reads slowly. The cell
//! keeps its cycle meanwhile.

use recipe_chip_model::device::{MILLI, Picos, SECOND};

use crate::Bench;
use crate::boot::CELL;
use crate::cell::off_the_grid;
use crate::client::{WIDE, ask, browser, connection, read};
use crate::serial::ready;

/// A read smaller than the page.
const NARROW: usize = 2 << 10;

fn request() -> Vec<u8> {
    browser().bytes("GET /", "", b"")
}

/// A cell whose outputs leave every 4 ms on both buses.
pub(crate) fn cyclic() -> Bench {
    ready(&CELL.replace("send = \"frame\"\n", ""))
}

/// No cycle is missing, and none is later than another task or an interrupt may make it.
#[track_caller]
pub(crate) fn is_on_its_grid(bench: &mut Bench, begin: Picos) {
    let cycles = ((bench.now() - begin) / (4 * MILLI)) as usize;
    for (bus, count, worst) in off_the_grid(bench, begin) {
        assert!((cycles - 1..=cycles + 1).contains(&count), "{bus}: {count} of {cycles} cycles");
        assert!(worst < MILLI / 2, "{bus}: off by {worst}");
        println!("{bus}: {count} cycles, off by {} us at most", worst / 1_000_000);
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn three_pages_at_once_are_whole_and_cost_no_cycle() {
    let mut bench = cyclic();
    let begin = bench.now();
    bench.run(SECOND);
    is_on_its_grid(&mut bench, begin);
    let begin = bench.now();
    let clients = [(); 3].map(|()| (ask(&mut bench, &request(), WIDE), Vec::new()));
    let mut clients = Vec::from(clients);
    bench.until("all pages", 5 * SECOND, |bench| {
        for (handle, bytes) in &mut clients {
            read(bench, *handle, WIDE, bytes);
        }
        clients.iter().all(|(handle, _)| !connection(bench, *handle).may_recv())
    });
    println!("three pages in {} ms", (bench.now() - begin) / MILLI);
    for (_, bytes) in clients {
        assert!(bytes.starts_with(b"HTTP/1.1 200 OK\r\n") && bytes.ends_with(&recipe_console::PAGE));
    }
    bench.run(SECOND / 2);
    is_on_its_grid(&mut bench, begin);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_client_that_does_not_read_is_given_up_after_five_seconds() {
    let mut bench = cyclic();
    let begin = bench.now();
    let silent = ask(&mut bench, &request(), NARROW);
    bench.until("its end", 8 * SECOND, |bench| !connection(bench, silent).is_open());
    let took = bench.now() - begin;
    assert!((5 * SECOND..6 * SECOND).contains(&took), "{} ms", took / MILLI);
    is_on_its_grid(&mut bench, begin);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_client_that_reads_little_by_little_is_given_up_after_ten_seconds() {
    let mut bench = cyclic();
    let begin = bench.now();
    let slow = ask(&mut bench, &request(), NARROW);
    let mut bytes = Vec::new();
    while connection(&mut bench, slow).is_open() {
        assert!(bench.now() - begin < 15 * SECOND, "it is still served, with {} bytes", bytes.len());
        bench.run(SECOND);
        read(&mut bench, slow, 1_000, &mut bytes);
    }
    let took = bench.now() - begin;
    assert!((10 * SECOND..12 * SECOND).contains(&took), "{} ms", took / MILLI);
    assert!((5_000..20_000).contains(&bytes.len()), "{} bytes", bytes.len());
}
