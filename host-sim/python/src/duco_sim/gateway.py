"""The recipe gateway as a context manager."""

from __future__ import annotations

import json
import os
import threading
from types import TracebackType
from typing import Any, Callable, Dict, Mapping, Optional, Type

from . import process
from .controller import Controller
from .defaults import GATEWAY_FILE
from .errors import DucoSimError, ProcessError
from .ports import Answer, Device, Owner, Port

Stats = Dict[str, Any]


class Gateway:
    """The recipe gateway on this machine, from its construction (or ``with``) until :meth:`close`.

    :param config: the path of a gateway file, or its text, or ``None`` for :data:`duco_sim.GATEWAY_FILE`
    :param controller: what it is connected to in place of the file's ``[controller]``; ``None`` leaves that as it is.
        The gateway's clock is the machine's: the controller's should be too.
    :param ports: what its ports are bound to, by name, as for :class:`Controller`
    :param set: keys of the file that are overridden, as ``--set`` takes them
    :param stats_interval: how often :meth:`stats` has new counters, such as ``"50ms"``
    :param verbose: how much :attr:`log` tells: 0 warnings, 1 events, 2 every frame
    """

    def __init__(
        self,
        config: process.Config = None,
        *,
        controller: Optional[Controller] = None,
        ports: Optional[Mapping[str, str]] = None,
        set: Optional[Mapping[str, object]] = None,
        stats_interval: str = "50ms",
        verbose: int = 1,
    ) -> None:
        with process.new_folder() as folder:
            path, text = process.configuration(config, GATEWAY_FILE, folder)
            self._devices_of = process.binds(ports or {}, process.buses(text), folder)
            arguments = [
                *process.settings({**(_keys(controller) if controller else {}), **(set or {})}),
                *process.bind_arguments(self._devices_of),
                *(["-" + "v" * verbose] if verbose else []),
            ]
            self._process = process.Process("gateway", path, arguments, folder, stats_interval)
        self.folder = folder
        """A folder for this run's files. It is removed at the end."""
        self._process.discards_output = False
        self._owner = Owner(stepped=False)
        self._changed = threading.Condition()
        self._stats: Optional[Stats] = None
        self._is_over = False
        self._reader = threading.Thread(target=self._read, name="duco-sim gateway", daemon=True)
        self._reader.start()

    def port(self, name: str) -> Port:
        """One of its ports, from the device's side. Raises :class:`DucoSimError` if there is none of this name."""
        places: Mapping[str, str] = self._process.ready.get("ports", {})
        if name not in places:
            raise DucoSimError(f"there is no port {name}; there are {', '.join(sorted(places)) or 'none'}")
        return Port(name, self._devices_of.get(name, ""), places[name], self._owner)

    def device(self, port: str, gap: float = 0.005) -> Callable[[Answer], Device]:
        """Makes a function the device of a serial port, as :meth:`Controller.device` does."""

        return lambda answer: Device(self.port(port), answer, gap)

    def stats(self, timeout: float = 5.0) -> Stats:
        """Its counters from now, as ``host-sim gateway --stats`` prints them (docs/devices.md section 4)."""
        with self._changed:
            before = self._stats
            return self._next(lambda stats: stats is not before, timeout, "there are no new counters")

    def wait(self, condition: Callable[[Stats], bool], timeout: float = 5.0) -> Stats:
        """Waits until a condition on :meth:`stats` holds, at most ``timeout`` seconds, and returns those counters.

        Raises :class:`TimeoutError` if it does not.
        """
        with self._changed:
            return self._next(condition, timeout, "it has not come to what was waited for")

    def wait_up(self, timeout: float = 5.0) -> Stats:
        """Waits until all links to the controller are up."""
        return self.wait(
            lambda stats: all(link["state"] in ("up", "shared") for link in stats["links"].values()), timeout
        )

    @property
    def log(self) -> str:
        """What it has written to stderr."""
        return self._process.log()

    @property
    def start_s(self) -> float:
        """How many seconds of the machine's time the start took."""
        return self._process.start_s

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.popen.pid

    def close(self) -> None:
        """Ends it and removes its files. The second time it does nothing.

        Raises :class:`ProcessError` if it has failed, and what devices have raised.
        """
        errors = self._owner.close()
        failure = self._process.close()
        self._reader.join()
        if failure is not None:
            raise ProcessError(failure)
        if errors:
            raise errors[0]

    def __enter__(self) -> Gateway:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        try:
            self.close()
        except Exception:
            if error is None:
                raise

    def report(self) -> Dict[str, str]:
        """What tells most about a failure: the newest counters and the log, by title. Never raises."""
        with self._changed:
            stats = json.dumps(self._stats, indent=1) if self._stats is not None else "none yet"
        return {"counters": stats, "log of host-sim": self.log}

    def _next(self, condition: Callable[[Stats], bool], timeout: float, otherwise: str) -> Stats:
        def holds() -> bool:
            return self._is_over or (self._stats is not None and condition(self._stats))

        came = self._changed.wait_for(holds, timeout)
        if self._is_over:
            raise ProcessError(process.with_log("the gateway has ended", self.log))
        if not came or self._stats is None:
            raise TimeoutError(process.with_log(f"{otherwise} within {timeout} s", self.log))
        return self._stats

    def _read(self) -> None:
        received = self._process.rest
        descriptor = self._process.stdout.fileno()
        while True:
            try:
                piece = os.read(descriptor, 1 << 16)
            except OSError:
                piece = b""
            received += piece
            *lines, received = received.split(b"\n")
            with self._changed:
                if lines:
                    self._stats = json.loads(lines[-1])
                self._is_over = not piece
                self._changed.notify_all()
            if not piece:
                return


def _keys(controller: Controller) -> Dict[str, object]:
    addresses = {
        "command": controller.command_address,
        "state": controller.state_address,
        "modbus": controller.modbus_address,
        "udp2011": controller.udp2011_address,
    }
    ports: Dict[str, object] = {f"controller.ports.{name}": address.port for name, address in addresses.items()}
    return {"controller.address": controller.command_address.host, **ports}
