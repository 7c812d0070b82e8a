"""Recipe ports from the device's side: serial lines, CAN, and devices that answer."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Callable, List, Optional, Tuple, Type, TypeVar

from .errors import DucoSimError
from .records import Address

Answer = Callable[[bytes], Optional[bytes]]
_Self = TypeVar("_Self", bound="_Closing")


class _Closing:
    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()


class Owner:
    """A run with ports. Its devices end with it."""

    def __init__(self, stepped: bool) -> None:
        self.stepped = stepped
        """Whether its clock stands between calls; then its devices have no threads but are served in between."""
        self._devices: List[Device] = []
        self._lock = threading.Lock()

    def add(self, device: Device) -> None:
        """Ends this device with the run."""
        with self._lock:
            self._devices.append(device)

    def remove(self, device: Device) -> None:
        """Forgets a device that has ended."""
        with self._lock:
            if device in self._devices:
                self._devices.remove(device)

    def devices(self) -> List[Device]:
        """Those that have not ended."""
        with self._lock:
            return list(self._devices)

    def close(self) -> List[Exception]:
        """Ends them all, and returns what they raise."""
        errors = []
        for device in self.devices():
            try:
                device.close()
            except Exception as error:
                errors.append(error)
        return errors


class Port:
    """A recipe port of a run."""

    def __init__(self, name: str, device: str, where: str, owner: Owner) -> None:
        self._owner = owner
        self.name = name
        """The port's name in the configuration."""
        self.device = device
        """What it is bound to, such as ``"pty:/tmp/.../rs485"``; empty for a port that is reached over the network."""
        self.where = where
        """The path or the address where it is reached, as the line ``ready`` has it."""

    @property
    def path(self) -> Path:
        """The path of its pseudoterminal. Any program can open it as a serial line.

        Raises :class:`DucoSimError` if it is no pseudoterminal.
        """
        kind = self.device.partition(":")[0]
        if "pty" not in kind:
            raise DucoSimError(f"the port {self.name} is no pseudoterminal but {self.device or self.where}")
        return Path(self.where)

    @property
    def address(self) -> Address:
        """Where it listens for TCP clients. Raises :class:`DucoSimError` if it does not."""
        try:
            return Address.parse(self.where)
        except ValueError:
            raise DucoSimError(f"the port {self.name} has no address; it is {self.where}") from None

    @property
    def is_can(self) -> bool:
        """Whether it is a CAN bus."""
        return self.device.startswith("slcan")

    def open(self, timeout: Optional[float] = 1.0) -> Line:
        """Opens the device's end of a serial line.

        ``timeout`` is how many seconds :meth:`Line.read` waits; ``None`` is for ever.
        """
        if self.is_can:
            raise DucoSimError(f"the port {self.name} is a CAN bus: open_can opens it")
        return Line(self._descriptor(), timeout)

    def open_can(self, timeout: Optional[float] = 1.0) -> CanBus:
        """Joins the port's CAN bus as a node. ``timeout`` is how many seconds :meth:`CanBus.receive` waits."""
        if not self.is_can:
            raise DucoSimError(f"the port {self.name} is no CAN bus of its own but {self.device or self.where}")
        return CanBus(Line(self._descriptor(), timeout))

    def _descriptor(self) -> int:
        kind = self.device.partition(":")[0]
        if "pty" in kind:
            return os.open(self.where, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        if kind.startswith(("tcp", "slcan-tcp")):
            connection = socket.create_connection(self.address, timeout=10)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setblocking(False)
            return connection.detach()
        raise DucoSimError(f"the port {self.name} cannot be opened from here: {self.device or self.where}")

    def __repr__(self) -> str:
        return f"<Port {self.name} {self.device or self.where}>"


class Line(_Closing):
    """The device's end of a serial line. Times are seconds of the machine."""

    def __init__(self, descriptor: int, timeout: Optional[float]) -> None:
        self.timeout = timeout
        """How long :meth:`read` waits, in seconds; ``None`` is for ever, 0 is not at all."""
        self._descriptor = descriptor
        self._kept = b""

    def fileno(self) -> int:
        """The file descriptor, for :mod:`select`. What :meth:`read_until` has read too far is not in it any more."""
        return self._descriptor

    def write(self, data: bytes) -> int:
        """Sends all of it and returns its length. Raises :class:`TimeoutError` if 10 s do not suffice."""
        left, deadline = memoryview(data), time.monotonic() + 10
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise TimeoutError("nobody reads the line") from None
                select.select([], [self._descriptor], [], 0.1)
        return len(data)

    def read(self, size: int = 1) -> bytes:
        """``size`` bytes, or fewer if the timeout ends it or the other end has closed."""
        deadline = self._deadline()
        received, self._kept = self._kept, b""
        while len(received) < size:
            piece = self._receive(deadline)
            if not piece:
                break
            received += piece
        self._kept = received[size:]
        return received[:size]

    def read_some(self) -> bytes:
        """What has come, at least one byte; nothing if the timeout ends it or the other end has closed."""
        received, self._kept = self._kept, b""
        return received or self._receive(self._deadline())

    def read_until(self, end: bytes) -> bytes:
        """Up to and with ``end``; what has come without it if the timeout ends it or the other end has closed."""
        deadline = self._deadline()
        received, self._kept = self._kept, b""
        while end not in received:
            piece = self._receive(deadline)
            if not piece:
                return received
            received += piece
        first, _, self._kept = received.partition(end)
        return first + end

    def drain(self) -> bytes:
        """Discards what has come so far, and returns it."""
        received, self._kept = self._kept, b""
        while True:
            piece = self._receive(0.0)
            if not piece:
                return received
            received += piece

    def close(self) -> None:
        """Closes it. The second time it does nothing."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def _deadline(self) -> Optional[float]:
        return None if self.timeout is None else time.monotonic() + self.timeout

    def _receive(self, deadline: Optional[float]) -> bytes:
        while True:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select([self._descriptor], [], [], left)[0]:
                return b""
            try:
                return os.read(self._descriptor, 4096)
            except BlockingIOError:
                continue
            except OSError:  # a pseudoterminal whose controller has ended
                return b""


@dataclass(frozen=True)
class CanFrame:
    """A CAN frame."""

    id: int
    """0 to 0x7FF, or 0 to 0x1FFFFFFF if it is extended."""
    data: bytes = b""
    """0 to 8 bytes."""
    extended: bool = False
    """Whether the id has 29 bits."""

    def __post_init__(self) -> None:
        if not 0 <= self.id <= (0x1FFFFFFF if self.extended else 0x7FF):
            raise ValueError(f"{self.id:#x} is no id of a frame{' with 29 bits' if self.extended else ' with 11 bits'}")
        if len(self.data) > 8:
            raise ValueError(f"{len(self.data)} bytes are too many; at most 8 are allowed")


class CanBus(_Closing):
    """A node of a port's CAN bus (slcan). Frames that have not been received are kept by the controller, up to 256."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._frames: List[CanFrame] = []
        line.write(b"\rO\r")
        self._until_answer("O")

    @property
    def timeout(self) -> Optional[float]:
        """How many seconds :meth:`receive` waits; ``None`` is for ever."""
        return self._line.timeout

    @timeout.setter
    def timeout(self, seconds: Optional[float]) -> None:
        self._line.timeout = seconds

    def send(self, frame: CanFrame) -> None:
        """Queues a frame for the bus. Raises :class:`DucoSimError` if the bus refuses it."""
        head = f"T{frame.id:08X}" if frame.extended else f"t{frame.id:03X}"
        self._line.write(f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode())
        self._until_answer(head)

    def receive(self) -> Optional[CanFrame]:
        """The next data frame from the bus; ``None`` if none comes in time."""
        while not self._frames:
            line = self._next()
            if line is None:
                return None
            self._keep(line)
        return self._frames.pop(0)

    def close(self) -> None:
        """Leaves the bus."""
        self._line.close()

    def _until_answer(self, request: str) -> None:
        # An answer comes at once unless the bus has much to carry before.
        kept, self._line.timeout = self._line.timeout, 10.0
        try:
            while True:
                line = self._next()
                if line is None:
                    raise DucoSimError(f"the CAN bus gives no answer to {request}")
                if line == "\a":
                    raise DucoSimError(f"the CAN bus refuses {request}")
                if line in ("", "z", "Z"):
                    return
                self._keep(line)
        finally:
            self._line.timeout = kept

    def _next(self) -> Optional[str]:
        """A line without its end; the character BEL is one of its own."""
        first = self._line.read(1)
        if first in (b"", b"\r", b"\a"):
            return None if not first else first.decode().strip("\r")
        rest = self._line.read_until(b"\r")
        return (first + rest).decode("ascii", "replace").rstrip("\r")

    def _keep(self, line: str) -> None:
        digits = {"t": 3, "T": 8}.get(line[:1])
        if digits is not None:
            length = int(line[1 + digits : 2 + digits])
            data = bytes.fromhex(line[2 + digits : 2 + digits + 2 * length])
            self._frames.append(CanFrame(int(line[1 : 1 + digits], 16), data, extended=digits == 8))


class Device(_Closing):
    """A device on a serial line that answers: a function that is called with each request, in a thread of its own.

    A request is what has come until the line was silent for ``gap`` seconds of the machine's time, 5 ms if not said
    otherwise. The function returns the answer, or ``None`` for none. An exception in it ends the device, and
    :meth:`close` raises it. The device ends with the controller or gateway of its port.

    With a stepped clock there is no thread: every ``gap`` seconds of the controller's time the clock stands until the
    device has taken what has come, as one request, and has answered. So repeated runs are the same.
    """

    def __init__(self, port: Port, answer: Optional[Answer] = None, gap: float = 0.005) -> None:
        if not 0.0001 <= gap <= 10.0:
            raise ValueError(f"gap: {gap} is not allowed; allowed: 0.0001 to 10 s")
        self.exchanges: List[Tuple[bytes, Optional[bytes]]] = []
        """Each request with its answer, oldest first."""
        self.gap = gap
        """The silence that ends a request, in seconds."""
        self._function = answer
        self._owner = port._owner
        self._line = port.open()
        self._line.timeout = 0
        self._changed = threading.Condition()
        self._error: Optional[BaseException] = None
        self._thread: Optional[threading.Thread] = None
        if not self._owner.stepped:
            self._wake, self._end = os.pipe()
            self._thread = threading.Thread(target=self._serve, name=f"duco-sim {port.name}", daemon=True)
            self._thread.start()
        self._owner.add(self)

    def answer(self, request: bytes) -> Optional[bytes]:
        """The answer to a request. A class of your own has a method of its own here."""
        return self._function(request) if self._function is not None else None

    def send(self, data: bytes) -> None:
        """Sends without having been asked."""
        self._line.write(data)

    @property
    def requests(self) -> List[bytes]:
        """The requests so far, oldest first."""
        with self._changed:
            return [request for request, _ in self.exchanges]

    def wait_requests(self, count: int, timeout: float = 5.0) -> List[bytes]:
        """Waits until there are so many requests, ``timeout`` seconds of the machine at most, and returns them.

        Raises :class:`TimeoutError` if there are fewer. With a stepped clock nothing is waited for.
        """
        with self._changed:
            limit = 0.0 if self._thread is None else timeout
            enough = self._changed.wait_for(lambda: len(self.exchanges) >= count or self._error is not None, limit)
            self._raise()
            if not enough:
                raise TimeoutError(f"{len(self.exchanges)} requests have come within {limit} s, not {count}")
            return [request for request, _ in self.exchanges]

    def close(self) -> None:
        """Ends it; raises what its function has raised."""
        self._owner.remove(self)
        thread, self._thread = self._thread, None
        if thread is not None:
            os.write(self._end, b"x")
            thread.join()
            os.close(self._wake)
            os.close(self._end)
        self._line.close()
        self._raise()

    def serve_once(self) -> None:
        """Takes what has come, and answers it. For a stepped clock, whose controller calls it."""
        request = self._line.drain()
        if request:
            self._exchange(request)

    def _exchange(self, request: bytes) -> None:
        answer = self.answer(request)
        if answer is not None:
            self._line.write(answer)
        with self._changed:
            self.exchanges.append((request, answer))
            self._changed.notify_all()

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _serve(self) -> None:
        request = b""
        try:
            while True:
                sources = [self._line.fileno(), self._wake]
                ready = select.select(sources, [], [], self.gap if request else None)[0]
                if self._wake in ready:
                    return
                if not ready:
                    whole, request = request, b""
                    self._exchange(whole)
                    continue
                piece = self._line.read_some()
                if not piece:
                    return  # the controller has ended
                request += piece
        except BaseException as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()
