"""Starts host-sim and talks to it the way its users do.

Nothing here sleeps to let something happen: every wait looks for the thing itself and has a
deadline. `case` marks what run.py runs.
"""

import json
import os
import pathlib
import signal
import socket
import struct
import subprocess
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parents[3]
CONFIGS = ROOT / "host-sim" / "configs"
# Longest wait for anything, far above what an idle machine needs.
PATIENCE = 20.0

# The six floats of the captured frame of worked example 5.
POSE_BYTES = bytes.fromhex("392F0BBF 8687133F BFBD9D3F 37FCC8BF 17A01BBF 59FCEABE")
POSE = struct.unpack("<6f", POSE_BYTES)

cases = []
host_sim = None
log_folder = None


def case(title):
    """Marks a function as a case; the title is what the runner prints."""

    def mark(function):
        cases.append((title, function))
        return function

    return mark


class Failed(Exception):
    """A case found something else than it should have."""


def check(condition, message):
    if not condition:
        raise Failed(message)


def equal(actual, expected, what):
    check(actual == expected, f"{what}: {show(actual)} instead of {show(expected)}")


def show(value):
    return value.hex(" ").upper() if isinstance(value, (bytes, bytearray)) else repr(value)


def until(what, probe):
    """Calls `probe` until it gives something true, and returns that."""
    deadline = time.monotonic() + PATIENCE
    while True:
        value = probe()
        if value:
            return value
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {PATIENCE:.0f} s")
        time.sleep(0.005)


def initial(values):
    """Overrides that give variables a value at the start."""
    return [f"initial.{name}={value!r}" for name, value in values.items()]


def initial_pose():
    return initial({f"RobotState[{8 + nth}]": value for nth, value in enumerate(POSE)})


class Program:
    """A running `host-sim controller` or `host-sim gateway`."""

    def __init__(self, command, config, sets=(), binds=(), extra=()):
        self.folder = tempfile.TemporaryDirectory(prefix="foreign-")
        path = pathlib.Path(self.folder.name)
        ready = path / "ready.json"
        arguments = [host_sim, "-v", command, "-c", str(CONFIGS / config), "--ready", str(ready), "--stats", "50ms"]
        for override in sets:
            arguments += ["--set", override]
        self.links = []
        for name, device in dict(binds).items():
            kind, _, rest = device.partition(":")
            if kind.endswith("pty"):
                device = f"{kind}:{path / rest}"
                self.links.append(path / rest)
            arguments += ["--bind", f"{name}={device}"]
        arguments += extra
        self.log = open(log_folder / f"{threading.current_thread().name}-{command}.log", "ab")
        self.log.write(("$ " + " ".join(arguments) + "\n").encode())
        self.log.flush()
        self.process = subprocess.Popen(
            arguments, stdout=subprocess.PIPE, stderr=self.log, env={**os.environ, "RUST_BACKTRACE": "1"}
        )
        self.ready = None
        self.stats = {}
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()
        until(f"{command}'s ready line", lambda: self.ready or self._died())
        equal(json.loads(ready.read_text()), self.ready, "the --ready file")

    def _died(self):
        if self.process.poll() is not None:
            raise Failed(f"host-sim ended with exit code {self.process.returncode} before it was ready")

    def _read(self):
        for line in self.process.stdout:
            if line.startswith(b"ready "):
                self.ready = json.loads(line[len(b"ready ") :])
            elif line.startswith(b"{"):
                self.stats = json.loads(line)

    def address(self, name):
        """What the ready line says of a server or port, as a pair of host and port."""
        place = self.ready[name] if name in self.ready else self.ready["ports"][name]
        host, _, port = place.rpartition(":")
        return host, int(port)

    def device(self, name):
        """Where the ready line says a port's pseudoterminal is."""
        return self.ready["ports"][name]

    def until_stats(self, what, probe):
        """Waits for statistics that satisfy `probe`."""

        def attempt():
            try:
                return probe(self.stats)
            except KeyError:
                return False

        try:
            return until(what, attempt)
        except Failed as failed:
            raise Failed(f"{failed}; the newest statistics: {json.dumps(self.stats)}") from None

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        """Ctrl-C: it ends at once with exit code 0 and takes its links with it."""
        self.process.send_signal(signal.SIGINT)
        try:
            code = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            code = "none: it did not end"
        self.reader.join(PATIENCE)
        self.log.close()
        left = [str(link) for link in self.links if os.path.lexists(link)]
        self.folder.cleanup()
        if kind is None:
            equal(code, 0, "exit code after Ctrl-C")
            equal(left, [], "links left behind")


