"""The client of the control socket (docs/control.md): a line of JSON each way."""

from __future__ import annotations

import json
import socket
import threading
from typing import Any, Dict, List, Optional

from .errors import DucoSimError, ProcessError, Refused
from .records import Address

#: What the controller accepts at once.
MAX_CONNECTIONS = 16


class Control:
    """Connections to one control socket, used by any number of threads.

    A connection carries one request at a time, so that a thread that waits does not hold up another one.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.answered_s = 0.0
        """The controller's time at the newest answer, in seconds. A stepped clock is still there."""
        self._lock = threading.Lock()
        self._idle: List[_Connection] = []
        self._room = threading.Semaphore(MAX_CONNECTIONS)
        self._closed = False

    def call(self, do: str, /, **arguments: Any) -> Any:
        """Sends an operation and returns its result.

        Raises :class:`Refused` if the controller refuses it, :class:`ProcessError` if it does not answer within 60 s of
        the machine's time.
        """
        return self.call_within(60.0, do, **arguments)

    def call_within(self, within_s: float, do: str, /, **arguments: Any) -> Any:
        """The same with another limit, in seconds of the machine's time."""
        request = {"do": do, **arguments}
        with self._room:
            connection = self._take()
            try:
                answer = connection.ask(request, within_s)
            except OSError as error:
                connection.close()
                raise ProcessError(f"{do}: the control socket at {self.address} gives no answer: {error}") from error
            except BaseException:
                # Its answer may still come, and must not be taken for the next one.
                connection.close()
                raise
            self._give_back(connection)
        self.answered_s = float(answer.get("time_s", 0.0))
        if answer.get("ok") is not True:
            raise Refused(do, str(answer.get("error", answer)))
        return answer.get("result")

    def close(self) -> None:
        """Closes all connections. Nothing can be called after it."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()

    def _take(self) -> _Connection:
        with self._lock:
            if self._closed:
                raise DucoSimError("the controller was closed")
            if self._idle:
                return self._idle.pop()
        try:
            return _Connection(self.address)
        except OSError as error:
            raise ProcessError(f"the control socket at {self.address} takes no connection: {error}") from error

    def _give_back(self, connection: _Connection) -> None:
        with self._lock:
            if not self._closed:
                self._idle.append(connection)
                return
        connection.close()


class _Connection:
    def __init__(self, address: Address) -> None:
        self._socket = socket.create_connection(address, timeout=10)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = b""

    def ask(self, request: Dict[str, Any], within_s: float) -> Dict[str, Any]:
        self._socket.settimeout(within_s)
        self._socket.sendall(json.dumps(request, allow_nan=False).encode() + b"\n")
        pieces = [self._received]
        while b"\n" not in pieces[-1]:
            received = self._socket.recv(1 << 16)
            if not received:
                raise ConnectionError("it was closed")
            pieces.append(received)
        line, _, self._received = b"".join(pieces).partition(b"\n")
        answer: Optional[Dict[str, Any]] = json.loads(line)
        if not isinstance(answer, dict):
            raise ConnectionError(f"{line!r} is no answer")
        return answer

    def close(self) -> None:
        self._socket.close()
