"""The controller's clock, and waiting on it."""

from __future__ import annotations

import threading
import time
from typing import Any, Callable, Dict, Mapping, Optional, Sequence

from .control import Control
from .errors import Refused, WaitTimeout
from .ports import Owner
from .records import Event, Events

#: How the controller's answer begins when what was waited for has not come.
_TIMEOUT = "not within "
#: How often events that may have been missed are looked for, in seconds of the machine's time.
_LOOK_S = 0.05


class Clock:
    """Moves a stepped clock, and waits on any; serves the devices of a stepped one."""

    def __init__(self, control: Control, factor: Optional[float], owner: Owner) -> None:
        self._control, self._owner = control, owner
        self.factor = factor
        """How much faster than the machine's it is; ``None`` if it is stepped."""

    def now_s(self) -> float:
        """The controller's time since its start, in seconds."""
        self._control.call("get", items=[])
        return self._control.answered_s

    def events(self, kinds: Sequence[str], since: int) -> Events:
        """The kept events from number ``since`` on."""
        found = Events()
        while True:
            page = self._control.call("events", since=since, kinds=list(kinds), max=_PAGE)
            found.extend(Event.of(event) for event in page["events"])
            found.lost = max(found.lost, int(page["lost"]))
            found.next = since = int(page["next"])
            if len(page["events"]) < _PAGE:
                return found

    def mark(self) -> int:
        """The number that the next event will have."""
        return int(self._control.call("events", since=1 << 53, kinds=[], max=0)["next"])

    def advance(self, seconds: float) -> None:
        """Lets so much time pass."""
        if self.factor is not None:
            time.sleep(seconds / self.factor)
            return
        if not self._owner.devices():
            self._control.call("advance", seconds=seconds)
            return
        left_us = round(seconds * 1e6)
        while left_us > 0:
            piece_us = min(left_us, self._slice_us())
            self._control.call("advance", seconds=piece_us / 1e6)
            self._serve_devices()
            left_us -= piece_us

    def wait(self, until: Mapping[str, Any], timeout: float, since: Optional[int] = None) -> None:
        """Waits for a condition (docs/control.md section 4); an event counts from number ``since`` on."""
        stepped_devices = self.factor is None and bool(self._owner.devices())
        if "event" in until and (since is not None or stepped_devices):
            self._wait_since(dict(until), timeout, self.mark() if since is None else since)
        elif stepped_devices:
            self._in_slices(timeout, lambda seconds: self._wait_once(until, seconds))
        else:
            self._wait_once(until, timeout)

    def _wait_once(self, until: Mapping[str, Any], timeout: float) -> None:
        within = 60.0 if self.factor is None else timeout / self.factor + 30.0
        try:
            self._control.call_within(within, "wait", until=dict(until), timeout_s=timeout)
        except Refused as refused:
            if refused.why.startswith(_TIMEOUT):
                raise WaitTimeout(refused.operation, refused.why) from None
            raise

    def _wait_since(self, until: Dict[str, Any], timeout: float, since: int) -> None:
        """Waits for an event that may have occurred already, and then for the rest."""
        wanted = until.pop("event")

        def wait_once(seconds: float) -> None:
            if self._has_occurred(wanted, since):
                return
            try:
                self._wait_once({"event": wanted}, seconds)
            except WaitTimeout:
                # It may have come between the question and the waiting.
                if not self._has_occurred(wanted, since):
                    raise

        began = self.now_s()
        self._in_slices(timeout, wait_once)
        if until:
            self.wait(until, max(0.0, timeout - (self.now_s() - began)))

    def _has_occurred(self, wanted: Mapping[str, Any], since: int) -> bool:
        events = self.events([str(wanted.get("event"))], since)
        return any(all(event.get(key) == value for key, value in wanted.items()) for event in events)

    def _in_slices(self, timeout: float, wait_once: Callable[[float], None]) -> None:
        """Waits in short pieces, between which devices are served."""
        deadline = self.now_s() + timeout
        limit = self._slice_us() / 1e6 if self.factor is None else _LOOK_S * self.factor
        while True:
            # Each piece ends with an answer.
            left = deadline - self._control.answered_s
            try:
                return wait_once(max(0.0, min(left, limit)))
            except WaitTimeout:
                self._serve_devices()
                if left <= limit:
                    raise

    def _slice_us(self) -> int:
        """After how many microseconds of a stepped clock a device looks at its line."""
        return min((round(device.gap * 1e6) for device in self._owner.devices()), default=3_600_000_000)

    def _serve_devices(self) -> None:
        if self.factor is None:
            for device in self._owner.devices():
                device.serve_once()


class Watcher(threading.Thread):
    """Does something once a condition holds."""

    def __init__(
        self,
        wait: Callable[..., None],
        advance: Callable[[float], None],
        do: Callable[[], None],
        after: float,
        condition: Dict[str, Any],
    ) -> None:
        super().__init__(name="duco-sim when", daemon=True)
        self.condition = condition
        self.error: Optional[BaseException] = None
        self._wait, self._advance, self._do, self._after = wait, advance, do, after

    def run(self) -> None:
        """The thread."""
        try:
            self._wait(**self.condition)
            if self._after > 0:
                self._advance(self._after)
            self._do()
        except BaseException as error:
            self.error = error


def factor_of(text: str) -> Optional[float]:
    """How much faster than the machine's a clock is, from ``real`` or ``factor=20``; ``None`` for ``stepped``."""
    if text == "stepped":
        return None
    if text == "real":
        return 1.0
    word, _, number = text.partition("=")
    try:
        factor = float(number)
    except ValueError:
        factor = 0.0
    if word != "factor" or not factor > 0:
        raise ValueError(f"time: {text!r} is not allowed; allowed: real, stepped, factor=20 and the like")
    return factor


#: Events that are asked for at once.
_PAGE = 1000
