//! `chip ELF [IMAGE] [--ms N] [--last N]`: runs the firmware for N ms of virtual time (2000), shows its log,
//! and at the end where it is, what it did last to which registers, and how fast that was.

use std::process::ExitCode;
use std::time::Instant;

use chip::device::MILLI;
use chip::{Chip, Program};

fn main() -> ExitCode {
    match run() {
        Ok(code) => code,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<ExitCode, String> {
    let (mut files, mut ms, mut last) = (Vec::new(), 2_000, 20);
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut number = || {
            let value = args.next().and_then(|value| value.parse().ok());
            value.ok_or_else(|| format!("{arg} needs a number"))
        };
        match arg.as_str() {
            "--ms" => ms = number()?,
            "--last" => last = number()?,
            _ => files.push(arg),
        }
    }
    let [elf, image @ ..] = files.as_slice() else {
        return Err("usage: chip ELF [IMAGE] [--ms N] [--last N]".into());
    };
    let read = |file: &String| std::fs::read(file).map_err(|error| format!("{file}: {error}"));
    let program: &'static Program = Box::leak(Box::new(Program::read(&read(elf)?)?));
    let image = image.first().map(read).transpose()?.unwrap_or_default();
    let mut chip = Chip::new(program, &image)?;
    let _ = chip.accesses(last as usize).count();
    let (begin, mut shown, mut stopped) = (Instant::now(), 0, None);
    for end in (1..=ms).map(|end| end * MILLI) {
        let result = chip.run_until(end);
        for (at, line) in &chip.log[shown..] {
            println!("{:12.3} ms  {line}", *at as f64 / MILLI as f64);
        }
        shown = chip.log.len();
        if let Err(violation) = result {
            stopped = Some(violation);
            break;
        }
    }
    let wall = begin.elapsed().as_secs_f64();
    println!("\nthe last {last} accesses:");
    for access in chip.accesses(last as usize) {
        println!("{access}");
        println!("{:17}at {}", "", program.place(access.pc));
    }
    println!("\nat {}", chip.place());
    for (pc, status) in &chip.faults {
        println!("a fault, CFSR {status:08X}, at {}", program.place(*pc));
    }
    for at in &chip.resets {
        println!("reset by the watchdog after {:.3} ms", *at as f64 / MILLI as f64);
    }
    let (instructions, interrupts) = (chip.instructions() as f64, chip.interrupts() as f64);
    println!(
        "{:.3} s of virtual time in {wall:.3} s; {instructions:.0} instructions, {:.1} million a second; \
         {interrupts:.0} interrupts, {:.0} a second; {} waits",
        chip.now() as f64 / (1_000 * MILLI) as f64,
        instructions / wall / 1e6,
        interrupts / wall,
        chip.waits,
    );
    Ok(match stopped {
        Some(stopped) => {
            println!("not allowed: {stopped}");
            ExitCode::FAILURE
        }
        None => ExitCode::SUCCESS,
    })
}
