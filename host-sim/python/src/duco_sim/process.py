"""A run of ``host-sim``: its start, its end, its log, and the folder of its files."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import tempfile
import time
import weakref
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

from .binary import host_sim
from .errors import ProcessError
from .records import Address

#: How long a program may take to start and to end, in seconds of the machine's time.
START_LIMIT_S = 20.0
END_LIMIT_S = 10.0
#: With it, the program notices that nobody reads its output any more: it ends if its test was killed.
STATS_INTERVAL = "1s"

Config = Union[None, str, "os.PathLike[str]"]


class Process:
    """A running ``host-sim controller`` or ``host-sim gateway``, with a folder of its own."""

    def __init__(
        self,
        command: str,
        config: str,
        arguments: Sequence[str],
        folder: Path,
        stats_interval: str = STATS_INTERVAL,
    ) -> None:
        """Starts it and returns when everything listens. The folder is the process's from now on."""
        self.folder = folder
        self._log = folder / "log.txt"
        # Many run beside each other, and none of them may keep the processor from the tests.
        always = ["--no-realtime", "--stats", stats_interval]
        argv = [str(host_sim()), command, "-c", config, *always, *arguments]
        #: Whether nobody reads what it prints.
        self.discards_output = True
        self.began = time.monotonic()
        try:
            with open(self._log, "wb") as log:
                self.popen = subprocess.Popen(
                    argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, bufsize=0, close_fds=True
                )
        except OSError as error:
            raise ProcessError(f"{argv[0]} cannot be started: {error}") from error
        assert self.popen.stdout is not None
        self.stdout = self.popen.stdout
        self._end = weakref.finalize(self, _end, self.popen, folder)
        self.rest = b""
        try:
            self.ready = self._ready()
        except BaseException:
            self._end()
            raise
        #: Seconds from the start of the process until it was ready.
        self.start_s = time.monotonic() - self.began

    def log(self) -> str:
        """What it has written to stderr."""
        try:
            return self._log.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def ended(self) -> Optional[int]:
        """Its exit code; ``None`` if it runs."""
        return self.popen.poll()

    def close(self) -> Optional[str]:
        """Ends it and removes its folder. Returns what was wrong with how it ended."""
        if not self._end.alive:
            return None
        by_itself = self.popen.poll()
        code = _stop(self.popen, self.discards_output)
        log = self.log()
        self._end()
        if by_itself is not None and by_itself != 0:
            return with_log(f"host-sim ended by itself with {_code(by_itself)}", log)
        return with_log(f"host-sim did not end as it should: {_code(code)}", log) if code != 0 else None

    def _ready(self) -> Dict[str, Any]:
        deadline = self.began + START_LIMIT_S
        received = b""
        with selectors.DefaultSelector() as selector:
            selector.register(self.stdout, selectors.EVENT_READ)
            while True:
                for line in received.split(b"\n")[:-1]:
                    if line.startswith(b"ready "):
                        self.rest = received.partition(line + b"\n")[2]
                        ready: Dict[str, Any] = json.loads(line[6:])
                        return ready
                left = deadline - time.monotonic()
                if left <= 0 or not selector.select(left):
                    raise ProcessError(with_log(f"host-sim was not ready within {START_LIMIT_S} s", self.log()))
                piece = os.read(self.stdout.fileno(), 1 << 16)
                if not piece:
                    code = self.popen.wait()
                    raise ProcessError(with_log(f"host-sim did not start: {_code(code)}", self.log()))
                received += piece


@contextlib.contextmanager
def new_folder() -> Iterator[Path]:
    """A new folder that only this user can read; it is removed again if the block fails."""
    folder = Path(tempfile.mkdtemp(prefix="duco-sim-"))
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def configuration(config: Config, default: str, folder: Path) -> Tuple[str, str]:
    """The path of a configuration file and its text.

    A path is what is a path object, or text in one line without ``=`` or ``[``. Anything else is the text of a file.
    """
    if config is None:
        config = default
    if isinstance(config, str) and (not config.strip() or any(mark in config for mark in "\n=[")):
        path = folder / "config.toml"
        path.write_text(config, encoding="utf-8")
        return str(path), config
    name = os.fspath(config)
    try:
        return name, Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise ProcessError(f"the configuration {name} cannot be read: {error}") from error


