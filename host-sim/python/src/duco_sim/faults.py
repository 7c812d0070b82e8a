"""Faults that heal at the end of a ``with`` block."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Callable, Dict, Iterable, List, Mapping, Optional, Type


class Fault:
    """A fault that has begun. It ends with :meth:`heal`, or with the ``with`` block that it is used in.

    with robot.fault("command", delay=0.5):
        ...
    """

    def __init__(self, told: Mapping[str, Any], heal: Callable[[Mapping[str, Any]], None]) -> None:
        self.told: Mapping[str, Any] = dict(told)
        """What the operation ``fault`` was given."""
        self._heal: Optional[Callable[[Mapping[str, Any]], None]] = heal

    def heal(self) -> None:
        """Ends this fault and leaves others alone. The second time it does nothing."""
        heal, self._heal = self._heal, None
        if heal is not None:
            heal(self.told)

    def __enter__(self) -> Fault:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.heal()

    def __repr__(self) -> str:
        return f"<Fault {dict(self.told)}>"


def of_server(
    mute: bool,
    delay: Optional[float],
    refuse: bool,
    disconnect: bool,
    garbage: bool,
    exception: Optional[int],
    freeze: bool,
    cut: Optional[int],
) -> Dict[str, Any]:
    """The one kind that is asked for, with its argument."""
    asked: Dict[str, Dict[str, Any]] = {}
    switches = {"mute": mute, "refuse": refuse, "disconnect": disconnect, "garbage": garbage, "freeze": freeze}
    for kind, on in switches.items():
        if on:
            asked[kind] = {}
    if delay is not None:
        asked["delay"] = {"seconds": delay}
    if exception is not None:
        asked["exception"] = {"code": exception}
    if cut is not None:
        asked["cut"] = {"bytes": cut}
    if len(asked) != 1:
        raise ValueError(f"one kind of fault at a time is allowed, not {', '.join(asked) or 'none'}")
    ((kind, arguments),) = asked.items()
    return {"kind": kind, **arguments}


def key_of(told: Mapping[str, Any]) -> Dict[str, Any]:
    """What `heal` takes for this fault."""
    for key in ("server", "port", "item"):
        if key in told:
            return {key: told[key]}
    return {"transitions": True}


def others_at(
    key: Mapping[str, Any], told: Mapping[str, Any], present: Iterable[Mapping[str, Any]]
) -> List[Mapping[str, Any]]:
    """The present faults with this key, without the one that was told."""
    return [fault for fault in present if key_of(fault) == key and fault.get("kind") != told.get("kind")]
