"""The controller's RS-485 port on a pseudoterminal with pyserial: worked examples 1 and 2."""

import serial

from cell import (
    PATIENCE, POSE_BYTES, Command, Modbus, case, check, controller, equal, find_frame, initial_pose, show,
)


def open_port(robot, name="rs485"):
    return serial.Serial(robot.device(name), baudrate=115200, timeout=PATIENCE)


def expect(port, data, what):
    received = port.read(len(data))
    equal(received, data, what)


@case("worked example 1 on the controller's RS-485 port: user-defined frames, pyserial")
def example_1():
    with controller("rs485-user-controller.toml", binds={"rs485": "pty:rs485"}) as robot:
        with open_port(robot) as port, Command(robot) as client:
            client.start("echo.jspf")
            port.write(bytes.fromhex("FF FF 01 02 03 EE EE"))
            expect(port, bytes.fromhex("FF FF 7D 7D 7D FE FE"), "the program's answer")
            robot.until_stats("list1 = {1,2,3}", lambda stats: stats["variables"]["list1"] == [1, 2, 3])


@case("worked example 1 with the frame in single bytes, after garbage and half a frame")
def example_1_in_pieces():
    with controller("rs485-user-controller.toml", binds={"rs485": "pty:rs485"}) as robot:
        with open_port(robot) as port, Command(robot) as client:
            client.start("echo.jspf")
            for byte in bytes.fromhex("00 EE FF 12 FF FF 09 FF FF 01 02 03 EE EE"):
                port.write(bytes([byte]))
                port.flush()
            expect(port, bytes.fromhex("FF FF 7D 7D 7D FE FE"), "the program's answer")
            robot.until_stats("list1 = {1,2,3}", lambda stats: stats["variables"]["list1"] == [1, 2, 3])


@case("worked example 2 on the controller's RS-485 port: pose each cycle, DO1, pyserial")
def example_2():
    with controller("rs485-system-controller.toml", initial_pose(), {"rs485": "pty:rs485"}) as robot:
        with open_port(robot) as port, Modbus(robot) as modbus:
            pose = find_frame(port.read, 20, b"\xff\xff", b"\xfe\xfe")
            equal(pose, POSE_BYTES[:16], "RobotState[8..11]")
            expect(port, (b"\xff\xff" + pose + b"\xfe\xfe") * 10, "ten cycles one behind the other")
            check(not modbus.coil(192), "DO1 is on before anything was sent")
            port.write(bytes.fromhex("FF FF 01 EE EE"))
            modbus.until_coil(192, True)
            port.write(bytes.fromhex("FF FF 00 EE EE"))
            modbus.until_coil(192, False)
            wrong = bytes.fromhex("FF FF 02 EE EF")
            port.write(wrong + bytes.fromhex("FF FF 04 EE EE"))
            modbus.until_coil(194, True)
            check(not modbus.coil(193), f"{show(wrong)}, with a wrong tail, was applied")


@case("a device that is unplugged and plugged in again")
def replugged():
    with controller("rs485-system-controller.toml", binds={"rs485": "pty:rs485"}) as robot, Modbus(robot) as modbus:
        for value in (1, 2):
            with open_port(robot) as port:
                find_frame(port.read, 20, b"\xff\xff", b"\xfe\xfe")
                port.write(bytes([0xFF, 0xFF, value, 0xEE, 0xEE]))
                modbus.until_coil(191 + value, True)
