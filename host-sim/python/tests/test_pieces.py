"""What needs no running controller."""

import pathlib

import pytest

import duco_sim
from duco_sim import process, timeline


def test_the_ports_of_a_file():
    text = """
[robot]
name = "no port"
[[ port ]]   # a comment
name = "a"
bus = 'rs485'
[[port]]
bus = "can"
name = "b"
[port.inner]
bus = "tcp-client"
[[port]]
name = "without a bus"
"""
    assert process._buses_by_line(text) == {"a": "rs485", "b": "can"}
    for file in (duco_sim.CONTROLLER_FILE, duco_sim.GATEWAY_FILE):
        assert process._buses_by_line(file) == process.buses(file) != {}
    assert process.buses("[[port]]\nname = 1") == {}


def test_what_ports_are_bound_to():
    folder = pathlib.Path("/f")
    buses = {"a": "rs485", "b": "can", "c": "tcp-client", "d": "rs485"}
    bound = process.binds({"d": "serial:/dev/ttyUSB0", "b": "slcan-unpaced"}, buses, folder)
    assert bound == {"a": "pty:/f/a", "b": "slcan-tcp-unpaced:127.0.0.1:0", "d": "serial:/dev/ttyUSB0"}


def test_settings():
    arguments = process.settings({"robot.power": "off", "a": 1, "b": True})
    assert arguments == ["--set", 'robot.power="off"', "--set", "a=1", "--set", "b=true"]


def test_a_timeline_of_steps(tmp_path):
    steps = [{"at_s": 0.5, "do": "set", "items": {"DI[3]": True}}, {"when": {"program": 'a"b'}, "do": "clear"}]
    path = pathlib.Path(timeline.timeline_file(steps, tmp_path))
    tomllib = pytest.importorskip("tomllib")
    assert tomllib.loads(path.read_text()) == {"step": steps}
    assert timeline.timeline_file(path, tmp_path) == timeline.timeline_file(str(path), tmp_path) == str(path)
    with pytest.raises(TypeError):
        timeline.timeline_file([{"at_s": None}], tmp_path)


def test_addresses():
    assert duco_sim.Address.parse("127.0.0.1:2000") == ("127.0.0.1", 2000)
    assert duco_sim.Address.parse("[::1]:1") == ("::1", 1)
    assert str(duco_sim.Address("::1", 1)) == "[::1]:1"
    for wrong in ("", "2000", "host:", "host:x"):
        with pytest.raises(ValueError):
            duco_sim.Address.parse(wrong)


def test_one_kind_of_fault_at_a_time():
    from duco_sim.faults import of_server

    assert of_server(False, 0.5, False, False, False, None, False, None) == {"kind": "delay", "seconds": 0.5}
    with pytest.raises(ValueError, match="none"):
        of_server(False, None, False, False, False, None, False, None)
    with pytest.raises(ValueError, match="mute, delay"):
        of_server(True, 0.5, False, False, False, None, False, None)


def test_a_program_that_is_none(monkeypatch, tmp_path):
    monkeypatch.setenv("DUCO_SIM_HOST_SIM", str(tmp_path / "none"))
    with pytest.raises(duco_sim.DucoSimError, match="DUCO_SIM_HOST_SIM"):
        duco_sim.host_sim()
