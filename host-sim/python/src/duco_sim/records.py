"""What the controller tells of itself, as objects (docs/control.md sections 3 and 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, Iterator, List, Mapping, NamedTuple, Optional, Tuple


class Address(NamedTuple):
    """Of a TCP or UDP server, as :func:`socket.create_connection` takes it."""

    host: str
    """An IP address, such as ``"127.0.0.1"``."""
    port: int
    """1 to 65535."""

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @classmethod
    def parse(cls, text: str) -> Address:
        """From ``"127.0.0.1:2000"`` or ``"[::1]:2000"``. Raises :class:`ValueError` for anything else."""
        host, colon, port = text.rpartition(":")
        if not colon or not port.isdigit():
            raise ValueError(f"{text!r} is no address: HOST:PORT is allowed")
        return cls(host.strip("[]"), int(port))


@dataclass(frozen=True)
class Run:
    """A run of a program that has ended."""

    run: int
    """1 for the first since the start, and so on."""
    program: str
    """The program's name, such as ``"pick.jspf"``."""
    outcome: str
    """``"finished"``, ``"failed"`` or ``"stopped"``."""
    reason: Optional[str]
    """Why it failed; or what has stopped it: ``"stop"``, ``"disable"``, ``"power_off"``, ``"emergency_stop"``,
    ``"protective_stop"``, ``"restart"`` or ``"shutdown"``. ``None`` if it has finished."""
    line: Optional[int]
    """The line of the script where it failed, from 1; ``None`` if it is not known."""
    column: Optional[int]
    """The column, from 1; ``None`` if it is not known."""
    started_s: float
    """When it was started, in seconds of the controller's time."""
    ended_s: float
    """When it had ended and the arm was at rest, in seconds of the controller's time."""

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Run:
        """From the JSON object."""
        return cls(
            run=int(told["run"]),
            program=str(told["program"]),
            outcome=str(told["outcome"]),
            reason=told.get("reason"),
            line=told.get("line"),
            column=told.get("column"),
            started_s=float(told["started_s"]),
            ended_s=float(told["ended_s"]),
        )


@dataclass(frozen=True)
class ShownError:
    """The error in the state stream and in ``getlasterror``."""

    code: int
    """Not 0."""
    text: str
    """In words."""


@dataclass(frozen=True)
class PortState:
    """A recipe port."""

    up: bool
    """Whether its line is there, or its connection open."""
    recipe: Optional[str]
    """The name of its recipe; ``None`` if it has none."""
    cycle_ms: float
    """How often it sends, in milliseconds."""
    frames_in: int
    """Accepted frames since the start."""
    frames_out: int
    """Sent frames since the start."""


@dataclass(frozen=True)
class State:
    """The controller at one instant."""

    time_s: float
    """The controller's time since its start, in seconds."""
    robot: str
    """``"start"``, ``"initialize"``, ``"logout"``, ``"login"``, ``"power_off"``, ``"disable"`` or ``"enable"``."""
    program_state: str
    """``"stopped"``, ``"stopping"``, ``"running"``, ``"paused"`` or ``"pausing"``."""
    safety: str
    """Such as ``"run"``, ``"stop0"`` (emergency stop), ``"stop1"`` (protective stop), ``"stop2"`` (collision),
    ``"recovery"``, ``"reduce"``, ``"power_off"``."""
    mode: str
    """``"manual"``, ``"auto"`` or ``"remote"``."""
    codes: Mapping[str, int]
    """The same four as the numbers of the state stream: ``"robot"``, ``"program_state"``, ``"safety"``, ``"mode"``."""
    speed_percent: float
    """Above 0, at most 100."""
    program: Optional[str]
    """The program that runs or is paused; ``None`` if none does."""
    error: Optional[ShownError]
    """The error that is shown; ``None`` if none is."""
    last_run: Optional[Run]
    """The newest run that has ended; ``None`` before the first."""
    runs: int
    """Number of runs that were started."""
    joints_rad: Tuple[float, ...]
    """Positions of the six joints, in rad."""
    tcp_pose: Tuple[float, ...]
    """X, Y, Z in m, Rx, Ry, Rz in rad, in the base frame."""
    tcp_speed: Tuple[float, ...]
    """m/s and rad/s."""
    faults: Tuple[Mapping[str, Any], ...]
    """The present faults, as the operation ``fault`` takes them."""
    ports: Mapping[str, PortState]
    """The recipe ports, by name."""
    clients: Mapping[str, int]
    """Open connections of ``"command"``, ``"state"`` and ``"modbus"``."""
    log: Tuple[str, ...]
    """The newest 200 lines that programs have logged, oldest first."""

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> State:
        """From the JSON object."""
        error, last_run = told.get("error"), told.get("last_run")
        ports: Dict[str, PortState] = {
            name: PortState(
                up=bool(port["up"]),
                recipe=port.get("recipe"),
                cycle_ms=float(port["cycle_ms"]),
                frames_in=int(port["frames_in"]),
                frames_out=int(port["frames_out"]),
            )
            for name, port in told["ports"].items()
        }
        return cls(
            time_s=float(told["time_s"]),
            robot=str(told["robot"]),
            program_state=str(told["program_state"]),
            safety=str(told["safety"]),
            mode=str(told["mode"]),
            codes=dict(told["codes"]),
            speed_percent=float(told["speed_percent"]),
            program=told.get("program"),
            error=ShownError(int(error["code"]), str(error["text"])) if error else None,
            last_run=Run.of(last_run) if last_run else None,
            runs=int(told["runs"]),
            joints_rad=tuple(told["joints_rad"]),
            tcp_pose=tuple(told["tcp_pose"]),
            tcp_speed=tuple(told["tcp_speed"]),
            faults=tuple(told["faults"]),
            ports=ports,
            clients=dict(told["clients"]),
            log=tuple(told["log"]),
        )


@dataclass(frozen=True)
class Event(Mapping[str, Any]):
    """Something that happened. The keys of its kind are got as from a dictionary: ``event["text"]``."""

    n: int
    """1, 2, 3, ..."""
    time_s: float
    """When, in seconds of the controller's time."""
    event: str
    """Its kind, such as ``"command"``."""
    told: Mapping[str, Any]
    """All of it, as it was sent."""

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Event:
        """From the JSON object."""
        return cls(n=int(told["n"]), time_s=float(told["time_s"]), event=str(told["event"]), told=told)

    def __getitem__(self, key: str) -> Any:
        return self.told[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.told)

    def __len__(self) -> int:
        return len(self.told)

    def __str__(self) -> str:
        rest = " ".join(f"{key}={value!r}" for key, value in self.told.items() if key not in ("n", "time_s", "event"))
        return f"{self.n:5} {self.time_s:10.3f} s  {self.event} {rest}".rstrip()


class Events(List[Event]):
    """Events, oldest first."""

    next: int = 1
    """The number of the first event after these."""
    lost: int = 0
    """How many of those that were asked for are no longer kept (the newest 20 000 writes and 20 000 others are)."""
