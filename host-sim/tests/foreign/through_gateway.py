"""The same field clients at a gateway's ports, with the controller behind it."""

import contextlib
import struct
import threading

import serial

from cell import (
    PATIENCE, POSE, POSE_BYTES, Command, Modbus, Program, Reserved, case, check, controller, equal, find_frame,
    gateway, initial_pose, link_is_up, state_packet, until,
)
from on_can import frame, join, receive

ROBOT_PORT = {"rs485": "pty:rs485"}
FIELD_PORT = {"rs485-1": "pty:rs485-1"}
CAN_PORT = {"can-1": "slcan-tcp:127.0.0.1:0"}
SWITCH_ON = bytes.fromhex("FF FF 01 EE EE")
SWITCH_OFF = bytes.fromhex("FF FF 00 EE EE")


def field(running, name="rs485-1"):
    return serial.Serial(running.device(name), baudrate=115200, timeout=PATIENCE)


def switches(port, modbus):
    """A frame switches DO1, another one switches it back."""
    check(not modbus.coil(192), "DO1 is on before anything was sent")
    port.write(SWITCH_ON)
    modbus.until_coil(192, True)
    port.write(SWITCH_OFF)
    modbus.until_coil(192, False)


@case("worked example 1 through the gateway: three bytes to registers, each frame answered")
def example_1():
    with controller("rs485-user-controller.toml", binds=ROBOT_PORT) as robot, Modbus(robot) as modbus:
        with gateway("rs485-user.toml", robot, binds=FIELD_PORT) as running, field(running) as port:
            link_is_up(running, "modbus")
            port.write(bytes.fromhex("FF FF 01 02 03 EE EE"))
            equal(port.read(7), bytes.fromhex("FF FF 7D 7D 7D FE FE"), "the answer")
            modbus.until_registers(8, [1, 2, 3])
            port.write(bytes.fromhex("FF FF 04 05 06 EE EE"))
            equal(port.read(7), bytes.fromhex("FF FF 7D 7D 7D FE FE"), "the second answer")
            modbus.until_registers(8, [4, 5, 6])


@case("worked example 2 through the gateway: pose each cycle, DO1")
def example_2():
    with controller("rs485-system-controller.toml", initial_pose(), ROBOT_PORT) as robot, Modbus(robot) as modbus:
        with gateway("rs485-system.toml", robot, binds=FIELD_PORT) as running, field(running) as port:
            pose = find_frame(port.read, 20, b"\xff\xff", b"\xfe\xfe")
            equal(pose, POSE_BYTES[:16], "RobotState[8..11]")
            equal(port.read(200), (b"\xff\xff" + pose + b"\xfe\xfe") * 10, "ten cycles one behind the other")
            link_is_up(running, "modbus")
            switches(port, modbus)


@case("worked example 3 through the gateway: id 1 to registers, each answered with id 2")
def example_3():
    with controller("rs485-system-controller.toml", binds=ROBOT_PORT) as robot, Modbus(robot) as modbus:
        with gateway("can-user.toml", robot, binds=CAN_PORT) as running, join(running, "can-1") as bus:
            link_is_up(running, "modbus")
            bus.send(frame(1, [1, 2, 3]))
            equal(bytes(receive(bus, 2).data), bytes([0x7D, 0x7D, 0x7D]), "the answer")
            modbus.until_registers(8, [1, 2, 3])


@case("worked example 4 through the gateway: pose in three frames each cycle, DO1")
def example_4():
    sets = initial_pose() + ["initial.RobotState[8]=0.46744486689567566", "initial.RobotState[9]=0.4099704921245575"]
    with controller("rs485-system-controller.toml", sets, ROBOT_PORT) as robot, Modbus(robot) as modbus:
        with gateway("can-system.toml", robot, binds=CAN_PORT) as running, join(running, "can-1") as bus:
            receive(bus, 4)
            cycle = [bus.recv(PATIENCE) for _ in range(3)]
            equal([message.arbitration_id for message in cycle], [2, 3, 4], "the ids of a cycle")
            equal(bytes(cycle[0].data), bytes.fromhex("EF 54 EF 3E A7 E7 D1 3E"), "the frame with id 2")
            equal(bytes(cycle[2].data), struct.pack("<2f", *POSE[4:6]), "the frame with id 4")
            link_is_up(running, "modbus")
            bus.send(frame(1, [1]))
            modbus.until_coil(192, True)
            bus.send(frame(1, [0]))
            modbus.until_coil(192, False)


@case("worked example 5 through the gateway: both ways over the controller's UDP 2011 server")
def example_5():
    with controller("udp-server-controller.toml", initial_pose()) as robot, Modbus(robot) as modbus:
        sets = [f"controller.recipe_link.udp={robot.address('udp2011')[1]}"]
        with gateway("udp-server.toml", robot, sets, FIELD_PORT) as running, field(running) as port:
            pose = find_frame(port.read, 28, b"\xff\xff", b"\xfe\xfe")
            equal(pose, POSE_BYTES, "RobotState[8..13]")
            link_is_up(running, "udp2011")
            switches(port, modbus)
            equal([name for name in running.stats["links"] if name == "modbus"], [], "links that nothing needs")


