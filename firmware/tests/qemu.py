#!/usr/bin/env python3
"""The firmware in QEMU against `host-sim controller`: one line PASS or FAIL a case.

    python firmware/tests/qemu.py --firmware ELF --host-sim target/debug/host-sim [WORD ...]

The field devices are on the emulated UARTs, the controller is on the emulated Ethernet. With words,
only cases whose title has one of them. Exit code 0 only when every case passed. Needs Python and
QEMU (`apt-get install qemu-system-arm`), nothing else.
"""

import argparse
import json
import os
import pathlib
import queue
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.dont_write_bytecode = True
sys.path.insert(0, str(ROOT / "host-sim" / "tests" / "foreign"))

import cell  # noqa: E402
from cell import Failed, check, equal, until  # noqa: E402

# A case that hangs ends here.
CASE_LIMIT = 60
HEAD, OUT_TAIL = b"\xff\xff", b"\xfe\xfe"
DO1_ON, DO1_OFF = bytes.fromhex("FFFF01EEEE"), bytes.fromhex("FFFF00EEEE")
THREE_BYTES, ANSWER = bytes.fromhex("FFFF010203EEEE"), bytes.fromhex("FFFF7D7D7DFEFE")
# The coil that shows DO1, and the holding register that shows WordInputReg[1].
DO1, WORD_INPUT = 192, 8
# The host as the guest sees it.
HOST = "10.0.2.2"

elf = None
cases = []


def case(title):
    def mark(function):
        cases.append((title, function))
        return function

    return mark


class Board:
    """QEMU with the firmware, its configuration made from an example file."""

    def __init__(self, config, robot=None, sets=(), damage=None, forward=None):
        self.folder = tempfile.TemporaryDirectory(prefix="qemu-")
        path = pathlib.Path(self.folder.name)
        self.log_path = cell.log_folder / f"{threading.current_thread().name}-board.log"
        image = path / "gateway.img"
        overrides = [f"controller.address={HOST}", *sets]
        if robot:
            for name in ("command", "state", "modbus"):
                overrides.append(f"controller.ports.{name}={robot.address(name)[1]}")
        arguments = [cell.host_sim, "image", str(cell.CONFIGS / config), "-o", str(image)]
        for override in overrides:
            arguments += ["--set", override]
        subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
        if damage:
            image.write_bytes(damage(image.read_bytes()))
        network = "user,id=n0,mac=02:11:22:33:44:55"
        if forward:
            network += f",hostfwd=tcp:127.0.0.1:{forward[0]}-:{forward[1]}"
        arguments = ["qemu-system-arm", "-M", "mps2-an500", "-display", "none", "-monitor", "none", "-nic", network]
        self.lines = [path / f"uart{number}" for number in range(3)]
        for number, line in enumerate(self.lines):
            arguments += ["-chardev", f"socket,id=u{number},path={line},server=on,wait=off", "-serial", f"chardev:u{number}"]
        arguments += ["-chardev", f"file,id=log,path={self.log_path}", "-serial", "chardev:log"]
        self.qmp_path = path / "qmp"
        arguments += ["-qmp", f"unix:{self.qmp_path},server=on,wait=off"]
        arguments += ["-semihosting-config", f"enable=on,target=native,arg=firmware,arg={image}", "-kernel", elf]
        self.process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        until("QEMU's sockets", lambda: all(line.exists() for line in self.lines) or self._ended())

    def _ended(self):
        if self.process.poll() is not None:
            raise Failed(f"QEMU ended with exit code {self.process.returncode}; its log: {self.log()}")

    def log(self):
        return self.log_path.read_text(errors="replace") if self.log_path.exists() else ""

    def until_log(self, text):
        until(f"{text!r} in the log", lambda: text in self.log() or self._ended())

    def cable(self, plugged):
        """Pulls the Ethernet cable or plugs it in."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(self.qmp_path))
            stream = connection.makefile("rw")
            stream.readline()
            for command, arguments in (("qmp_capabilities", {}), ("set_link", {"name": "lan9118.0", "up": plugged})):
                stream.write(json.dumps({"execute": command, "arguments": arguments}) + "\n")
                stream.flush()
                answer = json.loads(stream.readline())
                check("return" in answer, f"QMP: {answer}")

    def cpu_seconds(self):
        """The host's time that the emulation took so far."""
        fields = pathlib.Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def linked(self, *names):
        """Waits until these links are up."""
        for name in names:
            self.until_log(f"link {name}: up")

    def uart(self, number):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(str(self.lines[number]))
        return connection

    def line(self, number):
        """A device on an RS-485 port."""
        return Line(self.uart(number))

    def can(self):
        """An adapter on the CAN port."""
        return Adapter(self.uart(2))

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        code = self.process.poll()
        self.process.kill()
        self.process.wait()
        self.folder.cleanup()
        if kind is None:
            equal(code, None, "QEMU's exit code before it was ended")
            check("panic" not in self.log(), "the firmware panicked")


