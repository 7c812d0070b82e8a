//! The state stream alone: packets of 1468 bytes without a mark, cut out of what a socket reads and checked
//! for alignment. `cargo run -p proto-core --example state_stream` prints state_stream.out.

use proto_core::sysvar::SysVar;
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{LEN, StatePacket, StateStream};

fn main() {
    let mut stream = StateStream::new();

    println!("two packets, in pieces as a socket reads them:");
    let sent = [packet(0.25), packet(0.5)].concat();
    for piece in sent.chunks(1000) {
        receive(&mut stream, piece);
    }

    println!("a byte is missing: nothing fits from there on");
    let sent = [&packet(0.75)[1..], &packet(1.0), &packet(1.25), &packet(1.5)].concat();
    receive(&mut stream, &sent);
    if stream.is_lost() {
        println!("  reopen the connection: {} packets in a row", stream.misaligned_in_a_row());
        stream.reset();
    }

    println!("the new connection begins with a whole packet:");
    receive(&mut stream, &packet(1.75));
    println!("{} packets, {} misaligned", stream.packets(), stream.misaligned());
}

fn receive(stream: &mut StateStream, mut chunk: &[u8]) {
    println!("  {} bytes", chunk.len());
    while let Some(next) = stream.next_packet(&mut chunk) {
        match next {
            Ok(view) => {
                let states = view.states(&Dialect::V2_3);
                println!(
                    "    {:?}, {:?}, joint 1 at {} rad",
                    states.mode,
                    states.robot,
                    view.joint_position()[0]
                );
                // Any system variable that stands in the packet, by its name.
                let status = SysVar::parse("DigitalSignalStatus[4]").ok().and_then(|var| view.read_var(var));
                println!(
                    "    outputs 1 to 8: {}",
                    status.map_or("not in it".into(), |value| value.to_string())
                );
            }
            Err(misaligned) => println!("    skipped: {misaligned}"),
        }
    }
}

/// What a controller would send: the arm enabled, outputs 1 and 3 on.
fn packet(joint_rad: f32) -> [u8; LEN] {
    let mut packet = StatePacket::ZERO;
    for (joint, nth) in (1_u8..=6).enumerate() {
        packet.joint_position[joint] = joint_rad / f32::from(nth);
        packet.target_joint_position[joint] = joint_rad / f32::from(nth);
        packet.joint_torque[joint] = 12.3 * f32::from(nth);
        packet.joint_current[joint] = -45.6 * f32::from(nth);
        packet.tcp_pose[joint] = 0.1 * f32::from(nth);
        packet.target_tcp_pose[joint] = 0.1 * f32::from(nth);
    }
    packet.digital_outputs[0] = 1;
    packet.digital_outputs[2] = 1;
    packet.operation_mode = 1;
    packet.robot_state = 6;
    packet.safety_state = 5;
    packet.to_bytes()
}
