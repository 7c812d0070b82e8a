"""The controller's UDP 2011 server and its TCP and UDP clients: worked examples 5 and 6."""

import socket

from cell import (
    PATIENCE, POSE_BYTES, Modbus, Stream, case, check, controller, equal, find_frame, initial_pose, until,
)

FRAME = b"\xff\xff" + POSE_BYTES + b"\xfe\xfe"
SWITCH_ON = bytes.fromhex("FF FF 01 EE EE")
SWITCH_OFF = bytes.fromhex("FF FF 00 EE EE")


def datagram_socket():
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.settimeout(PATIENCE)
    return client


@case("worked example 5: UDP 2011 streams to whoever sent a datagram, and takes frames")
def example_5():
    with controller("udp-server-controller.toml", initial_pose()) as robot, Modbus(robot) as modbus:
        server = robot.address("udp2011")
        with datagram_socket() as client, datagram_socket() as other:
            client.sendto(b"anything", server)
            for _ in range(25):
                equal(client.recv(2048), FRAME, "a datagram")
            client.sendto(SWITCH_ON, server)
            modbus.until_coil(192, True)
            # A datagram is a frame: one with something more is none.
            other.sendto(SWITCH_OFF + b"\0", server)
            equal(other.recv(2048), FRAME, "a datagram to a second client")
            check(modbus.coil(192), "a datagram that is too long was applied")
            other.sendto(SWITCH_OFF, server)
            modbus.until_coil(192, False)
            equal(client.recv(2048), FRAME, "the first client's stream after that")


@case("UDP 2011 stops streaming to a client that is gone, and takes a new one")
def client_gone():
    with controller("udp-server-controller.toml", initial_pose()) as robot:
        server = robot.address("udp2011")
        with datagram_socket() as client:
            client.sendto(b"x", server)
            client.recv(2048)
        with datagram_socket() as client:
            client.sendto(b"x", server)
            for _ in range(10):
                equal(client.recv(2048), FRAME, "a datagram")


@case("worked example 6: the controller's TCP client connects, streams, takes frames, reconnects")
def example_6_tcp():
    with socket.create_server(("127.0.0.1", 0)) as listener, datagram_socket() as other:
        listener.settimeout(PATIENCE)
        sets = [
            *initial_pose(),
            f"port.tcp1.to=127.0.0.1:{listener.getsockname()[1]}",
            f"port.udp1.to=127.0.0.1:{other.getsockname()[1]}",
        ]
        with controller("client-controller.toml", sets) as robot, Modbus(robot) as modbus:
            for value in (1, 2):
                with Stream(None, listener.accept()[0]) as stream:
                    equal(find_frame(stream.read, 28, b"\xff\xff", b"\xfe\xfe"), POSE_BYTES, "the pose")
                    stream.expect(FRAME * 10, "ten cycles one behind the other")
                    stream.send(bytes([0xFF, 0xFF]))
                    stream.send(bytes([value, 0xEE, 0xEE]))
                    modbus.until_coil(191 + value, True)


@case("worked example 6: the controller's UDP client streams and takes frames")
def example_6_udp():
    with datagram_socket() as client, socket.create_server(("127.0.0.1", 0)) as unused:
        sets = [
            *initial_pose(),
            f"port.tcp1.to=127.0.0.1:{unused.getsockname()[1]}",
            f"port.udp1.to=127.0.0.1:{client.getsockname()[1]}",
        ]
        with controller("client-controller.toml", sets) as robot, Modbus(robot) as modbus:
            for _ in range(10):
                data, sender = client.recvfrom(2048)
                equal(data, FRAME, "a datagram")
            client.sendto(SWITCH_ON, sender)
            modbus.until_coil(192, True)
            client.sendto(SWITCH_OFF, sender)
            modbus.until_coil(192, False)


@case("the controller's TCP client finds a listener that comes late")
def late_listener():
    with socket.socket() as listener, datagram_socket() as other:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(PATIENCE)
        sets = [
            f"port.tcp1.to=127.0.0.1:{listener.getsockname()[1]}",
            f"port.udp1.to=127.0.0.1:{other.getsockname()[1]}",
        ]
        with controller("client-controller.toml", sets) as robot:
            until("statistics", lambda: robot.stats)
            listener.listen()
            with Stream(None, listener.accept()[0]) as stream:
                find_frame(stream.read, 28, b"\xff\xff", b"\xfe\xfe")
