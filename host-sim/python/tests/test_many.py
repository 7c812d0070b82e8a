"""Many controllers at once: how long a start takes, and how much memory. Prints with ``-s``; judges no time."""

import concurrent.futures
import os
import pathlib
import statistics

#: Fewer on a small machine.
CONTROLLERS = int(os.environ.get("DUCO_SIM_CONTROLLERS", "200"))


def resident_kib(pid):
    lines = pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1])


def test_many_at_once(duco_controller_factory, record_property):
    alone = duco_controller_factory().start_s
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        robots = list(pool.map(lambda seed: duco_controller_factory(seed=seed), range(CONTROLLERS)))
    assert len({robot.command_address for robot in robots}) == CONTROLLERS
    assert all(robot.command("state") == "6:0:5:2" for robot in robots)
    starts = [1000 * robot.start_s for robot in robots]
    memory = [resident_kib(robot.pid) / 1024 for robot in robots]
    text = (
        f"{CONTROLLERS} controllers at once: start {statistics.median(starts):.0f} ms (median), "
        f"{max(starts):.0f} ms (max), {1000 * alone:.0f} ms alone; resident memory of each "
        f"{statistics.median(memory):.1f} MiB (median), {max(memory):.1f} MiB (max)"
    )
    record_property("many", text)
    print(f"\n{text}")
