"""The controller's CAN port with python-can's slcan interface: worked examples 3 and 4."""

import struct
import time

import can

from cell import PATIENCE, POSE, Command, Failed, Modbus, case, check, controller, equal, initial_pose, until

TCP = {"can": "slcan-tcp:127.0.0.1:0"}
PTY = {"can": "slcan-pty:can"}


def join(running, name="can", bitrate=500000):
    """A client of the port's bus, by TCP or on a pseudoterminal."""
    place = running.device(name)
    channel = place if place.startswith("/") else f"socket://{place}"
    return can.Bus(interface="slcan", channel=channel, bitrate=bitrate, sleep_after_open=0)


def joined(bus, others, frame):
    """Waits until a client hears the bus: the adapter's answers are no frames."""

    def heard():
        others.send(frame)
        return bus.recv(0.2)

    until("a frame from another client", heard)


def frame(identifier, data, **kind):
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False, **kind)


def receive(bus, identifier):
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        message = bus.recv(1)
        if message and message.arbitration_id == identifier:
            return message
    raise Failed(f"no frame with id {identifier:#x} within {PATIENCE:.0f} s")


def example_3(binds):
    with controller("can-user-controller.toml", binds=binds) as robot, Command(robot) as client:
        with join(robot) as bus:
            client.start("echo.jspf")
            bus.send(frame(7, [9]))
            bus.send(frame(1, [1, 2]))
            bus.send(frame(1, [1, 2, 3]))
            answer = receive(bus, 2)
            equal(bytes(answer.data), bytes([0x7D, 0x7D, 0x7D]), "the program's frame with id 2")
            check(not answer.is_extended_id and not answer.is_remote_frame, "it is a standard data frame")
            robot.until_stats("list1 = {1,1,2,3}", lambda stats: stats["variables"]["list1"] == [1, 1, 2, 3])


@case("worked example 3 on the controller's CAN port: python-can over TCP")
def example_3_tcp():
    example_3(TCP)


@case("worked example 3 on the controller's CAN port: python-can on a pseudoterminal")
def example_3_pty():
    example_3(PTY)


def example_4(binds):
    sets = initial_pose() + ["initial.RobotState[8]=0.46744486689567566", "initial.RobotState[9]=0.4099704921245575"]
    with controller("can-system-controller.toml", sets, binds) as robot, Modbus(robot) as modbus:
        with join(robot) as bus:
            receive(bus, 4)
            for _ in range(5):
                cycle = [bus.recv(PATIENCE) for _ in range(3)]
                equal([message.arbitration_id for message in cycle], [2, 3, 4], "the ids of a cycle")
                equal(bytes(cycle[0].data), bytes.fromhex("EF 54 EF 3E A7 E7 D1 3E"), "the frame with id 2")
                equal(bytes(cycle[1].data), struct.pack("<2f", *POSE[2:4]), "the frame with id 3")
                equal(bytes(cycle[2].data), struct.pack("<2f", *POSE[4:6]), "the frame with id 4")
            check(not modbus.coil(192), "DO1 is on before anything was sent")
            bus.send(frame(1, [1]))
            modbus.until_coil(192, True)
            bus.send(frame(1, [0]))
            modbus.until_coil(192, False)


@case("worked example 4 on the controller's CAN port: python-can over TCP")
def example_4_tcp():
    example_4(TCP)


@case("worked example 4 on the controller's CAN port: python-can on a pseudoterminal")
def example_4_pty():
    example_4(PTY)


@case("frames that are not in the recipe, remote frames, wrong lengths: counted, nothing applied")
def refused_frames():
    with controller("can-system-controller.toml", binds=TCP) as robot, Modbus(robot) as modbus:
        with join(robot) as bus:
            bus.send(frame(0x7FF, [1]))
            bus.send(frame(1, [], is_remote_frame=True))
            bus.send(frame(1, [1, 1]))
            bus.send(can.Message(arbitration_id=1, data=[1], is_extended_id=True))
            bus.send(frame(1, [4]))
            modbus.until_coil(194, True)
            check(not modbus.coil(192), "DO1 was switched by a frame that is not in the recipe")


@case("three python-can clients make one bus")
def one_bus():
    with controller("can-user-controller.toml", binds=TCP) as robot:
        with join(robot) as one, join(robot) as two, join(robot) as three:
            joined(two, one, frame(0x100, [1]))
            joined(three, one, frame(0x100, [1]))
            joined(one, two, frame(0x101, [1]))
            one.send(can.Message(arbitration_id=0x1ABCDEF0, data=bytes(range(8)), is_extended_id=True))
            for bus in (two, three):
                message = receive(bus, 0x1ABCDEF0)
                equal(bytes(message.data), bytes(range(8)), "the data of an extended frame")
                check(message.is_extended_id, "the frame is extended")
            two.send(frame(0x102, [2]))
            receive(one, 0x102)
            receive(three, 0x102)
            one.send(frame(0x103, [3]))
            equal(receive(three, 0x103).arbitration_id, 0x103, "the bus after all that")
