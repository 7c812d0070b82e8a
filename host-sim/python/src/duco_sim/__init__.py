"""A simulated SIASUN DUCO CORE controller for tests of robot code.

    import duco_sim

    with duco_sim.Controller(time="factor=20") as robot:
        print(robot.command("state"))           # over port 2000, as robot code does it
        robot.di[1] = True                      # what happens in the cell
        robot.run("pick.jspf")
        assert robot.finish().outcome == "finished"

:class:`Controller` runs the program ``host-sim``, which is part of this package, on free ports of this machine.
:class:`Gateway` runs its recipe gateway. Both end with the ``with`` block and leave nothing behind. Under pytest the
fixtures ``duco_controller``, ``duco_controller_factory`` and ``recipe_gateway`` do the same
(:mod:`duco_sim.pytest_plugin`).

Nothing but the standard library is needed.
"""

from __future__ import annotations

from .binary import host_sim
from .controller import Controller
from .defaults import CONTROLLER_FILE, GATEWAY_FILE
from .errors import DucoSimError, ProcessError, Refused, WaitTimeout
from .faults import Fault
from .gateway import Gateway
from .ports import CanBus, CanFrame, Device, Line, Port
from .records import Address, Event, Events, PortState, Run, ShownError, State
from .version import __version__

__all__ = [
    "Address",
    "CONTROLLER_FILE",
    "CanBus",
    "CanFrame",
    "Controller",
    "Device",
    "DucoSimError",
    "Event",
    "Events",
    "Fault",
    "GATEWAY_FILE",
    "Gateway",
    "Line",
    "Port",
    "PortState",
    "ProcessError",
    "Refused",
    "Run",
    "ShownError",
    "State",
    "WaitTimeout",
    "__version__",
    "host_sim",
]