class Line:
    """A device on a UART. Like every device it takes what comes, whether anybody looks or not."""

    def __init__(self, connection):
        self.socket = connection
        self.received = b""
        self.arrived = queue.SimpleQueue()
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self):
        try:
            while piece := self.socket.recv(4096):
                self.arrived.put(piece)
        except OSError:
            pass

    def send(self, data):
        self.socket.sendall(data)

    def more(self, seconds=cell.PATIENCE):
        try:
            self.received += self.arrived.get(timeout=seconds)
        except queue.Empty:
            raise Failed(f"nothing more within {seconds} s; the newest: {cell.show(self.received[-64:])}") from None

    def forget(self):
        """What came so far is of no interest."""
        self.received = b""
        while not self.arrived.empty():
            self.arrived.get()

    def until(self, wanted):
        """Waits until these bytes have come; returns what came before them."""
        deadline = time.monotonic() + cell.PATIENCE
        while wanted not in self.received:
            check(time.monotonic() < deadline, f"{cell.show(wanted)} never came; the newest: {cell.show(self.received[-64:])}")
            self.more()
        before, _, self.received = self.received.partition(wanted)
        return before

    def frames(self, count, length):
        """So many whole frames, one behind the other without a byte between."""
        while len(self.received) < count * length:
            self.more()
        data, self.received = self.received[: count * length], self.received[count * length :]
        return [data[at : at + length] for at in range(0, len(data), length)]

    def silent(self, seconds):
        """Nothing may come for so long."""
        try:
            self.more(seconds)
        except Failed:
            return
        raise Failed(f"{cell.show(self.received)} came from a line that has to be silent")


class Adapter(Line):
    """The board's CAN port: slcan on a UART."""

    def __init__(self, connection):
        super().__init__(connection)
        self.send(b"C\rS6\r\rO\r")
        self.until(b"\r\r\r")

    def frame(self, wanted):
        """The data of the next frame with this id."""
        while True:
            while b"\r" not in self.received:
                self.more()
            text, _, self.received = self.received.partition(b"\r")
            text = text.lstrip(b"z")
            if text[:4] == b"t%03X" % wanted:
                data = bytes.fromhex(text[5:].decode())
                equal(len(data), int(text[4:5]), "length of a frame")
                return data

    def transmit(self, identifier, data):
        self.send(b"t%03X%d" % (identifier, len(data)) + data.hex().encode() + b"\r")


class Modbus:
    """A Modbus client for looking at the controller from outside."""

    def __init__(self, robot):
        self.stream = cell.Stream(robot.address("modbus"))

    def ask(self, request):
        self.stream.send(struct.pack(">HHHB", 1, 0, len(request) + 1, 1) + request)
        length = struct.unpack(">H", self.stream.read(6)[4:])[0]
        answer = self.stream.read(length)[1:]
        equal(answer[0], request[0], "the answer's function code")
        return answer[2:]

    def coil(self, address):
        return self.ask(struct.pack(">BHH", 1, address, 1))[0] & 1

    def until_coil(self, address, value):
        until(f"coil {address} = {value}", lambda: self.coil(address) == value)

    def until_registers(self, address, values):
        request = struct.pack(">BHH", 3, address, len(values))
        wanted = struct.pack(f">{len(values)}H", *values)
        until(f"registers from {address} = {values}", lambda: self.ask(request) == wanted)


def pose_frame(floats):
    return HEAD + cell.POSE_BYTES[: 4 * floats] + OUT_TAIL


def pose_and_do1(robot, device, pose):
    """The device sees this pose each cycle and switches DO1."""
    device.until(pose)
    equal(device.frames(20, len(pose)), [pose] * 20, "frames one behind the other")
    modbus = Modbus(robot)
    for _ in range(3):
        device.send(DO1_ON)
        modbus.until_coil(DO1, 1)
        device.send(DO1_OFF)
        modbus.until_coil(DO1, 0)


@case("example 1 through the firmware: three bytes to word registers, the answer back")
def rs485_user():
    with cell.controller("udp-server-controller.toml") as robot, Board("rs485-user.toml", robot) as board:
        board.linked("modbus")
        device = board.line(0)
        device.send(THREE_BYTES)
        equal(device.frames(1, len(ANSWER)), [ANSWER], "the answer")
        Modbus(robot).until_registers(WORD_INPUT, [1, 2, 3])


