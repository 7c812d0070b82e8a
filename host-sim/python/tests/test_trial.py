"""What somebody who tests robot code asks for first: a test for each."""

import socket
import struct

import clients
import pytest

import duco_sim

pytestmark = pytest.mark.duco(time="stepped")

# Waits for DI1, works for a second, and reports.
WORK = """
while !get("DI[1]") { wait_ms(10); }
set("DO[1]", 1);
wait_ms(1000);
set("WordOutputReg[1]", 7);
"""


@pytest.fixture
def robot(duco_controller):
    duco_controller.upload("work.jspf", WORK)
    return duco_controller


def test_emergency_stop(robot):
    robot.di[1] = True
    assert robot.command("run(work.jspf)") == "run start"
    robot.wait(items={"DO[1]": 1})
    robot.estop()
    assert robot.finish().reason == "emergency_stop"
    robot.wait(safety="stop0", robot="disable")
    assert robot.command("enable") == "enable fail"
    robot.clear()
    robot.wait(safety="run")
    assert robot.command("enable") == "enable success"


def test_input_changes_during_a_run(robot):
    robot.run("work.jspf")
    robot.advance(2.0)
    assert robot.state.program == "work.jspf" and not robot.do[1], "it waits"
    robot.di[1] = True
    robot.wait(items={"DO[1]": 1}, timeout=0.1)
    assert robot.finish().outcome == "finished"
    assert robot.word_output[1] == 7


def test_input_changes_by_a_timeline(duco_controller_factory):
    when = {"when": {"program": "work.jspf"}, "after_s": 0.5, "do": "set", "items": {"DI[1]": 1}}
    robot = duco_controller_factory(timeline=[when])
    robot.upload("work.jspf", WORK)
    robot.run("work.jspf")
    run = robot.finish()
    assert run.outcome == "finished"
    assert 1.5 <= run.ended_s - run.started_s <= 1.6


def test_fault_heals_after_the_block(robot):
    with robot.fault("command", mute=True):
        assert robot.state.faults == ({"server": "command", "kind": "mute"},)
        with pytest.raises(TimeoutError):
            robot.command("state", timeout=1.0)
    assert robot.state.faults == ()
    assert robot.command("state") == "6:0:5:2"


def test_fault_alone_heals(robot):
    slow = robot.fault("modbus", delay=0.5)
    robot.fault("modbus", exception=6)
    slow.heal()
    assert [fault["kind"] for fault in robot.state.faults] == ["exception"]
    robot.heal("modbus")
    assert robot.state.faults == ()


def test_mode_switch(robot):
    robot.mode = "manual"
    assert robot.mode == "manual"
    assert robot.command("run(work.jspf)") == "run fail"
    assert robot.command("state").endswith(":0")
    robot.mode = "remote"
    assert robot.command("run(work.jspf)") == "run start"


def test_how_a_program_ended(robot):
    robot.di[1] = True
    robot.run("work.jspf")
    run = robot.finish()
    assert (run.outcome, run.reason, run.line) == ("finished", None, None)
    assert run.ended_s - run.started_s == pytest.approx(1.0, abs=0.01)

    robot.upload("fails.jspf", 'log("so far");\nthrow "no part";')
    robot.run("fails.jspf")
    run = robot.finish()
    assert (run.outcome, run.line) == ("failed", 2)
    assert "no part" in run.reason
    assert robot.state.log == ("so far",)

    robot.run("work.jspf")
    assert robot.command("stop") == "stop success"
    assert (robot.last_run.outcome, robot.last_run.reason) == ("stopped", "stop")
    assert [event["outcome"] for event in robot.events("program_ended")] == ["finished", "failed", "stopped"]


def test_restart_with_boot(robot):
    robot.word_input[3] = 5
    mark = robot.mark()
    robot.restart()
    assert robot.word_input[3] == 0, "the file's initial value"
    states = [event["state"] for event in robot.events("robot", since=mark)]
    assert states == ["start", "initialize", "logout", "login", "power_off"]
    assert robot.power == "off"
    assert robot.command("poweron") == "poweron success"
    robot.power = "enabled"
    assert robot.state.robot == "enable"


def test_error_raised_and_cleared(robot):
    robot.raise_error(0x4711, "gripper: no air")
    assert robot.state.error == duco_sim.ShownError(0x4711, "gripper: no air")
    assert robot.command("getlasterror") == "4711:gripper: no air"
    robot.clear_error()
    assert robot.state.error is None
    assert [event.event for event in robot.events("error", "error_cleared")] == ["error", "error_cleared"]


def test_slow_replies(robot):
    before = robot.time_s
    with robot.fault("command", delay=0.5):
        assert robot.command("state") == "6:0:5:2"
    assert robot.time_s - before == pytest.approx(0.5, abs=0.05)
    before = robot.time_s
    assert robot.command("state") == "6:0:5:2"
    assert robot.time_s - before < 0.05


def test_disconnect(robot):
    with socket.create_connection(robot.command_address, timeout=10) as connection:
        robot.advance(0.1)
        assert robot.state.clients["command"] == 1
        robot.fault("command", disconnect=True)
        assert connection.recv(100) == b""
    assert robot.command("state") == "6:0:5:2", "new connections are taken"


def test_modbus_exception(robot):
    with clients.Modbus(robot.modbus_address) as modbus:
        modbus.write_register(8, 42)
        assert robot.word_input[1] == 42
        with robot.fault("modbus", exception=4):
            with pytest.raises(clients.ModbusException) as raised:
                modbus.read_registers(8, 1)
            assert raised.value.code == 4
        assert modbus.read_registers(8, 1) == [42]
    (write,) = robot.events("write")
    assert (write["item"], write["value"], write["by"]) == ("WordInputReg[1]", 42, "modbus")


def test_frozen_state_stream(robot):
    with socket.create_connection(robot.state_address, timeout=10) as stream:

        def packet():
            robot.advance(0.1)
            return clients.receive(stream, clients.PACKET_BYTES)

        fresh = packet()
        assert not clients.digital_input(fresh, 5)
        with robot.fault("state", freeze=True):
            frozen = packet()
            robot.di[5] = True
            assert packet() == frozen
        assert clients.digital_input(packet(), 5)


def test_spoiled_item(robot):
    with socket.create_connection(robot.state_address, timeout=10) as stream:
        with robot.spoil("RobotState[8]", float("nan")):
            robot.advance(0.1)
            (x,) = struct.unpack_from("<f", clients.receive(stream, clients.PACKET_BYTES), 368)
            assert x != x
        robot.advance(0.1)
        (x,) = struct.unpack_from("<f", clients.receive(stream, clients.PACKET_BYTES), 368)
        assert x == x
