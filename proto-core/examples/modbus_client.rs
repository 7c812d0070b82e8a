//! The Modbus client alone: one transaction at a time over any transport. Answers come in pieces, a
//! request is refused, one is given up and answered too late, and a server breaks the protocol.
//! `cargo run -p proto-core --example modbus_client` prints modbus_client.out.

use std::error::Error;

use proto_core::modbus::Coils;
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{Request, Response};
use proto_core::wire::dialect::Dialect;

fn main() -> Result<(), Box<dyn Error>> {
    let mut client = Client::new(Dialect::V2_3.modbus_unit);

    println!("operation mode and robot state:");
    send(&mut client, Request::ReadHolding { address: 0, count: 2 })?;
    receive(&mut client, &[0, 1, 0, 0, 0, 7, 1, 3]);
    receive(&mut client, &[4, 0, 1, 0, 6]);

    println!("switch DO1 and DO3 on, DO2 off:");
    let mut packed = [0];
    let coils = Coils::pack([true, false, true], &mut packed).ok_or("more than a byte of coils")?;
    send(&mut client, Request::WriteCoils { address: 192, coils })?;
    receive(&mut client, &[0, 2, 0, 0, 0, 6, 1, 0x0F, 0, 192, 0, 3]);

    println!("a register that the controller does not have:");
    send(&mut client, Request::WriteRegister { address: 0x7000, value: 1 })?;
    receive(&mut client, &[0, 3, 0, 0, 0, 3, 1, 0x86, 2]);

    println!("no answer in 500 ms, by the caller's clock; the late one comes before the next:");
    send(&mut client, Request::ReadHolding { address: 2, count: 1 })?;
    client.abort();
    send(&mut client, Request::ReadHolding { address: 3, count: 1 })?;
    receive(&mut client, &[0, 4, 0, 0, 0, 5, 1, 3, 2, 0, 9, 0, 5, 0, 0, 0, 5, 1, 3, 2, 0, 5]);
    println!("  late answers so far: {}", client.stale_answers());

    println!("what cannot be a header:");
    send(&mut client, Request::ReadHolding { address: 0, count: 1 })?;
    receive(&mut client, b"HTTP/1.1 400 Bad Request\r\n");
    Ok(())
}

fn send(client: &mut Client, request: Request<'_>) -> Result<(), Box<dyn Error>> {
    let mut frame = [0; MAX_ADU];
    let len = client.start(request, &mut frame)?;
    println!("  > {:02X?}", &frame[..len]);
    Ok(())
}

/// What a socket has read, in pieces of any size.
fn receive(client: &mut Client, mut chunk: &[u8]) {
    println!("  < {chunk:02X?}");
    while let Some(event) = client.receive(&mut chunk) {
        match event {
            ClientEvent::Response(Response::Registers(registers)) => {
                println!("  registers: {:?}", registers.iter().collect::<Vec<_>>());
            }
            ClientEvent::Response(response) => println!("  done: {response:?}"),
            ClientEvent::Exception(exception) => println!("  refused: {exception}"),
            ClientEvent::Violation(violation) => println!("  close the connection: {violation}"),
        }
    }
}