def controller(config, sets=(), binds=()):
    """A simulated controller on free ports."""
    free = [f"listen.{server}=0" for server in ("command", "state", "modbus", "udp2011")]
    return Program("controller", config, [*free, *sets], binds)


def gateway(config, robot, sets=(), binds=(), extra=()):
    """A gateway to a running controller."""
    ports = [f"controller.ports.{name}={robot.address(name)[1]}" for name in ("command", "state", "modbus")]
    return Program("gateway", config, ["controller.address=127.0.0.1", *ports, *sets], binds, extra)


def link_is_up(running, *names):
    """Waits until a gateway's links are up: what fields send before that is not passed on."""
    running.until_stats(f"links {', '.join(names)}", lambda stats: all(stats["links"][n]["state"] == "up" for n in names))


class Stream:
    """A TCP connection that is read to a length, with a deadline."""

    def __init__(self, address, connection=None):
        self.socket = connection or socket.create_connection(address, PATIENCE)
        self.socket.settimeout(PATIENCE)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data):
        self.socket.sendall(data)

    def read(self, count):
        data = b""
        while len(data) < count:
            try:
                piece = self.socket.recv(count - len(data))
            except TimeoutError:
                raise Failed(f"only {show(data)} within {PATIENCE:.0f} s, {count} bytes wanted") from None
            check(piece, f"closed after {show(data)}, {count} bytes wanted")
            data += piece
        return data

    def expect(self, data, what):
        equal(self.read(len(data)), data, what)

    def expect_closed(self, what):
        try:
            data = self.socket.recv(1)
        except ConnectionResetError:
            return
        equal(data, b"", what)

    def close(self):
        self.socket.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


class Command(Stream):
    """A client of port 2000, from its description: requests without any terminator."""

    def __init__(self, robot):
        super().__init__(robot.address("command"))

    def ask(self, request, reply):
        """Sends a request; the reply must be exactly this and nothing must be left of the one before."""
        self.send(request.encode())
        self.expect(reply.encode(), f"reply to {request!r}")

    def start(self, program):
        """Starts a program; from then on frames are kept for it."""
        self.ask(f"run({program})", "run start")


class Modbus:
    """A Modbus client of pymodbus' making."""

    def __init__(self, robot):
        from pymodbus.client import ModbusTcpClient

        host, port = robot.address("modbus")
        self.client = ModbusTcpClient(host, port=port, timeout=PATIENCE)
        check(self.client.connect(), "pymodbus could not connect")

    def coil(self, address):
        return self.client.read_coils(address).bits[0]

    def registers(self, address, count):
        return self.client.read_holding_registers(address, count=count).registers

    def until_coil(self, address, value):
        until(f"coil {address} = {value}", lambda: self.coil(address) == value)

    def until_registers(self, address, values):
        until(f"registers from {address} = {values}", lambda: self.registers(address, len(values)) == values)

    def close(self):
        self.client.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def state_packet(robot):
    """One whole packet of the state stream."""
    with Stream(robot.address("state")) as stream:
        return stream.read(1468)


def find_frame(read, frame_len, head, tail):
    """Reads bytes until a frame with this head and tail stands at their end; returns its payload."""
    data = b""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        data = (data + read(1))[-frame_len:]
        if len(data) == frame_len and data.startswith(head) and data.endswith(tail):
            return data[len(head) : frame_len - len(tail)]
    raise Failed(f"no frame {show(head)} .. {show(tail)} of {frame_len} bytes within {PATIENCE:.0f} s")


class Reserved:
    """A TCP port that nobody else gets before the program that it is for listens on it."""

    def __init__(self):
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]

    def __enter__(self):
        return self.port

    def __exit__(self, *_):
        self.socket.close()
