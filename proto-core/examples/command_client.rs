//! The client of port 2000 alone: commands and their replies, which have no length and, in version 2.3,
//! no end. Time is the caller's. `cargo run -p proto-core --example command_client` prints
//! command_client.out.

use std::error::Error;

use proto_core::command::{ClientEvent, CommandClient, MAX_COMMAND};
use proto_core::time::Instant;
use proto_core::wire::dialect::Dialect;

fn main() -> Result<(), Box<dyn Error>> {
    let mut client = CommandClient::new();

    send(&mut client, 0, "poweron")?;
    receive(&mut client, 2_100, b"poweron suc");
    receive(&mut client, 2_101, b"cess");

    // Four numbers could become longer: they are complete when nothing more has come for 20 ms.
    send(&mut client, 3_000, "state")?;
    receive(&mut client, 3_004, b"6:0:5:");
    receive(&mut client, 3_005, b"1");
    wait(&mut client);

    // A command that stops does not wait for the reply to another one.
    send(&mut client, 4_000, "run(weld.jspf)")?;
    let mut out = [0; MAX_COMMAND];
    let len = client.start_beside(Instant::from_millis(4_010), b"stop", &Dialect::V2_3, &mut out)?;
    println!(" 4010 ms > {}", out[..len].escape_ascii());
    receive(&mut client, 4_015, b"stop success");
    receive(&mut client, 4_020, b"run start");
    receive(&mut client, 4_300, b"script finish");

    // No reply at all: after 10 s the request is given up, and its owner reconnects.
    send(&mut client, 5_000, "disable")?;
    wait(&mut client);

    // What is no command is not sent.
    match send(&mut client, 16_000, "dance") {
        Ok(()) => println!("sent"),
        Err(reason) => println!("not sent: {reason}"),
    }
    Ok(())
}

fn send(client: &mut CommandClient, millis: u64, text: &str) -> Result<(), Box<dyn Error>> {
    let mut out = [0; MAX_COMMAND];
    let len = client.start(Instant::from_millis(millis), text.as_bytes(), &Dialect::V2_3, &mut out)?;
    println!("{millis:>5} ms > {}", out[..len].escape_ascii());
    Ok(())
}

/// What a socket has read, in pieces of any size.
fn receive(client: &mut CommandClient, millis: u64, mut chunk: &[u8]) {
    println!("{millis:>5} ms < {}", chunk.escape_ascii());
    while let Some(event) = client.receive(Instant::from_millis(millis), &mut chunk) {
        show(&event);
    }
}

/// Nothing comes until the client's deadline.
fn wait(client: &mut CommandClient) {
    let Some(deadline) = client.deadline() else { return };
    println!("{:>5} ms nothing more has come", deadline.as_micros() / 1000);
    while let Some(event) = client.poll(deadline) {
        show(&event);
    }
}

fn show(event: &ClientEvent<'_>) {
    match event {
        ClientEvent::Reply { kind, reply, .. } => println!("         {kind:?}: {reply:?}"),
        ClientEvent::ScriptFinish => println!("         the program has ended"),
        ClientEvent::Unsolicited { text, .. } => println!("         unasked: {}", text.escape_ascii()),
        ClientEvent::Timeout => println!("         given up: no reply"),
    }
}
