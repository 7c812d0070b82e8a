"""A controller without pytest or anything else that would have to be installed: starts, obeys, ends."""

import duco_sim

with duco_sim.Controller(time="stepped") as robot:
    robot.power = "off"
    assert robot.command("poweron") == "poweron success"
    assert robot.command("enable") == "enable success"
    robot.di[1] = True
    assert robot.command("run(pick.jspf)") == "run start"
    run = robot.finish()
    assert run.outcome == "finished", run
    print(f"{duco_sim.__version__}: ready after {robot.start_s:.3f} s; {run}")
with duco_sim.Gateway(set={"controller.ports.command": 1}) as gateway:
    print(f"the gateway was ready after {gateway.start_s:.3f} s; ports: {sorted(gateway.stats()['ports'])}")