@contextlib.contextmanager
def gateway_before_robot(link, sets=()):
    """A gateway that the controller's client connects to, so it has to be there first."""
    with Reserved() as command, Reserved() as state, Reserved() as server:
        names = {"command": command, "state": state, "modbus": server}
        ways = [f"controller.ports.{name}={port}" for name, port in names.items()]
        with Program("gateway", "client.toml", ["controller.address=127.0.0.1", *ways, *sets], FIELD_PORT) as running:
            host, port = running.address("up")
            other = "udp1" if link == "tcp1" else "tcp1"
            listens = [f"listen.{name}={port}" for name, port in names.items()]
            robot_sets = [*initial_pose(), "listen.udp2011=0", *listens, f"port.{link}.to={host}:{port}"]
            # Nobody is there for the other client; it goes on trying.
            robot_sets.append(f"port.{other}.to=127.0.0.1:9")
            with Program("controller", "client-controller.toml", robot_sets) as robot:
                yield running, robot


@case("worked example 6 through the gateway: the controller's TCP client carries both ways")
def example_6_tcp():
    with gateway_before_robot("tcp1", ["port.up.listen=127.0.0.1:0"]) as (running, robot):
        with Modbus(robot) as modbus, field(running) as port:
            equal(find_frame(port.read, 28, b"\xff\xff", b"\xfe\xfe"), POSE_BYTES, "RobotState[8..13]")
            link_is_up(running, "up")
            switches(port, modbus)


@case("worked example 6 through the gateway: the controller's UDP client carries both ways")
def example_6_udp():
    with gateway_before_robot("udp1", ["port.up.bus=udp-listen", "port.up.listen=127.0.0.1:0"]) as (running, robot):
        with Modbus(robot) as modbus, field(running) as port:
            equal(find_frame(port.read, 28, b"\xff\xff", b"\xfe\xfe"), POSE_BYTES, "RobotState[8..13]")
            link_is_up(running, "up")
            switches(port, modbus)


@case("a force sensor through the gateway: ForceEnd over UDP 2011, zero when it falls silent")
def force_sensor():
    forces = (1.5, -2.25, 30.0, 0.5, -0.75, 0.125)
    # The tool's frame is the flange's here, so the flange feels what the sensor measures.
    with controller("force-sensor-controller.toml") as robot:
        felt = lambda: struct.unpack_from("<6f", state_packet(robot), 440)
        sets = [f"controller.recipe_link.udp={robot.address('udp2011')[1]}"]
        with gateway("force-sensor.toml", robot, sets, {"force": "pty:force"}) as running:
            with field(running, "force") as port:
                link_is_up(running, "udp2011")
                with again_and_again(port, b"\x48\xaa" + struct.pack("<6f", *forces) + b"\x0d\x0a"):
                    until("the forces in the state stream", lambda: felt() == forces)
                until("no force after the sensor fell silent", lambda: felt() == (0.0,) * 6)


@contextlib.contextmanager
def again_and_again(port, sample):
    """Sends a sample every few milliseconds, as a sensor does."""
    done = threading.Event()

    def send():
        while not done.wait(0.002):
            port.write(sample)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        done.set()
        sender.join()


@case("a station that starts programs through the gateway: one order, one start, an answer each")
def station():
    with controller("request-response-controller.toml") as robot, Command(robot) as client:
        with gateway("request-response.toml", robot, binds={"station": "pty:station"}) as running:
            with serial.Serial(running.device("station"), baudrate=9600, timeout=PATIENCE) as port:
                link_is_up(running, "command", "modbus")

                def order(number, part):
                    port.write(b"\xff\xff" + struct.pack("<BH", number, part) + b"\xee\xee")
                    return find_frame(port.read, 7, b"\xff\xff", b"\xfe\xfe")

                first = order(0, 5)
                equal(first[1], 0, "the reply code before any command")
                order(1, 513)
                running.until_stats("run(pick.jspf) succeeded", lambda stats: stats["ports"]["station"]["reply"] == "success")
                with Modbus(robot) as modbus:
                    modbus.until_registers(8, [513])
                equal(order(0, 513)[1], 2, "the reply code: success")
                until("the program ended", lambda: finished(client))
                equal(order(9, 513)[1] in (1, 3), True, "the reply code of a stop: pending or fail")
                running.until_stats("stop failed", lambda stats: stats["ports"]["station"]["reply"] == "fail")
                equal(running.stats["ports"]["station"]["commands"], 2, "commands that were picked")


def finished(client):
    client.send(b"isprogfinish")
    return client.read(1) == b"1"


@case("the controller restarts: nothing stale is written, the next frame gets through")
def restart():
    with Reserved() as command, Reserved() as state, Reserved() as server:
        names = {"command": command, "state": state, "modbus": server}
        ways = [f"controller.ports.{name}={port}" for name, port in names.items()]
        listens = ["listen.udp2011=0", *(f"listen.{name}={port}" for name, port in names.items())]
        with Program("gateway", "rs485-system.toml", ["controller.address=127.0.0.1", *ways], FIELD_PORT) as running:
            with field(running) as port:
                for value in (1, 2):
                    with Program("controller", "rs485-system-controller.toml", listens, ROBOT_PORT) as robot:
                        link_is_up(running, "modbus")
                        with Modbus(robot) as modbus:
                            check(not modbus.coil(192), "a frame from before the restart was written")
                            port.write(bytes([0xFF, 0xFF, value, 0xEE, 0xEE]))
                            modbus.until_coil(191 + value, True)
                    running.until_stats("Modbus is down", lambda stats: stats["links"]["modbus"]["state"] != "up")
                    port.reset_input_buffer()
                    port.write(SWITCH_ON)
                    running.until_stats("a frame while it is down", lambda stats: stats["ports"]["rs485-1"]["undelivered"] >= value)
