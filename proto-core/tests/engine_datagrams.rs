//! Whose datagrams a listening UDP link's driver answers (docs/driver.md section 5).

mod rig;

use proto_core::config::Bus;
use proto_core::engine::LinkId;
use rig::*;

fn frame(value: f32) -> Vec<u8> {
    [&[255, 255][..], &value.to_le_bytes(), &[254, 254]].concat()
}

#[test]
fn only_a_whole_frame_of_the_links_output_part_is_one() {
    let mut cell = Cell::new();
    let both = cell.stream(&["ForceEnd[1]"], &["RobotState[26]"]);
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    cell.recipe_link(both);
    let listen = |port: u16| heapless::String::try_from(format!("0.0.0.0:{port}").as_str()).unwrap();
    let listens = LinkId::of_port(cell.port(Bus::UdpListen { listen: listen(50_000) }, both));
    let writes = LinkId::of_port(cell.port(Bus::UdpListen { listen: listen(50_001) }, up));
    let field = cell.rs485(up);
    let rig = cell.rig();
    let is_frame = |link, bytes: &[u8]| rig.engine.is_frame(link, bytes);
    for link in [listens, LinkId::RECIPE_UDP] {
        assert!(is_frame(link, &frame(1.0)));
        assert!(is_frame(link, &frame(f32::NAN)), "whether it can be read is another question");
        assert!(!is_frame(link, &[]));
        for len in 0..frame(1.0).len() {
            assert!(!is_frame(link, &frame(1.0)[..len]), "the first {len} bytes");
        }
        assert!(!is_frame(link, &frame(1.0).repeat(2)), "two in one datagram");
        assert!(!is_frame(link, &[&[0][..], &frame(1.0)].concat()));
        for at in [0, 1, 6, 7] {
            let mut wrong = frame(1.0);
            wrong[at] ^= 1;
            assert!(!is_frame(link, &wrong), "byte {at}");
        }
        let input = [&[255, 255][..], &1.0_f32.to_le_bytes(), &[238, 238]].concat();
        assert!(!is_frame(link, &input), "what we send is none");
    }
    for link in [writes, LinkId::of_port(field), LinkId::STATE, LinkId::MODBUS, LinkId::URGENT, LinkId(200)] {
        assert!(!is_frame(link, &frame(1.0)), "{link:?} has no output part");
    }
    let counters = rig.link(listens).counters;
    assert_eq!((counters.bytes_in, counters.received), (0, 0), "asking changes nothing");
}