@case("example 2 through the firmware: the pose on RS-485, DO1 by Modbus")
def rs485_system():
    with cell.controller("udp-server-controller.toml") as robot, Board("rs485-system.toml", robot) as board:
        board.linked("modbus", "state")
        pose_and_do1(robot, board.line(0), pose_frame(4))


@case("example 2, garbage on the line: the frame behind it is found")
def rs485_garbage():
    with cell.controller("udp-server-controller.toml") as robot, Board("rs485-system.toml", robot) as board:
        board.linked("modbus")
        device, modbus = board.line(0), Modbus(robot)
        garbage = bytes(range(256)) * 8 + b"\xff\xff\xff" + DO1_OFF[:4]
        for value, frame in ((1, DO1_ON), (0, DO1_OFF)):
            device.send(garbage + frame)
            modbus.until_coil(DO1, value)


@case("example 3 through the firmware: three bytes on CAN to word registers, the answer back")
def can_user():
    with cell.controller("udp-server-controller.toml") as robot, Board("can-user.toml", robot) as board:
        board.linked("modbus")
        adapter = board.can()
        adapter.transmit(1, bytes([1, 2, 3]))
        equal(adapter.frame(2), b"\x7d\x7d\x7d", "the answer")
        Modbus(robot).until_registers(WORD_INPUT, [1, 2, 3])


@case("example 4 through the firmware: the pose in CAN ids 2, 3 and 4, DO1 by id 1")
def can_system():
    binds = {"can": "slcan-tcp:127.0.0.1:0"}
    with cell.controller("can-system-controller.toml", binds=binds) as robot, Board("can-system.toml", robot) as board:
        board.linked("modbus", "state")
        adapter = board.can()
        until("a pose", lambda: adapter.frame(2) == bytes.fromhex("EF54EF3EA7E7D13E"))
        for identifier in (3, 4):
            equal(len(adapter.frame(identifier)), 8, f"length of id {identifier}")
        modbus = Modbus(robot)
        for value in (1, 0, 1):
            adapter.transmit(1, bytes([value]))
            modbus.until_coil(DO1, value)


@case("example 5 through the firmware: UDP 2011 both ways")
def udp_server():
    with cell.controller("udp-server-controller.toml") as robot:
        sets = [f"controller.recipe_link.udp={robot.address('udp2011')[1]}"]
        with Board("udp-server.toml", robot, sets) as board:
            board.linked("udp2011")
            pose_and_do1(robot, board.line(0), pose_frame(6))


@case("example 6 through the firmware: the controller's TCP client connects to the board")
def tcp_client():
    with cell.Reserved() as port, cell.Reserved() as unused:
        pass
    sets = [f"port.tcp1.to=127.0.0.1:{port}", f"port.udp1.to=127.0.0.1:{unused}"]
    with Board("client.toml", forward=(port, 50000)) as board:
        board.until_log("address 10.0.2.15")
        with cell.controller("client-controller.toml", sets) as robot:
            board.linked("tcp-listen")
            pose_and_do1(robot, board.line(0), pose_frame(6))


