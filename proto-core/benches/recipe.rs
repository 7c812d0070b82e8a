//! Recipe decoding and encoding, each beside its bare limit. An iteration is [`FRAMES`] frames.
//! `-- instructions` counts instructions a frame instead of measuring time.

mod instructions;
mod workload;

use std::hint::black_box;
use std::process::ExitCode;

use divan::Bencher;
use divan::counter::ItemsCount;
use instructions::{Beside, Limit, Work};
use workload::{Can, Encode, FRAMES, Stream};

fn main() -> ExitCode {
    let work = |name, run| Work { name, limit: None, run };
    let works = [
        work("stream decode", |n| repeat(n, Stream::frames(), Stream::decode)),
        work("stream decode, bare", |n| repeat(n, Stream::frames(), Stream::decode_bare)),
        work("stream decode, 28 bytes of noise", |n| repeat(n, Stream::noise(), Stream::decode)),
        work("stream decode, 28 bytes of heads", |n| repeat(n, Stream::heads(), Stream::decode)),
        work("stream encode", |n| repeat(n, Encode::new(), Encode::encode)),
        work("stream encode, bare", |n| repeat(n, Encode::new(), Encode::encode_bare)),
        work("CAN decode", |n| repeat(n, Can::new(), Can::decode)),
        work("CAN decode, bare", |n| repeat(n, Can::new(), Can::decode_bare)),
    ];
    let beside = [
        // Half of what the best other library takes (proto-core/compare).
        Beside { name: "stream decode", bare: "stream decode, bare", limit: Limit::Times(2.1) },
        Beside { name: "stream encode", bare: "stream encode, bare", limit: Limit::Times(3.0) },
        Beside { name: "CAN decode", bare: "CAN decode, bare", limit: Limit::Times(3.1) },
    ];
    instructions::main_beside(&works, &beside).unwrap_or_else(|| {
        divan::main();
        ExitCode::SUCCESS
    })
}

/// Does a work for `frames` frames.
fn repeat<T>(frames: u64, mut work: T, pass: fn(&mut T) -> usize) {
    for _ in 0..frames / FRAMES as u64 {
        black_box(pass(&mut work));
    }
}

/// 28-byte frames, chunks of 1..=64 bytes, 1 % garbage.
mod stream_decode {
    use super::*;

    #[divan::bench]
    fn layout(bencher: Bencher<'_, '_>) {
        let mut work = Stream::frames();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.decode());
    }

    #[divan::bench]
    fn bare(bencher: Bencher<'_, '_>) {
        let mut work = Stream::frames();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.decode_bare());
    }
}

/// 28-byte frames.
mod stream_encode {
    use super::*;

    #[divan::bench]
    fn layout(bencher: Bencher<'_, '_>) {
        let mut work = Encode::new();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.encode());
    }

    #[divan::bench]
    fn bare(bencher: Bencher<'_, '_>) {
        let mut work = Encode::new();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.encode_bare());
    }
}

/// 16 ids, two floats each.
mod can_decode {
    use super::*;

    #[divan::bench]
    fn layout(bencher: Bencher<'_, '_>) {
        let mut work = Can::new();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.decode());
    }

    #[divan::bench]
    fn bare(bencher: Bencher<'_, '_>) {
        let mut work = Can::new();
        bencher.counter(ItemsCount::new(FRAMES)).bench_local(|| work.decode_bare());
    }
}
