"""One command over port 2000 (proto-core/docs/wire/command.md)."""

from __future__ import annotations

import contextlib
import re
import select
import socket
import time as clock
from typing import TYPE_CHECKING

from .errors import WaitTimeout

if TYPE_CHECKING:
    from .controller import Controller

#: Replies that are complete with their last character. Nothing else ends a reply but silence or a line's end.
_WHOLE = re.compile(
    rb"run (start|success|fail)|set (success|fail|speed [0-9.]+%)|[a-z]+ (success|fail)|unknown command"
)
#: A reply comes in one piece. This silence ends one of another form, in seconds of the machine's time.
_SILENCE_S = 0.02
#: What has left at an instant of a stepped clock is received within this time, in seconds of the machine's.
_DELIVERY_S = 5.0
#: How far a stepped clock moves before a reply is looked for again.
_STEP_S = 0.01


def exchange(robot: Controller, text: str, timeout: float) -> str:
    """Sends ``text`` and returns the reply without its end."""
    if any(end in text for end in "\r\n\0"):
        raise ValueError("one command at a time is allowed, without an end of line")
    if robot._factor is None:
        return _stepped(robot, text, timeout)
    deadline = clock.monotonic() + timeout / robot._factor + 0.5
    with socket.create_connection(robot.command_address, timeout=10) as connection:
        connection.sendall(text.encode() + b"\r\n")
        return _reply(connection, deadline, text)


def _stepped(robot: Controller, text: str, timeout: float) -> str:
    """The same; the clock is moved to the very instant of the reply, so that a repeated run is the same."""
    mark = robot.mark()
    reply = _stepped_reply(robot, text, timeout, mark)
    # What comes next finds the connection closed.
    robot.advance(0)
    return reply


def _stepped_reply(robot: Controller, text: str, timeout: float, mark: int) -> str:
    with socket.create_connection(robot.command_address, timeout=10) as connection:
        connection.sendall(text.encode() + b"\r\n")
        # The clock has stood until the command has arrived.
        robot.advance(0)
        deadline = robot.time_s + timeout
        asked = robot.events("command", since=mark)
        answered = asked and any(event["client"] == asked[-1]["client"] for event in robot.events("reply", since=mark))
        if asked and not answered:
            with contextlib.suppress(WaitTimeout):
                robot.wait(event={"event": "reply", "client": asked[-1]["client"]}, timeout=timeout)
        # A reply that a fault holds up, and what is no reply, come without an event.
        while not select.select([connection], [], [], 0)[0]:
            left = deadline - robot.time_s
            if left <= 0:
                raise TimeoutError(f"{text}: no reply within {timeout} s")
            robot.advance(min(left, _STEP_S))
        return _reply(connection, clock.monotonic() + _DELIVERY_S, text)


def _reply(connection: socket.socket, deadline: float, text: str) -> str:
    received = b""
    while True:
        left = deadline - clock.monotonic()
        if received:
            left = min(left, _SILENCE_S)
        if left <= 0 or not select.select([connection], [], [], left)[0]:
            if received:
                break
            raise TimeoutError(f"{text}: no reply in time")
        piece = connection.recv(4096)
        if not piece:
            if received:
                break
            raise ConnectionError(f"{text}: the connection was closed without a reply")
        received += piece
        if received.endswith((b"\n", b"\r")) or _WHOLE.fullmatch(received):
            break
    return received.decode("utf-8", "replace").strip("\r\n\0")
