"""Recipe ports from the device's side."""

import socket

import pytest

import duco_sim

CAN = """
[[recipe]]
name = "hand"
kind = "can"
mode = "realtime"
[[recipe.input.frame]]
id = 0x123
fields = ["WordInputReg[1]"]
[[recipe.output.frame]]
id = 0x321
extended = true
fields = ["WordOutputReg[1]"]
[[port]]
name = "can"
bus = "can"
recipe = "hand"
cycle_ms = 20
"""


def test_a_serial_line_is_a_file():
    with duco_sim.Controller() as robot, robot.port("rs485").open(timeout=5) as line:
        robot.run("weigh.jspf")
        assert line.read(5) == b"\xff\xff\x01\xfe\xfe"
        assert line.write(b"\xff\xff\x2a\x00\xee\xee") == 6
        assert robot.finish().outcome == "finished"
        assert robot.word_output[2] == 42
        line.timeout = 0.05
        assert line.read(1) == b"" and line.read_some() == b"" and line.drain() == b""
        robot.run("weigh.jspf")
        line.timeout = 5
        assert line.read_until(b"\xff\x01") == b"\xff\xff\x01"
        assert line.read(2) == b"\xfe\xfe"


def test_a_serial_line_over_tcp():
    with duco_sim.Controller(ports={"rs485": "tcp"}) as robot:
        with pytest.raises(duco_sim.DucoSimError, match="pseudoterminal"):
            robot.port("rs485").path
        with robot.port("rs485").open(timeout=5) as line:
            robot.run("weigh.jspf")
            assert line.read(5) == b"\xff\xff\x01\xfe\xfe"
            line.write(b"\xff\xff\x2b\x00\xee\xee")
            robot.finish()
            assert robot.word_output[2] == 43


@pytest.mark.parametrize("time", ["real", "factor=20", "stepped"])
def test_a_device_that_answers(time):
    with duco_sim.Controller(time=time) as robot:

        @robot.device("rs485")
        def scale(request):
            return b"\xff\xff\x10\x27\xee\xee" if request == b"\xff\xff\x01\xfe\xfe" else None

        robot.run("weigh.jspf")
        assert robot.finish().outcome == "finished"
        assert robot.word_output[2] == 10000
        robot.upload("twice.jspf", 'comm_send("rs485", [2]); wait_ms(5000); comm_send("rs485", [3]);')
        robot.run("twice.jspf")
        robot.finish()
        robot.advance(1.0)
        requests = scale.wait_requests(3)
        assert requests == [b"\xff\xff%c\xfe\xfe" % command for command in (1, 2, 3)]
        assert scale.exchanges[1][1] is None


def test_a_device_of_a_class_of_its_own():
    class Scale(duco_sim.Device):
        def answer(self, request):
            return b"\xff\xff" + bytes([len(self.exchanges), 0]) + b"\xee\xee"

    with duco_sim.Controller(time="stepped") as robot:
        Scale(robot.port("rs485"), gap=0.02)
        for count in range(3):
            robot.run("weigh.jspf")
            assert robot.finish().ended_s >= 0.02
            assert robot.word_output[2] == count


@pytest.mark.parametrize("time", ["real", "stepped"])
def test_what_a_device_raises_is_told(time):
    robot = duco_sim.Controller(time=time)

    @robot.device("rs485")
    def broken(request):
        raise KeyError("no such command")

    robot.run("weigh.jspf")
    with pytest.raises(KeyError, match="no such command"):
        robot.advance(0.2)
        broken.wait_requests(1)
        robot.close()
    robot.close()


@pytest.mark.duco(config=CAN)
def test_can(duco_controller):
    robot = duco_controller
    with robot.port("can").open_can(timeout=5) as bus:
        assert bus.receive() == duco_sim.CanFrame(0x321, b"\x00\x00", extended=True)
        bus.send(duco_sim.CanFrame(0x123, b"\x34\x12"))
        robot.wait(items={"WordInputReg[1]": 0x1234})
        with pytest.raises(ValueError):
            duco_sim.CanFrame(0x800)
        with pytest.raises(ValueError):
            duco_sim.CanFrame(1, bytes(9))
        robot.fault_port("can", mute=True)
        robot.advance(0.1)
        bus.timeout = 0
        while bus.receive():
            pass
        bus.timeout = 0.2
        assert bus.receive() is None
    with pytest.raises(duco_sim.DucoSimError, match="CAN"):
        robot.port("can").open()


def test_udp_2011():
    with duco_sim.Controller() as robot, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.settimeout(5)
        device.sendto(b"\xff\xff\x05\x07\x00\xee\xee", robot.udp2011_address)
        robot.wait(items={"BitInputReg[3].0": 1, "BitInputReg[3].2": 1, "WordInputReg[32]": 7})
        frame = device.recv(100)
        assert (len(frame), frame[:2], frame[-2:]) == (2 + 12 + 2 + 2, b"\xff\xff", b"\xfe\xfe")
        assert robot.state.ports["udp2011"].frames_in == 1


def test_ports_that_do_not_exist():
    with duco_sim.Controller() as robot:
        with pytest.raises(duco_sim.DucoSimError, match="rs485"):
            robot.port("can")
    with pytest.raises(duco_sim.ProcessError, match="nowhere"):
        duco_sim.Controller(ports={"nowhere": "pty"})
