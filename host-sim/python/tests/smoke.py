"""A controller without pytest or anything else that would have to be installed: starts, obeys, ends.

    python smoke.py [DEVICE]

DEVICE is what serial ports are bound to, `pty` if not said otherwise.
"""

import sys

import duco_sim

device = sys.argv[1] if len(sys.argv) > 1 else "pty"
with duco_sim.Controller(time="stepped", ports={"rs485": device}) as robot:
    robot.power = "off"
    assert robot.command("poweron") == "poweron success"
    assert robot.command("enable") == "enable success"
    robot.di[1] = True
    assert robot.command("run(pick.jspf)") == "run start"
    run = robot.finish()
    assert run.outcome == "finished", run
    print(f"{duco_sim.__version__}: ready after {robot.start_s:.3f} s; {run}")
with duco_sim.Gateway(set={"controller.ports.command": 1}, ports={"rs485-1": device}) as gateway:
    print(f"the gateway was ready after {gateway.start_s:.3f} s; ports: {sorted(gateway.stats()['ports'])}")
