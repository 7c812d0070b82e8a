"""The start, the end, items and time of a controller."""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

import duco_sim


def test_nothing_is_left_behind():
    with duco_sim.Controller() as robot:
        folder, pid = robot.folder, robot.pid
        assert folder.is_dir() and robot.port("rs485").path.exists()
        assert robot.start_s < 10
        with socket.create_connection(robot.command_address, timeout=5):
            pass
    assert not folder.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    robot.close()
    with pytest.raises(duco_sim.DucoSimError, match="was closed"):
        robot.state


def test_a_wrong_file_says_where(tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    path = tmp_path / "robot.toml"
    path.write_text("[robot]\npower = 3\n")
    with pytest.raises(duco_sim.ProcessError, match=r"robot\.toml:2:9"):
        duco_sim.Controller(path)
    with pytest.raises(duco_sim.ProcessError, match="cannot be read"):
        duco_sim.Controller(tmp_path / "none.toml")
    with pytest.raises(TypeError, match="timeline"):
        duco_sim.Controller(timeline=[{"at_s": None}])
    assert list(temporary.iterdir()) == []


def test_a_file_by_path_and_by_text(tmp_path):
    text = '[robot]\npower = "off"\n[listen]\ncommand = 2000\n'
    path = tmp_path / "robot.toml"
    path.write_text(text)
    for config in (path, str(path), text):
        with duco_sim.Controller(config) as robot:
            assert robot.power == "off"
            assert robot.command_address.port != 2000
            assert robot.programs() == []
    with duco_sim.Controller("", set={"robot.mode": "manual"}) as robot:
        assert robot.mode == "manual"


def test_a_program_that_is_killed_is_told():
    robot = duco_sim.Controller()
    os.kill(robot.pid, signal.SIGKILL)
    with pytest.raises(duco_sim.ProcessError):
        robot.state
    with pytest.raises(duco_sim.ProcessError, match="SIGKILL"):
        robot.close()
    assert not robot.folder.exists()


def test_shutdown_is_no_failure():
    with duco_sim.Controller() as robot:
        robot.power = "off"
        assert robot.command("shutdown") == "shutdown success"
        assert wait_for_end(robot.pid)


def test_it_ends_with_a_killed_test():
    code = """
import duco_sim, os, signal
robot = duco_sim.Controller()
print(robot.pid, robot.folder, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split()
    assert wait_for_end(int(printed[0]))


def test_it_ends_with_an_interpreter_that_forgot_it():
    code = "import duco_sim; robot = duco_sim.Controller(); print(robot.pid, robot.folder)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert wait_for_end(int(printed[0]), 0)
    assert not pathlib.Path(printed[1]).exists()


def wait_for_end(pid, seconds=10.0):
    deadline = time.monotonic() + seconds
    while True:
        try:
            # A child that nobody has waited for yet is over too.
            if pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)


@pytest.mark.duco(time="stepped")
class TestItems:
    def test_by_group(self, duco_controller):
        robot = duco_controller
        robot.di[3] = True
        robot.tool_di[2] = True
        robot.word_input[2] = 65535
        robot.float_input[32] = 1.5
        robot.ai_v[1] = 2.5
        robot.ai_ma[4] = 20.0
        assert (robot.di[3], robot.di[4], robot.do[1]) == (True, False, False)
        assert robot.di.values() == [nth == 3 for nth in range(1, 17)]
        assert list(robot.tool_di) == [False, True] and len(robot.tool_di) == 2
        assert (robot.word_input[2], robot.float_input[32], robot.ai_v[1], robot.ai_ma[4]) == (65535, 1.5, 2.5, 20.0)

    def test_by_name(self, duco_controller):
        duco_controller["BitInputReg[3].4"] = True
        assert duco_controller["BitInputReg[3].4"] == 1
        assert duco_controller["BitInputReg[3]"] == 16
        assert duco_controller.get(["DI[1]", "RobotState[8]"]).keys() == {"DI[1]", "RobotState[8]"}

    def test_what_does_not_exist(self, duco_controller):
        for index in (0, 17, -1):
            with pytest.raises(IndexError, match=r"DI\[1\.\.16\]"):
                duco_controller.di[index]
        with pytest.raises(duco_sim.Refused, match="ToolDI"):
            duco_controller["ToolDI[3]"]
        with pytest.raises(duco_sim.Refused):
            duco_controller.word_input[1] = 65536

    def test_all_or_none(self, duco_controller):
        with pytest.raises(duco_sim.Refused):
            duco_controller.set({"DI[1]": 1, "WordInputReg[1]": 70000})
        assert not duco_controller.di[1]


@pytest.mark.duco(time="stepped")
class TestTime:
    def test_it_stands(self, duco_controller):
        before = duco_controller.time_s
        time.sleep(0.05)
        assert duco_controller.time_s == before
        duco_controller.advance(0.4)
        assert duco_controller.time_s - before == pytest.approx(0.4, abs=1e-6)

    def test_waiting_says_what_is_the_case(self, duco_controller):
        with pytest.raises(duco_sim.WaitTimeout, match="enable"):
            duco_controller.wait(robot="power_off", timeout=2)
        assert duco_controller.time_s >= 2
        with pytest.raises(duco_sim.Refused) as raised:
            duco_controller.wait(robot="enabled")
        assert not isinstance(raised.value, duco_sim.WaitTimeout)
        with pytest.raises(ValueError, match="program_state"):
            duco_controller.wait(program="running")

    def test_an_event_that_has_come_before(self, duco_controller):
        robot = duco_controller
        mark = robot.mark()
        robot.di[2] = True
        robot.wait(event={"event": "write", "item": "DI[2]"}, since=mark)
        with pytest.raises(duco_sim.WaitTimeout):
            robot.wait(event={"event": "write", "item": "DI[2]"}, timeout=0.1)
        with pytest.raises(duco_sim.WaitTimeout):
            robot.wait(event="error", since=mark, timeout=0.1)

    def test_other_conditions(self, duco_controller):
        robot = duco_controller
        robot.di[1] = True
        robot.wait(coil={176: True}, register={0: 2}, mode="remote", safety="run", program=None, timeout=0)
        robot.run("pick.jspf")
        robot.wait(program="pick.jspf", program_state="running")
        robot.pause()
        robot.wait(program_state="paused")
        robot.resume()
        assert robot.finish().outcome == "finished"

    def test_power(self, duco_controller):
        robot = duco_controller
        for power in ("off", "on", "enabled", "on", "off", "enabled", "enabled", "off"):
            robot.power = power
            assert robot.power == power
        with pytest.raises(ValueError):
            robot.power = "yes"

    def test_every_command_at_its_instant(self, duco_controller):
        robot = duco_controller
        times = []
        for command in ("state", "isprogfinish", "disable", "enable", "speed(50)", "fly(me)"):
            times.append((robot.command(command), round(robot.time_s, 3)))
        assert times == [
            ("6:0:5:2", 0.0),
            ("1", 0.0),
            ("disable success", 0.1),
            ("enable success", 0.3),
            ("set success", 0.3),
            ("unknown command", 0.3),
        ]


def test_time_that_runs_faster():
    with duco_sim.Controller(time="factor=50") as robot:
        robot.power = "off"
        began = time.monotonic()
        assert robot.command("poweron") == "poweron success"
        robot.advance(5.0)
        assert time.monotonic() - began < 4
        assert robot.time_s > 5.3


def test_a_wrong_time():
    for wrong in ("fast", "factor=0", "factor=", "factor=x"):
        with pytest.raises(ValueError, match="allowed"):
            duco_sim.Controller(time=wrong)


def test_something_happens_meanwhile():
    with duco_sim.Controller(time="factor=20") as robot:
        robot.upload("long.jspf", 'set("DO[1]", 1); wait_ms(600000);')
        robot.when(robot.estop, items={"DO[1]": 1}, after=0.05)
        assert robot.command("run(long.jspf)") == "run start"
        assert robot.finish(timeout=700).reason == "emergency_stop"


def test_what_never_happens_is_told():
    robot = duco_sim.Controller(time="factor=20")
    robot.when(robot.estop, items={"DO[1]": 1})
    with pytest.raises(duco_sim.DucoSimError, match=r"DO\[1\]"):
        robot.close()


def test_threads_do_not_hold_up_each_other():
    with duco_sim.Controller() as robot:
        threads = [
            threading.Thread(target=lambda nth=nth: robot.wait(items={f"DI[{nth}]": 1}, timeout=30))
            for nth in range(1, 9)
        ]
        for thread in threads:
            thread.start()
        for nth in range(1, 9):
            robot.di[nth] = True
        for thread in threads:
            thread.join(20)
            assert not thread.is_alive()


def test_events_are_kept_and_written():
    with duco_sim.Controller(time="stepped") as robot:
        robot.di[1] = True
        robot.advance(0.1)
        events = robot.events()
        assert [event.n for event in events] == list(range(1, len(events) + 1))
        assert events.next == robot.mark() == len(events) + 1 and events.lost == 0
        assert [event.event for event in events] == ["started", "operation", "write"]
        assert (events[1]["do"], events[2]["item"], events[2].get("value")) == ("set", "DI[1]", 1)
        lines = robot.event_log().splitlines()
        assert [json.loads(line)["n"] for line in lines] == [event.n for event in events]