@case("the force sensor at 960 frames a second: no frame is lost, the forces go up by UDP 2011")
def force_sensor():
    with cell.controller("force-sensor-controller.toml") as robot:
        # QEMU's host may stop in the middle of a frame for longer than the file's 5 ms.
        sets = [f"controller.recipe_link.udp={robot.address('udp2011')[1]}", "port.force.idle_gap_ms=200"]
        with Board("force-sensor.toml", robot, sets) as board:
            board.linked("udp2011")
            device = board.line(0)
            count, begin = 2880, time.monotonic()
            for number in range(count):
                device.send(b"\x48\xaa" + struct.pack("<6f", *[number / 8 + axis for axis in range(6)]) + b"\r\n")
                time.sleep(max(0.0, begin + number / 960 - time.monotonic()))
            board.until_log(f"port 0: in {count} frames, {28 * count} bytes; out 0 frames, 0 bytes; 0 bytes skipped")
            robot.until_stats("forces at the controller", lambda stats: stats["ports"]["udp2011"]["frames_in"] > count // 2)


@case("the Ethernet cable is pulled and plugged in: the links come back")
def cable():
    with cell.controller("udp-server-controller.toml") as robot, Board("rs485-system.toml", robot) as board:
        board.linked("modbus", "state")
        device = board.line(0)
        pose_and_do1(robot, device, pose_frame(4))
        board.cable(False)
        board.until_log("link state: lost")
        board.cable(True)
        board.until_log("link modbus: up (2)")
        board.until_log("link state: up (2)")
        device.forget()
        pose_and_do1(robot, device, pose_frame(4))


@case("a board with nothing to do takes next to none of its host's time")
def idle():
    with Board("rs485-user.toml", damage=lambda image: b"") as board:
        board.until_log("nothing runs: the image is cut")
        before = board.cpu_seconds()
        board.line(0).silent(2.0)
        spent = board.cpu_seconds() - before
        check(spent < 0.5, f"{spent:.2f} s of processor time in 2 s")


@case("the controller goes and comes back: nothing stale is written, then all is as before")
def restart():
    with cell.controller("udp-server-controller.toml") as robot:
        ports = {name: robot.address(name)[1] for name in ("command", "state", "modbus", "udp2011")}
        board = Board("rs485-system.toml", robot)
        board.linked("modbus", "state")
        device = board.line(0)
        pose_and_do1(robot, device, pose_frame(4))
    with board:
        board.until_log("link modbus: lost")
        device.send(DO1_ON)
        board.until_log("port 0: in 7 frames")
        same = [f"listen.{name}={port}" for name, port in ports.items()]
        with cell.Program("controller", "udp-server-controller.toml", same) as robot:
            board.until_log("link modbus: up (2)")
            board.until_log("link state: up (2)")
            # A pose in the controller's own words has gone through the state link since.
            device.forget()
            device.until(pose_frame(4))
            check(not Modbus(robot).coil(DO1), "what was sent while the controller was away was written after all")
            pose_and_do1(robot, device, pose_frame(4))


def refused(damage, reason):
    with cell.controller("udp-server-controller.toml") as robot:
        with Board("rs485-system.toml", robot, damage=damage) as board:
            board.until_log("nothing runs: " + reason)
            device = board.line(0)
            device.send(DO1_ON)
            device.silent(0.5)


@case("a damaged configuration is refused, the log says why, the line stays silent")
def damaged():
    refused(lambda image: image[:40] + bytes([image[40] ^ 1]) + image[41:], "the image is damaged")


@case("a cut configuration and one of another version are refused")
def cut():
    refused(lambda image: image[:-1], "the image is cut")
    refused(lambda image: image[:4] + b"\x02" + image[5:], "the image has version 2")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--firmware", required=True, type=pathlib.Path)
    parser.add_argument("--host-sim", default=ROOT / "target" / "debug" / "host-sim", type=pathlib.Path)
    parser.add_argument("--logs", default=ROOT / "target" / "qemu-logs", type=pathlib.Path)
    parser.add_argument("words", nargs="*")
    arguments = parser.parse_args()
    if not shutil.which("qemu-system-arm"):
        sys.exit("qemu-system-arm is missing: apt-get install qemu-system-arm")
    global elf
    elf = str(arguments.firmware.resolve())
    cell.host_sim = str(arguments.host_sim.resolve())
    shutil.rmtree(arguments.logs, ignore_errors=True)
    arguments.logs.mkdir(parents=True)
    cell.log_folder = arguments.logs
    chosen = [one for one in cases if not arguments.words or any(word in one[0] for word in arguments.words)]
    if not chosen:
        sys.exit("no case has one of these words in its title")
    signal.signal(signal.SIGALRM, out_of_time)
    failed = sum(not passes(number, *one) for number, one in enumerate(chosen, 1))
    print(f"{len(chosen) - failed} of {len(chosen)} passed; logs are in {arguments.logs}")
    sys.exit(1 if failed else 0)


def passes(number, title, function):
    name = f"{number:02}"
    threading.current_thread().name = name
    begin = time.monotonic()
    signal.alarm(CASE_LIMIT)
    reason = None
    try:
        function()
    except Exception as error:
        reason = str(error) if isinstance(error, Failed) else traceback.format_exc()
    finally:
        signal.alarm(0)
    print(f"{'FAIL' if reason else 'PASS'}  {title}  ({time.monotonic() - begin:.1f} s)", flush=True)
    if reason:
        print("      " + reason.strip().replace("\n", "\n      "))
        for log in sorted(cell.log_folder.glob(f"{name}-*.log")):
            lines = log.read_text(errors="replace").splitlines()
            print("      " + "\n      ".join([f"{log}:", *lines[-12:]]), flush=True)
    return reason is None


def out_of_time(*_):
    raise Failed(f"not done within {CASE_LIMIT} s")


if __name__ == "__main__":
    main()