def settings(overrides: Mapping[str, object]) -> List[str]:
    """The arguments ``--set KEY=VALUE``."""
    arguments = []
    for key, value in overrides.items():
        text = json.dumps(value) if isinstance(value, (bool, int, float, str)) else str(value)
        arguments += ["--set", f"{key}={text}"]
    return arguments


def buses(text: str) -> Dict[str, str]:
    """The ``bus`` of each ``[[port]]`` of a configuration file, by name."""
    try:
        tomllib = importlib.import_module("tomllib")
    except ImportError:  # Python 3.10 and before
        return _buses_by_line(text)
    try:
        return {str(port["name"]): str(port["bus"]) for port in tomllib.loads(text).get("port", [])}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}  # host-sim says what is wrong


def _buses_by_line(text: str) -> Dict[str, str]:
    """The same for a Python without a reader of TOML: a key a line, as files are usually written."""
    found: Dict[str, str] = {}
    keys: Dict[str, str] = {}
    in_port = False
    for line in [*text.splitlines(), "[end]"]:
        line = line.strip()
        if line.startswith("["):
            if in_port and "name" in keys and "bus" in keys:
                found[keys["name"]] = keys["bus"]
            in_port, keys = re.match(r"\[\[\s*port\s*\]\]", line) is not None, {}
        else:
            pair = re.match(r"""(name|bus)\s*=\s*(["'])(.*?)\2""", line)
            if pair:
                keys[pair[1]] = pair[3]
    return found


def binds(ports: Mapping[str, str], buses_of: Mapping[str, str], folder: Path) -> Dict[str, str]:
    """What each port is bound to: what ``ports`` says, and for the others what needs no hardware."""
    short = {
        "pty": "pty:{path}",
        "pty-paced": "pty-paced:{path}",
        "tcp": "tcp-listen:127.0.0.1:0",
        "slcan": "slcan-tcp:127.0.0.1:0",
        "slcan-unpaced": "slcan-tcp-unpaced:127.0.0.1:0",
    }
    usual = {"rs485": "pty", "modbus-rtu": "pty", "modbus-rtu-slave": "pty", "can": "slcan"}
    wanted = {name: usual[bus] for name, bus in buses_of.items() if bus in usual}
    wanted.update(ports)
    return {name: short.get(device, device).replace("{path}", str(folder / name)) for name, device in wanted.items()}


def bind_arguments(devices: Mapping[str, str]) -> List[str]:
    """The arguments ``--bind NAME=DEVICE``."""
    return [word for name, device in devices.items() for word in ("--bind", f"{name}={device}")]


def address_of(ready: Mapping[str, Any], key: str) -> Optional[Address]:
    """An address of the line ``ready``; ``None`` if it has none of this name."""
    text = ready.get(key)
    return Address.parse(text) if isinstance(text, str) else None


def with_log(message: str, log: str, lines: int = 20) -> str:
    """The message, and the end of the log below it."""
    newest = log.rstrip().splitlines()[-lines:]
    return "\n".join([message, *("  " + line for line in newest)])


def _code(code: Optional[int]) -> str:
    if code is not None and code < 0:
        try:
            return f"signal {signal.Signals(-code).name}"
        except ValueError:
            return f"signal {-code}"
    return f"exit code {code}"


def _stop(popen: subprocess.Popen[bytes], discards_output: bool) -> Optional[int]:
    """Ends it with SIGTERM, and if that does not help with SIGKILL."""
    if popen.poll() is None:
        popen.terminate()
        try:
            if discards_output and popen.stdout is not None:
                # It would wait for a moment for somebody to read the lines that did not fit in the pipe.
                _read_to_the_end(popen.stdout.fileno(), time.monotonic() + END_LIMIT_S)
            popen.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            popen.kill()
            popen.wait()
    return popen.returncode


def _read_to_the_end(descriptor: int, deadline: float) -> None:
    with selectors.DefaultSelector() as selector:
        selector.register(descriptor, selectors.EVENT_READ)
        while selector.select(max(0.0, deadline - time.monotonic())):
            if not os.read(descriptor, 1 << 16):
                return


def _end(popen: subprocess.Popen[bytes], folder: Path) -> None:
    _stop(popen, False)
    if popen.stdout is not None:
        popen.stdout.close()
    shutil.rmtree(folder, ignore_errors=True)
