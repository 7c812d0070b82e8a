//! `chip ELF [IMAGE] [--ms N] [--last N]`: runs the firmware for N ms of virtual time (default 2000) and
//! prints its log; at the end the program counter, the last register accesses, and the speed of the run.
//!
//! If ELF is a loader, `--load ADDRESS=FILE` writes the content of a slot, as made by `host-sim ctl inspect --slot`,
//! and `--knows ELF` names a program that runs there.
//!
//! `chip ELF [IMAGE] --realtime [...]`: runs it in real time until it is interrupted, with sockets for its serial
//! lines, CAN bus and Ethernet (docs/chip.md section 5).

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::process::ExitCode;
use std::time::Instant;

use recipe_chip_model::device::{MILLI, SECOND};
use recipe_chip_model::realtime::{Backends, RunEnd, Runner, exec_if_requested};
use recipe_chip_model::{Chip, Program, Stopped};
use signal_hook::consts::{SIGINT, SIGTERM};

const USAGE: &str = "usage: chip ELF [IMAGE] [--load ADDRESS=FILE].. [--knows ELF].. [--ms N] [--last N]
       chip ELF [IMAGE] [--load ADDRESS=FILE].. [--knows ELF].. --realtime [--rs485 PLACE [--rs485 PLACE]] [--can PLACE]
            [--network OPTIONS [--qmp PATH]] [--control PLACE] [--last N]
PLACE is HOST:PORT or the path of a socket; OPTIONS are those of QEMU's '-netdev user', or ''";

fn main() -> ExitCode {
    let result = exec_if_requested(std::env::args().skip(1)).and_then(|()| run());
    result.unwrap_or_else(|error| {
        eprintln!("{error}");
        ExitCode::from(2)
    })
}

struct Options {
    files: Vec<String>,
    /// Files to load into flash, by address.
    loads: Vec<(u32, String)>,
    /// ELF files of the programs that the first one runs.
    known: Vec<String>,
    ms: u64,
    last: usize,
    wiring: Option<Backends>,
}

fn options(mut args: impl Iterator<Item = String>) -> Result<Options, String> {
    let mut options = Options {
        files: Vec::new(),
        loads: Vec::new(),
        known: Vec::new(),
        ms: 2_000,
        last: 20,
        wiring: None,
    };
    let (mut wiring, mut is_wired) = (Backends::default(), false);
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
        let number = |value: String| value.parse().map_err(|_| format!("{value}: not a number"));
        is_wired |= ["--rs485", "--can", "--network", "--qmp", "--control"].contains(&arg.as_str());
        match arg.as_str() {
            "--load" => options.loads.push(load(&value()?)?),
            "--knows" => options.known.push(value()?),
            "--ms" => options.ms = number(value()?)?,
            "--last" => options.last = number(value()?)? as usize,
            "--realtime" => options.wiring = Some(Backends::default()),
            "--rs485" => wiring.serial.push(value()?),
            "--can" => wiring.can = Some(value()?),
            "--network" => wiring.network = Some(value()?),
            "--qmp" => wiring.qmp = Some(value()?),
            "--control" => wiring.control = Some(value()?),
            _ if arg.starts_with("--") => return Err(format!("{arg}: unknown argument\n{USAGE}")),
            _ => options.files.push(arg),
        }
    }
    match &mut options.wiring {
        Some(place) => *place = wiring,
        None if is_wired => return Err(format!("sockets need --realtime\n{USAGE}")),
        None => {}
    }
    Ok(options)
}

/// An address in hexadecimal, and the file for it.
fn load(value: &str) -> Result<(u32, String), String> {
    let parts = value.split_once('=').and_then(|(address, file)| {
        let address = u32::from_str_radix(address.trim_start_matches("0x"), 16).ok()?;
        Some((address, file.to_owned()))
    });
    parts.ok_or_else(|| format!("{value}: not an address and a file, as 0x08020000=slot-a.bin"))
}

fn run() -> Result<ExitCode, String> {
    let options = options(std::env::args().skip(1))?;
    let [elf, image @ ..] = options.files.as_slice() else { return Err(USAGE.into()) };
    let read = |file: &String| std::fs::read(file).map_err(|error| format!("{file}: {error}"));
    let parse = |file: &String| Program::read(&read(file)?);
    let known = options.known.iter().map(parse).collect::<Result<Vec<_>, _>>()?;
    let program: &'static Program = Box::leak(Box::new(parse(elf)?.knowing(known)));
    let image = image.first().map(read).transpose()?.unwrap_or_default();
    let mut chip = Chip::new(program, &image)?;
    for (address, file) in &options.loads {
        let bytes = read(file)?;
        if !chip.has_flash(*address, bytes.len()) {
            return Err(format!("{file}: {} bytes at {address:08X} are not in flash", bytes.len()));
        }
        chip.load(*address, &bytes);
    }
    let _ = chip.accesses(options.last).count();
    match &options.wiring {
        Some(wiring) => in_real_time(chip, wiring, options.last),
        None => in_virtual_time(chip, options.ms, options.last),
    }
}

fn in_real_time(chip: Chip, wiring: &Backends, last: usize) -> Result<ExitCode, String> {
    let failed = |error: std::io::Error| error.to_string();
    let (end, signal) = UnixStream::pair().map_err(failed)?;
    for number in [SIGINT, SIGTERM] {
        signal_hook::low_level::pipe::register(number, signal.try_clone().map_err(failed)?)
            .map_err(failed)?;
    }
    let mut runner = Runner::new(chip, wiring)?;
    let mut out = std::io::stdout();
    let ended = runner.run(&end, &mut out);
    let figures = runner.figures();
    let _ = writeln!(out, "{figures}");
    Ok(match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(RunEnd::Lost(reason)) => {
            eprintln!("{reason}");
            ExitCode::FAILURE
        }
        Err(RunEnd::Stopped(stopped)) => {
            show_end(runner.chip(), last, &mut std::io::stderr());
            eprintln!("not allowed: {stopped}");
            ExitCode::FAILURE
        }
    })
}

fn in_virtual_time(mut chip: Chip, ms: u64, last: usize) -> Result<ExitCode, String> {
    let (begin, mut shown, mut stopped): (_, _, Option<Stopped>) = (Instant::now(), 0, None);
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
    show_end(&mut chip, last, &mut std::io::stdout());
    let (instructions, interrupts) = (chip.instructions() as f64, chip.interrupts() as f64);
    println!(
        "{:.3} s of virtual time in {wall:.3} s; {instructions:.0} instructions, {:.1} million a second; \
         {interrupts:.0} interrupts, {:.0} a second; {} waits",
        chip.now() as f64 / SECOND as f64,
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

/// Prints the last accesses, the program counter, faults and resets. Write errors are ignored.
fn show_end(chip: &mut Chip, last: usize, out: &mut dyn Write) {
    let program = chip.program();
    let mut text = format!("\nthe last {last} accesses:\n");
    for access in chip.accesses(last) {
        text += &format!("{access}\n{:17}at {}\n", "", program.place(access.pc));
    }
    text += &format!("\nat {}\n", chip.place());
    for (pc, status) in &chip.faults {
        text += &format!("a fault, CFSR {status:08X}, at {}\n", program.place(*pc));
    }
    for at in &chip.resets {
        text += &format!("reset by the watchdog after {:.3} ms\n", *at as f64 / MILLI as f64);
    }
    for at in &chip.restarts {
        text += &format!("reset by the program after {:.3} ms\n", *at as f64 / MILLI as f64);
    }
    let _ = out.write_all(text.as_bytes());
}
