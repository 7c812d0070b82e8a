//! The simulated controller's Modbus server with a foreign client, over real TCP:
//! every function, both ends of every block of the map, every exception (proto-core/docs/wire/modbus.md
//! sections 3 to 8).

use std::net::SocketAddr;
use std::time::Duration;

use recipe_config::SimConfig;
use recipe_runtime::Handle;
use recipe_runtime::controller;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_modbus::client::{Context, tcp};
use tokio_modbus::prelude::*;

/// The map in the controller's documentation: first and last address, whether writable.
const COILS: [(u16, u16, bool); 11] = [
    (0, 15, true),
    (16, 31, false),
    (32, 95, true),
    (96, 159, false),
    (160, 167, false),
    (168, 175, false),
    (176, 191, false),
    (192, 207, true),
    (208, 215, false),
    (216, 223, true),
    (224, 231, false),
];
const REGISTERS: [(u16, u16, bool); 12] = [
    (0, 7, false),
    (8, 39, true),
    (40, 71, false),
    (72, 79, false),
    (80, 87, true),
    (88, 89, false),
    (90, 91, true),
    (92, 98, false),
    (99, 105, false),
    (106, 111, false),
    (112, 117, false),
    (118, 118, false),
];
/// Coils that the documentation calls reserved: writing them has no effect.
const RESERVED_COILS: std::ops::RangeInclusive<u16> = 218..=223;

/// A simulated controller with its Modbus server on a free port.
struct Robot {
    _handle: Handle,
    address: SocketAddr,
}

impl Robot {
    fn start() -> Self {
        let mut config = SimConfig::default();
        for port in [
            &mut config.listen.command,
            &mut config.listen.state,
            &mut config.listen.modbus,
            &mut config.listen.udp2011,
        ] {
            *port = 0;
        }
        let handle = controller::start(config, Vec::new()).expect("the controller starts");
        let address = handle.place("modbus").parse().expect("an address");
        Self { _handle: handle, address }
    }

    async fn client(&self) -> Context {
        tcp::connect(self.address).await.expect("a connection")
    }

    async fn raw(&self) -> Raw {
        let stream = TcpStream::connect(self.address).await.expect("a connection");
        stream.set_nodelay(true).expect("no delay");
        Raw(stream)
    }
}

/// A raw connection, for requests that the client cannot send.
struct Raw(TcpStream);

impl Raw {
    async fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).await.expect("sent");
    }

    async fn expect(&mut self, bytes: &[u8]) {
        let mut answer = vec![0; bytes.len()];
        let read = timeout(PATIENCE, self.0.read_exact(&mut answer)).await.expect("an answer in time");
        read.expect("an answer");
        assert_eq!(answer, bytes);
    }

    async fn expect_closed(&mut self) {
        let mut byte = [0];
        match timeout(PATIENCE, self.0.read(&mut byte)).await.expect("an end in time") {
            Ok(0) | Err(_) => {}
            Ok(_) => panic!("{byte:02X?} instead of the end of the connection"),
        }
    }
}

/// Time limit of every wait for an answer.
const PATIENCE: Duration = Duration::from_secs(20);

/// The answer or the exception of a request that must not fail otherwise.
async fn answer<T>(call: impl Future<Output = tokio_modbus::Result<T>>) -> Result<T, ExceptionCode> {
    timeout(PATIENCE, call).await.expect("an answer in time").expect("no error below Modbus")
}

const ILLEGAL_FUNCTION: ExceptionCode = ExceptionCode::IllegalFunction;
const ILLEGAL_ADDRESS: ExceptionCode = ExceptionCode::IllegalDataAddress;
const ILLEGAL_VALUE: ExceptionCode = ExceptionCode::IllegalDataValue;

#[tokio::test]
async fn both_ends_of_every_block_of_coils() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    for (first, last, writable) in COILS {
        for address in [first, last] {
            assert!(answer(client.read_coils(address, 1)).await.is_ok(), "reading coil {address}");
            let single = answer(client.write_single_coil(address, true)).await;
            let multiple = answer(client.write_multiple_coils(address, &[true])).await;
            let expected = if writable { Ok(()) } else { Err(ILLEGAL_ADDRESS) };
            assert_eq!((single, multiple), (expected, expected), "writing coil {address}");
            let on = writable && !RESERVED_COILS.contains(&address);
            assert_eq!(answer(client.read_coils(address, 1)).await, Ok(vec![on]), "coil {address} after it");
        }
        let all = answer(client.read_coils(first, last - first + 1)).await.unwrap();
        assert_eq!(all.len(), usize::from(last - first + 1));
    }
    // The whole map in one request, and one more.
    assert_eq!(answer(client.read_coils(0, 232)).await.unwrap().len(), 232);
    assert_eq!(answer(client.read_coils(0, 233)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_coils(232, 1)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_coils(65_535, 1)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_coils(65_535, 2)).await, Err(ILLEGAL_ADDRESS));
}

