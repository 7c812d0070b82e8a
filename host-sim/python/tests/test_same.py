"""Repeated runs with a stepped clock are the same, byte for byte."""

import os
import socket

import clients

import duco_sim

#: More of them by hand: DUCO_SIM_RUNS=1000.
RUNS = int(os.environ.get("DUCO_SIM_RUNS", "30"))


def one_run(seed):
    """A run with all that can happen in one: commands, Modbus, a device, a fault, a stop."""
    with duco_sim.Controller(time="stepped", seed=seed) as robot:

        @robot.device("rs485")
        def scale(request):
            return b"\xff\xff\x2a\x00\xee\xee"

        with (
            socket.create_connection(robot.state_address, timeout=10) as stream,
            clients.Modbus(robot.modbus_address) as modbus,
        ):
            robot.advance(0.25)
            modbus.write_register(8, 1)
            robot.command("run(weigh.jspf)")
            robot.finish()
            robot.di[1] = True
            with robot.fault("command", delay=0.2):
                robot.command("run(pick.jspf)")
            robot.wait(items={"DO[1]": 1})
            robot.estop()
            robot.finish()
            robot.clear()
            robot.wait(safety="run")
            with robot.fault("state", garbage=True):
                robot.advance(0.3)
            robot.command("enable")
            packets = clients.receive(stream, clients.PACKET_BYTES * 5)
        robot.advance(0)
        return robot.event_log(), packets


def test_runs_with_one_seed_are_the_same():
    logs, packets = one_run(7)
    assert logs.count("\n") > 20
    for nth in range(1, RUNS):
        again = one_run(7)
        assert again[0] == logs, f"run {nth} has another log"
        assert again[1] == packets, f"run {nth} has other packets"
