//! The `host-sim` binary: see the library for what it does.

fn main() -> std::process::ExitCode {
    host_sim::cli::main()
}