#[tokio::test]
async fn both_ends_of_every_block_of_registers() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    for (first, last, writable) in REGISTERS {
        for address in [first, last] {
            let exists = address < 118;
            assert_eq!(answer(client.read_holding_registers(address, 1)).await.is_ok(), exists, "{address}");
            let single = answer(client.write_single_register(address, 0x1234)).await;
            let multiple = answer(client.write_multiple_registers(address, &[0x1234])).await;
            let expected = if writable { Ok(()) } else { Err(ILLEGAL_ADDRESS) };
            assert_eq!((single, multiple), (expected, expected), "writing register {address}");
            if writable {
                let after = answer(client.read_holding_registers(address, 1)).await;
                assert_eq!(after, Ok(vec![0x1234]), "register {address} after it");
            }
        }
    }
    assert_eq!(answer(client.read_holding_registers(0, 118)).await.unwrap().len(), 118);
    assert_eq!(answer(client.read_holding_registers(0, 119)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_holding_registers(65_535, 1)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_holding_registers(65_535, 2)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_holding_registers(0, 4)).await, Ok(vec![2, 6, 0, 5]), "the states");
}

#[tokio::test]
async fn every_writable_item_keeps_its_own_value() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    let words: Vec<u16> = (0..32).map(|nth| 0x8000 | (nth * 257)).collect();
    answer(client.write_multiple_registers(8, &words)).await.unwrap();
    assert_eq!(answer(client.read_holding_registers(8, 32)).await, Ok(words));
    for (first, last, _) in COILS.into_iter().filter(|(.., writable)| *writable) {
        for address in first..=last {
            answer(client.write_single_coil(address, address.is_multiple_of(3))).await.unwrap();
        }
    }
    for (first, last, _) in COILS.into_iter().filter(|(.., writable)| *writable) {
        let on = |address: u16| address.is_multiple_of(3) && !RESERVED_COILS.contains(&address);
        let expected: Vec<bool> = (first..=last).map(on).collect();
        assert_eq!(answer(client.read_coils(first, last - first + 1)).await, Ok(expected), "from {first}");
    }
}

#[tokio::test]
async fn a_write_that_touches_anything_read_only_writes_nothing() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    for (first, count) in [(15, 2), (31, 2), (95, 2), (191, 2), (206, 3), (215, 2), (223, 2), (0, 232)] {
        let before = answer(client.read_coils(0, 232)).await;
        assert_eq!(
            answer(client.write_multiple_coils(first, &vec![true; count])).await,
            Err(ILLEGAL_ADDRESS),
            "{count} coils from {first}"
        );
        assert_eq!(answer(client.read_coils(0, 232)).await, before);
    }
    for (first, count) in [(7, 2), (39, 2), (38, 3), (79, 2), (86, 3), (89, 2), (91, 2), (0, 118)] {
        let before = answer(client.read_holding_registers(0, 118)).await;
        assert_eq!(
            answer(client.write_multiple_registers(first, &vec![9; count])).await,
            Err(ILLEGAL_ADDRESS),
            "{count} registers from {first}"
        );
        assert_eq!(answer(client.read_holding_registers(0, 118)).await, before);
    }
}

#[tokio::test]
async fn counts_of_nothing_and_beyond_the_standard() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    assert_eq!(answer(client.read_coils(0, 0)).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.read_coils(0, 2000)).await, Err(ILLEGAL_ADDRESS), "allowed, but no such coils");
    assert_eq!(answer(client.read_coils(0, 2001)).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.read_coils(0, 65_535)).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.read_holding_registers(0, 0)).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.read_holding_registers(0, 125)).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.read_holding_registers(0, 126)).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.write_multiple_coils(0, &[])).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.write_multiple_coils(0, &[true; 1968])).await, Err(ILLEGAL_ADDRESS));
    assert_eq!(answer(client.write_multiple_registers(8, &[])).await, Err(ILLEGAL_VALUE));
    assert_eq!(answer(client.write_multiple_registers(0, &[0; 123])).await, Err(ILLEGAL_ADDRESS));
    // The count is checked before the address.
    assert_eq!(answer(client.read_coils(9999, 2001)).await, Err(ILLEGAL_VALUE));
}

#[tokio::test]
async fn functions_that_the_controller_does_not_have() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    assert_eq!(answer(client.read_discrete_inputs(0, 1)).await, Err(ILLEGAL_FUNCTION));
    assert_eq!(answer(client.read_input_registers(0, 1)).await, Err(ILLEGAL_FUNCTION));
    assert_eq!(answer(client.masked_write_register(8, 0xFF, 0)).await, Err(ILLEGAL_FUNCTION));
    assert_eq!(answer(client.read_write_multiple_registers(8, 1, 8, &[1])).await, Err(ILLEGAL_FUNCTION));
    assert!(answer(client.read_coils(0, 1)).await.is_ok(), "the connection stays");

    // The client has no functions for most of the others.
    let mut client = robot.raw().await;
    for function in (0..=0x7F).filter(|function| ![1, 3, 5, 6, 15, 16].contains(function)) {
        client.send(&[0, function, 0, 0, 0, 4, 1, function, 0, 0]).await;
        client.expect(&[0, function, 0, 0, 0, 3, 1, function | 0x80, 1]).await;
    }
}

