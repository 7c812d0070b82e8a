"""The simulated controller as a context manager."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple, Type, Union

from . import faults, process
from .control import Control
from .defaults import CONTROLLER_FILE
from .errors import DucoSimError, ProcessError
from .faults import Fault
from .items import Group, Value
from .ports import Answer, Device, Owner, Port
from .records import Address, Events, Run, State
from .talk import exchange
from .timeline import Timeline, timeline_file
from .waiting import Clock, Watcher, factor_of


class _Any:
    def __repr__(self) -> str:
        return "ANY"


_ANY = _Any()
EventWanted = Union[str, Mapping[str, Any]]


class Controller:
    """A simulated controller on this machine, from its construction (or ``with``) until :meth:`close`.

    :param config: the path of a controller file, or its text, or ``None`` for :data:`duco_sim.CONTROLLER_FILE`. Its
        ``[listen]`` does not count: all servers get free ports of 127.0.0.1.
    :param time: ``"real"``; ``"factor=20"``, whose clock runs 20 times as fast as the machine's; or ``"stepped"``,
        whose clock moves only by :meth:`advance`, :meth:`wait`, :meth:`finish` and :meth:`command`.
    :param seed: chooses the phases of state stream and ports against the start. 0 is for none: all phases are 0.
    :param ports: what recipe ports are bound to, by name, as ``--bind`` takes it. ``"pty"``, ``"pty-paced"``,
        ``"tcp"``, ``"slcan"`` and ``"slcan-unpaced"`` choose a path or port by themselves. Without it a port of
        ``rs485`` is a pseudoterminal, and a port of ``can`` a bus that speaks slcan.
    :param set: keys of the file that are overridden, such as ``{"robot.power": "off"}``, as ``--set`` takes them.
    :param timeline: operations at given times or under conditions (docs/control.md section 6): the path of a file, its
        text, or a list of steps such as ``{"when": {"program": "pick.jspf"}, "after_s": 0.2, "do": "emergency_stop"}``.
    :param verbose: how much :attr:`log` tells: 0 warnings, 1 events, 2 every frame.

    Times are seconds of the controller's clock where not said otherwise. An operation that the controller does not
    accept raises :class:`~duco_sim.Refused`, and nothing has changed. All methods may be called from any thread.
    """

    def __init__(
        self,
        config: process.Config = None,
        *,
        time: str = "real",
        seed: int = 0,
        ports: Optional[Mapping[str, str]] = None,
        set: Optional[Mapping[str, object]] = None,
        timeline: Timeline = None,
        verbose: int = 1,
    ) -> None:
        self.time = time
        """How its clock runs, as it was given."""
        self._factor = factor_of(time)
        with process.new_folder() as folder:
            path, text = process.configuration(config, CONTROLLER_FILE, folder)
            listen = {"listen.address": "127.0.0.1", **{f"listen.{server}": 0 for server in _SERVERS}}
            self._devices_of = process.binds(ports or {}, process.buses(text), folder)
            arguments = [
                *process.settings({**listen, **(set or {})}),
                *process.bind_arguments(self._devices_of),
                *("--time", time),
                *(["--seed", str(seed)] if seed else []),
                *(["-" + "v" * verbose] if verbose else []),
            ]
            if timeline is not None:
                arguments += ["--timeline", timeline_file(timeline, folder)]
            self._process = process.Process("controller", path, arguments, folder)
        self.folder = folder
        """A folder for this run's files. It is removed at the end."""
        ready = self._process.ready
        control = process.address_of(ready, "control")
        if control is None:
            self._process.close()
            raise ProcessError("this host-sim has no control socket: it is older than the package")
        self._control = Control(control)
        self._ready = ready
        self._owner = Owner(stepped=self._factor is None)
        self._clock = Clock(self._control, self._factor, self._owner)
        self._watchers: List[Watcher] = []
        self._lock = threading.Lock()
        self._is_open = True

        def bits(name: str, count: int) -> Group[bool]:
            return Group(name, count, bool, self.get, self.set)

        def words(name: str) -> Group[int]:
            return Group(name, 32, int, self.get, self.set)

        def floats(name: str, count: int) -> Group[float]:
            return Group(name, count, float, self.get, self.set)

        self.di = bits("DI", 16)
        """Cabinet digital inputs 1 to 16."""
        self.do = bits("DO", 16)
        """Cabinet digital outputs 1 to 16."""
        self.fdi = bits("FDI", 8)
        """Functional digital inputs 1 to 8."""
        self.fdo = bits("FDO", 8)
        """Functional digital outputs 1 to 8."""
        self.tool_di = bits("ToolDI", 2)
        """Tool digital inputs 1 and 2."""
        self.tool_do = bits("ToolDO", 2)
        """Tool digital outputs 1 and 2."""
        self.tool_button = bits("ToolButton", 2)
        """Tool buttons 1 (S) and 2 (T)."""
        self.ai_v = floats("AI_V", 4)
        """Cabinet voltage inputs 1 to 4, 0 to 10 V."""
        self.ai_ma = floats("AI_C", 4)
        """Cabinet current inputs 1 to 4, 0 to 20 mA."""
        self.tool_ai_v = floats("ToolAI", 2)
        """Tool voltage inputs 1 and 2, 0 to 10 V."""
        self.word_input = words("WordInputReg")
        """Word registers, input, 1 to 32: 0 to 65535."""
        self.word_output = words("WordOutputReg")
        """Word registers, output, 1 to 32: 0 to 65535."""
        self.float_input = floats("FloatInputReg", 32)
        """Float registers, input, 1 to 32."""
        self.float_output = floats("FloatOutputReg", 32)
        """Float registers, output, 1 to 32."""

    # Where it is.

    @property
    def command_address(self) -> Address:
        """Port 2000's: commands."""
        return self._address("command")

    @property
    def state_address(self) -> Address:
        """Port 2001's: the state stream."""
        return self._address("state")

    @property
    def modbus_address(self) -> Address:
        """The Modbus TCP server's."""
        return self._address("modbus")

    @property
    def udp2011_address(self) -> Address:
        """UDP port 2011's; it only answers if a port of the file has ``bus = "udp-server"``."""
        return self._address("udp2011")

    def port(self, name: str) -> Port:
        """A recipe port, from the device's side. Raises :class:`~duco_sim.DucoSimError` if there is none."""
        places: Mapping[str, str] = self._ready.get("ports", {})
        if name not in places and name not in self._devices_of:
            raise DucoSimError(f"there is no port {name}; there are {', '.join(sorted(places)) or 'none'}")
        return Port(name, self._devices_of.get(name, ""), places.get(name, ""), self._owner)

    def device(self, port: str, gap: float = 0.005) -> Callable[[Answer], Device]:
        """Makes a function the device of a serial port; it ends with the controller.

            @robot.device("rs485")
            def scale(request):
                return b"\\xff\\xff\\x2a\\x00\\xee\\xee"

        ``scale`` is a :class:`Device` then, which says what ``gap`` is.
        """
        return lambda answer: Device(self.port(port), answer, gap)

    # What it shows.

    @property
    def state(self) -> State:
        """All that it shows at this instant."""
        return State.of(self._control.call("state"))

    @property
    def last_run(self) -> Optional[Run]:
        """The newest run of a program that has ended; ``None`` before the first."""
        return self.state.last_run

    @property
    def log(self) -> str:
        """What ``host-sim`` has written to stderr."""
        return self._process.log()

    @property
    def start_s(self) -> float:
        """How many seconds of the machine's time the start took, until everything listened."""
        return self._process.start_s

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.popen.pid

    def events(self, *kinds: str, since: int = 0) -> Events:
        """What has happened, oldest first: of all kinds, or of those that are named, such as ``"command"``.

        ``since`` is the number of the first event that counts; :meth:`mark` has that of the next one. docs/control.md
        section 5 lists the kinds.
        """
        return self._clock.events(kinds, since)

    def mark(self) -> int:
        """The number that the next event will have, for ``since``."""
        return self._clock.mark()

    def event_log(self) -> str:
        """All events that are kept as lines of JSON. Two runs that are the same have the same text."""
        return "".join(json.dumps(event.told, sort_keys=True) + "\n" for event in self.events())

    def counters(self) -> Dict[str, Any]:
        """The counters that ``host-sim controller --stats`` prints (docs/devices.md section 4)."""
        counters: Dict[str, Any] = self._control.call("counters")
        return counters

    # Items.

    def get(self, items: Sequence[str]) -> Dict[str, Value]:
        """The values of these items at one instant, by name."""
        values: Dict[str, Value] = self._control.call("get", items=list(items))
        return values

    def set(self, items: Mapping[str, Value]) -> None:
        """Sets these items at one instant: all of them, or none."""
        self._control.call("set", items=dict(items))

    def __getitem__(self, item: str) -> Value:
        """The value of an item by its name, such as ``"BitInputReg[3].4"`` (0 or 1) or ``"RobotState[8]"``."""
        return self.get([item])[item]

    def __setitem__(self, item: str, value: Value) -> None:
        """Sets an item by its name."""
        self.set({item: value})

    # At the pendant.

    @property
    def mode(self) -> str:
        """``"manual"``, ``"auto"`` or ``"remote"``: the key. Can be set."""
        return self.state.mode

    @mode.setter
    def mode(self, mode: str) -> None:
        self._control.call("mode", mode=mode)

    @property
    def power(self) -> str:
        """``"off"``, ``"on"`` (brakes closed) or ``"enabled"``. Setting it presses the buttons and waits."""
        return {"disable": "on", "enable": "enabled"}.get(self.state.robot, "off")

    @power.setter
    def power(self, power: str) -> None:
        if power not in _BUTTONS:
            raise ValueError(f"power: {power!r} is not allowed; allowed: off, on, enabled")
        for button, state in _BUTTONS[power].get(self.power, ()):
            self._control.call(button)
            self.wait(robot=state)

    def run(self, program: str, speed_percent: Optional[float] = None) -> None:
        """Starts a program, in manual mode too. ``speed_percent`` is above 0 and at most 100."""
        arguments = {} if speed_percent is None else {"speed_percent": speed_percent}
        self._control.call("run", program=program, **arguments)

    def stop(self) -> None:
        """Stops the program; :meth:`finish` waits until it has."""
        self._control.call("stop")

    def pause(self) -> None:
        """Pauses the program. ``wait(program_state="paused")`` waits until it has."""
        self._control.call("pause")

    def resume(self) -> None:
        """Lets a paused program go on."""
        self._control.call("resume")

    def upload(self, name: str, script: Union[str, os.PathLike[str]]) -> None:
        """Adds or replaces a program: its text, or the path of a file with it.

        Raises :class:`~duco_sim.Refused` with the place of a mistake, and while the program runs.
        """
        text = script if isinstance(script, str) else Path(script).read_text(encoding="utf-8")
        self._control.call("upload", program=name, script=text)

    def remove(self, name: str) -> None:
        """Removes a program."""
        self._control.call("remove", program=name)

    def programs(self) -> List[str]:
        """The programs' names."""
        names: List[str] = self._control.call("programs")
        return names

    def recipe(self, port: str, recipe: Optional[str]) -> None:
        """Assigns a recipe of the file to a port; ``None`` for none."""
        self._control.call("recipe", port=port, recipe=recipe)

    def cycle(self, port: str, ms: float) -> None:
        """Sets how often a port sends, in milliseconds: 4 to 3 600 000."""
        self._control.call("cycle", port=port, ms=ms)

    # In the cell.

    def estop(self) -> None:
        """Presses the emergency stop: the program ends and the robot is disabled."""
        self._control.call("emergency_stop")

    def protective_stop(self) -> None:
        """Opens a safety door: the program ends and the robot is disabled."""
        self._control.call("protective_stop")

    def collide(self, axis: int = 1) -> None:
        """Makes the arm collide: the program pauses. Joint 1 to 6, or sensor 11 to 16 (base) or 20 (end)."""
        self._control.call("collide", axis=axis)

    def clear(self) -> None:
        """Releases and acknowledges a stop. ``wait(safety="run")`` waits until the robot is ready again, 0.2 s."""
        self._control.call("clear")

    def hold_safety(self, safety: Optional[str]) -> None:
        """The safety controller stops watching, which ends the program: ``"wait"``, ``"config"``, ``"model"``,
        ``"update"`` or ``"fail"``; ``None``: it watches again."""
        self._control.call("hold", safety=safety)

    def reduced(self, on: bool) -> None:
        """Somebody enters (``True``) or leaves (``False``) the zone of reduced speed."""
        self._control.call("reduced", on=on)

    def raise_error(self, code: int, text: str = "") -> None:
        """Shows an error in the state stream and in ``getlasterror``. ``code`` is not 0."""
        self._control.call("raise_error", code=code, text=text)

    def clear_error(self) -> None:
        """Acknowledges the error that is shown."""
        self._control.call("clear_error")

    def restart(self, registers: str = "initial") -> None:
        """Switches the controller off and on, and waits until it has booted: the arm is without power then.

        ``registers`` is ``"initial"`` for the values of the file, or ``"cleared"`` for 0. All its clients lose their
        connections.
        """
        self._control.call("restart", registers=registers)
        self.wait(robot="power_off")

    # Faults.

    def fault(
        self,
        server: str,
        *,
        mute: bool = False,
        delay: Optional[float] = None,
        refuse: bool = False,
        disconnect: bool = False,
        garbage: bool = False,
        exception: Optional[int] = None,
        freeze: bool = False,
        cut: Optional[int] = None,
    ) -> Fault:
        """Begins a fault of a server: ``"command"``, ``"state"`` or ``"modbus"``. It lasts until it is healed.

        :param mute: does not answer, but carries out
        :param delay: answers so many seconds later (``command``, ``modbus``)
        :param refuse: closes each new connection at once
        :param disconnect: closes all connections, once
        :param garbage: sends random bytes in place of each answer or packet
        :param exception: answers each request with this exception, 1 to 11 (``modbus``)
        :param freeze: sends the same packet again and again (``state``)
        :param cut: sends only so many bytes of the next packet, then closes, once (``state``)

        One of them at a time; call it again for another one. The result can be used in ``with``.
        """
        kind = faults.of_server(mute, delay, refuse, disconnect, garbage, exception, freeze, cut)
        return self._fault({"server": server, **kind})

    def fault_port(self, port: str, *, mute: bool = False, disconnect: bool = False) -> Fault:
        """Begins a fault of a recipe port: it sends nothing (``mute``), or the connection of a TCP client port is
        closed, once (``disconnect``)."""
        return self._fault({"port": port, **faults.of_server(mute, None, False, disconnect, False, None, False, None)})

    def spoil(self, item: str, value: float) -> Fault:
        """Sends this in place of the item's value, in state packets and recipe frames. May be NaN or an infinity."""
        told: Union[float, str] = value
        if value != value:
            told = "nan"
        elif value in (float("inf"), float("-inf")):
            told = "inf" if value > 0 else "-inf"
        return self._fault({"item": item, "kind": "spoil", "value": told})

    def slow_transitions(self, seconds: float) -> Fault:
        """Power, enable, stop and pause take so many seconds longer."""
        return self._fault({"transitions": seconds})

    def heal(
        self,
        server: Optional[str] = None,
        *,
        port: Optional[str] = None,
        item: Optional[str] = None,
        transitions: bool = False,
    ) -> None:
        """Ends the faults of a server, a port or an item, or slow transitions; without any of them, all faults."""
        chosen = {"server": server, "port": port, "item": item, "transitions": transitions or None}
        self._control.call("heal", **{key: value for key, value in chosen.items() if value is not None})

    # Time.

    @property
    def time_s(self) -> float:
        """The controller's time since its start, in seconds."""
        return self._clock.now_s()

    def advance(self, seconds: float) -> None:
        """Lets ``seconds`` pass on the controller's clock. A stepped clock moves by so much; others are waited for."""
        self._clock.advance(seconds)

    def wait(
        self,
        *,
        robot: Optional[str] = None,
        program_state: Optional[str] = None,
        safety: Optional[str] = None,
        mode: Optional[str] = None,
        program: Union[str, None, _Any] = _ANY,
        items: Optional[Mapping[str, Value]] = None,
        coil: Optional[Mapping[int, Value]] = None,
        register: Optional[Mapping[int, int]] = None,
        event: Optional[EventWanted] = None,
        since: Optional[int] = None,
        timeout: float = 5.0,
    ) -> None:
        """Waits until all that is named holds. A stepped clock moves while it waits.

        :param robot: the robot state's name, such as ``"enable"``; :class:`State` lists the names
        :param program_state: ``"running"``, ``"stopped"``, ``"paused"``
        :param safety: ``"run"``, ``"stop0"`` and so on
        :param mode: ``"manual"``, ``"auto"`` or ``"remote"``
        :param program: this program runs or is paused; ``None``: none does
        :param items: each item has this value
        :param coil: each coil of this Modbus address has this value
        :param register: each holding register of this Modbus address has this value
        :param event: an event has occurred whose keys have these values, such as ``{"event": "command", "text":
            "stop"}``; a text stands for its kind
        :param since: the number of the first event that counts, from :meth:`mark`; without it, those from now on
        :param timeout: how many seconds of the controller's time it may take

        Raises :class:`~duco_sim.WaitTimeout`, which says what is the case, if it does not come in time.
        """
        until: Dict[str, Any] = {}
        states = {"robot": robot, "program_state": program_state, "safety": safety, "mode": mode}
        until.update({key: value for key, value in states.items() if value is not None})
        if not isinstance(program, _Any):
            if program in _PROGRAM_STATES:
                raise ValueError(f"{program!r} is a state: program_state={program!r}; program takes a program's name")
            until["program"] = program
        if items is not None:
            until["items"] = dict(items)
        if coil is not None:
            until["coil"] = {str(address): value for address, value in coil.items()}
        if register is not None:
            until["register"] = {str(address): value for address, value in register.items()}
        wanted = {"event": event} if isinstance(event, str) else event
        if wanted is not None:
            until["event"] = dict(wanted)
        self._clock.wait(until, timeout, since)

    def finish(self, timeout: float = 60.0) -> Run:
        """Waits until no program runs, at most ``timeout`` seconds, and returns how the newest one has ended.

        Raises :class:`~duco_sim.DucoSimError` if none was ever started.
        """
        self.wait(program=None, timeout=timeout)
        last_run = self.last_run
        if last_run is None:
            raise DucoSimError("no program was started")
        return last_run

    def when(self, do: Callable[[], None], *, after: float = 0.0, timeout: float = 60.0, **condition: Any) -> None:
        """Does something once a condition of :meth:`wait` holds, while the test goes on:

            robot.when(robot.estop, items={"DO[1]": 1}, after=0.1)
            cycle.pick()                # is interrupted

        ``do`` is called in a thread, ``after`` seconds after the condition holds. What it raises, and the condition's
        timeout, :meth:`close` raises. With a stepped clock use a timeline instead: waiting would move it.
        """
        if self._factor is None:
            raise DucoSimError("with a stepped clock, when() would move it; use timeline=")
        watcher = Watcher(self.wait, self.advance, do, after, {**condition, "timeout": timeout})
        with self._lock:
            self._watchers.append(watcher)
        watcher.start()

    # Over port 2000.

    def command(self, text: str, timeout: float = 10.0) -> str:
        """Sends a command to port 2000 over a connection of its own, and returns the reply without its end.

        A stepped clock moves until the reply comes. ``timeout`` is in seconds of the controller's time. Raises
        :class:`TimeoutError` if no reply comes, and :class:`ConnectionError` if the connection ends before.
        """
        return exchange(self, text, timeout)

    # The end.

    def close(self) -> None:
        """Ends it and removes its files. The second time it does nothing.

        Raises :class:`~duco_sim.ProcessError` if ``host-sim`` has failed, and what devices and :meth:`when` raised.
        """
        with self._lock:
            if not self._is_open:
                return
            self._is_open = False
            watchers = self._watchers
        errors = self._owner.close()
        unfinished = [watcher for watcher in watchers if watcher.is_alive()]
        failure = self._process.close()
        self._control.close()
        for watcher in watchers:
            watcher.join()
            if isinstance(watcher.error, Exception) and watcher not in unfinished:
                errors.append(watcher.error)
        if failure is not None:
            raise ProcessError(failure)
        if errors:
            raise errors[0]
        if unfinished:
            raise DucoSimError(f"it never came to what when() waits for: {unfinished[0].condition}")

    def __enter__(self) -> Controller:
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
            # What the test raises tells more.
            if error is None:
                raise

    def report(self, events: int = 100) -> Dict[str, str]:
        """What tells most about a failure: the state, the newest events, and the log, by title. Never raises."""
        told: Dict[str, str] = {}
        try:
            state = self.state
            shown = {key: value for key, value in vars(state).items() if key not in ("log", "codes")}
            told["state"] = "\n".join(f"{key}: {value}" for key, value in shown.items())
            if state.log:
                told["lines of programs"] = "\n".join(state.log[-50:])
            told["newest events"] = "\n".join(str(event) for event in self.events()[-events:])
        except Exception as error:
            told["state"] = f"unknown: {error}"
        told["log of host-sim"] = self.log
        return told

    def __repr__(self) -> str:
        return f"<Controller {self.time} {self._ready}>"

    def _address(self, server: str) -> Address:
        address = process.address_of(self._ready, server)
        if address is None:
            raise DucoSimError(f"this host-sim has no server {server}")
        return address

    def _fault(self, told: Dict[str, Any]) -> Fault:
        self._control.call("fault", **told)
        return Fault(told, self._heal_one)

    def _heal_one(self, told: Mapping[str, Any]) -> None:
        # `heal` ends all faults of the server; the others begin again.
        if not self._is_open:
            return
        key = faults.key_of(told)
        others = faults.others_at(key, told, self.state.faults)
        self._control.call("heal", **key)
        for fault in others:
            self._control.call("fault", **fault)


# What is pressed, by what is wanted and what is the case, and the state that is waited for.
_ON, _ENABLE = ("power_on", "disable"), ("enable", "enable")
_OFF, _DISABLE = ("power_off", "power_off"), ("disable", "disable")
_BUTTONS: Dict[str, Dict[str, Sequence[Tuple[str, str]]]] = {
    "off": {"on": [_OFF], "enabled": [_OFF]},
    "on": {"off": [_ON], "enabled": [_DISABLE]},
    "enabled": {"off": [_ON, _ENABLE], "on": [_ENABLE]},
}
_SERVERS = ("command", "state", "modbus", "udp2011")
_PROGRAM_STATES = ("stopped", "stopping", "running", "paused", "pausing")