#[tokio::test]
async fn requests_that_contradict_themselves() {
    let robot = Robot::start();
    let mut client = robot.raw().await;
    let refused = |id: u8, function: u8, code: u8| [0, id, 0, 0, 0, 3, 1, function | 0x80, code];
    // FC 5 with a value that is neither on nor off.
    for (id, value) in [(1, [0x00, 0x01]), (2, [0xFF, 0x01]), (3, [0x01, 0x00]), (4, [0xFE, 0x00])] {
        client.send(&[0, id, 0, 0, 0, 6, 1, 5, 0, 192, value[0], value[1]]).await;
        client.expect(&refused(id, 5, 3)).await;
    }
    // Byte counts that disagree with the count.
    client.send(&[0, 5, 0, 0, 0, 8, 1, 15, 0, 192, 0, 9, 1, 0xFF]).await;
    client.expect(&refused(5, 15, 3)).await;
    client.send(&[0, 6, 0, 0, 0, 9, 1, 16, 0, 8, 0, 2, 2, 0, 1]).await;
    client.expect(&refused(6, 16, 3)).await;
    // A request that is longer than its function's.
    client.send(&[0, 7, 0, 0, 0, 7, 1, 3, 0, 0, 0, 1, 0]).await;
    client.expect(&refused(7, 3, 3)).await;
    // Nothing was written, and the connection still works.
    client.send(&[0, 8, 0, 0, 0, 6, 1, 1, 0, 192, 0, 8]).await;
    client.expect(&[0, 8, 0, 0, 0, 4, 1, 1, 1, 0]).await;
}

#[tokio::test]
async fn what_is_no_modbus_closes_the_connection() {
    let robot = Robot::start();
    for header in [
        [0, 1, 0, 1, 0, 6, 1, 3],
        [0, 1, 1, 0, 0, 6, 1, 3],
        [0, 1, 0, 0, 0, 1, 1, 3],
        [0, 1, 0, 0, 0, 0, 1, 3],
        [0, 1, 0, 0, 0, 255, 1, 3],
        [0, 1, 0, 0, 255, 255, 1, 3],
    ] {
        let mut client = robot.raw().await;
        client.send(&header).await;
        client.expect_closed().await;
    }
    assert!(answer(robot.client().await.read_coils(0, 1)).await.is_ok(), "others are not disturbed");
}

#[tokio::test]
async fn any_unit_is_answered_with_its_own_id() {
    let robot = Robot::start();
    let mut client = robot.client().await;
    for unit in 0..=255 {
        client.set_slave(Slave(unit));
        // The client itself compares the unit of the answer with that of its request.
        assert_eq!(answer(client.read_holding_registers(1, 1)).await, Ok(vec![6]), "unit {unit}");
    }
}

#[tokio::test]
async fn requests_cut_at_every_byte_and_run_together() {
    let robot = Robot::start();
    let mut client = robot.raw().await;
    let request = [0x12, 0x34, 0, 0, 0, 6, 9, 3, 0, 0, 0, 4];
    let response = [0x12, 0x34, 0, 0, 0, 11, 9, 3, 8, 0, 2, 0, 6, 0, 0, 0, 5];
    for cut in 1..request.len() {
        client.send(&request[..cut]).await;
        client.send(&request[cut..]).await;
        client.expect(&response).await;
    }
    client.send(&request.repeat(20)).await;
    client.expect(&response.repeat(20)).await;
}

#[tokio::test]
async fn a_multiple_write_is_seen_whole_or_not_at_all() {
    let robot = Robot::start();
    let (mut writer, mut reader) = (robot.client().await, robot.client().await);
    let writes = async {
        for round in 0..400_u16 {
            answer(writer.write_multiple_registers(8, &[round; 32])).await.unwrap();
        }
    };
    let reads = async {
        let mut seen = 0;
        while seen < 399 {
            let words = answer(reader.read_holding_registers(8, 32)).await.unwrap();
            assert!(words.iter().all(|word| *word == words[0]), "a torn write: {words:?}");
            assert!(words[0] >= seen, "{} after {seen}", words[0]);
            seen = words[0];
        }
    };
    timeout(PATIENCE, async { tokio::join!(writes, reads) }).await.expect("done in time");
}

#[tokio::test]
async fn many_clients_at_once() {
    let robot = Robot::start();
    let mut clients = Vec::new();
    for _ in 0..32 {
        clients.push(robot.client().await);
    }
    let tasks: Vec<_> = (0_u16..)
        .zip(clients)
        .map(|(nth, mut client)| {
            tokio::spawn(async move {
                for value in 0..20 {
                    answer(client.write_single_register(8 + nth, value)).await.unwrap();
                    assert_eq!(answer(client.read_holding_registers(8 + nth, 1)).await, Ok(vec![value]));
                }
            })
        })
        .collect();
    for task in tasks {
        task.await.unwrap();
    }
}
