"""A gateway's ports of Modbus RTU with pymodbus and mbpoll (libmodbus), and the controller behind them."""

import contextlib
import pathlib
import statistics
import subprocess
import tempfile
import time

import serial
from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU

from cell import (
    PATIENCE, Command, Program, Reserved, case, check, controller, equal, gateway, link_is_up, until,
)
from rtu_server import Slaves

BAUD = 19200


@contextlib.contextmanager
def cell(config, programs=None, initial=(), bind="pty:line"):
    """A controller with programs that set its outputs, and a gateway with one port, `line`."""
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        path = pathlib.Path(folder) / "controller.toml"
        path.write_text("".join(
            f"[[program]]\nname = '{name}'\nscript = '''{script}'''\n" for name, script in (programs or {}).items()
        ))
        if "\n" in config:
            file = pathlib.Path(folder) / "gateway.toml"
            file.write_text(config)
            config = file
        with controller(path, initial) as robot, gateway(config, robot, binds={"line": bind}) as running:
            link_is_up(running, "modbus")
            yield running, robot


def registers(robot, wanted):
    """Waits until the controller's registers are these; those that are 0 are not in its statistics."""

    def found(stats):
        return all(stats["registers"].get(name, 0) == value for name, value in wanted.items())

    robot.until_stats(f"registers {wanted}", found)


def peer(running, number):
    return running.stats["ports"]["line"]["peers"][str(number)]


def until_peer(running, number, presence):
    running.until_stats(
        f"slave {number} is {presence}",
        lambda stats: stats["ports"]["line"]["peers"][str(number)]["presence"] == presence,
    )


# Every function of a master, each with a slave of its own.
EVERY_FUNCTION = """
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 1
function = "read-coils"
address = 3
every_ms = 50
read = [{ name = "a", to = "WordInputReg[1]" }, { pad = 8 }, { name = "b", to = "WordInputReg[2]" }]

[[recipe.exchange]]
slave = 2
function = "read-discrete-inputs"
address = 0
every_ms = 50
read = [{ name = "a", to = "WordInputReg[3]" }, { name = "b", to = "BitInputReg[2].5" }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 0x0100
every_ms = 50
word_order = "low-first"
read = [{ name = "a", type = "int", to = "WordInputReg[4]", scale = 0.001 }, { name = "b", type = "short", to = "WordInputReg[5]", scale = -1 }]

[[recipe.exchange]]
slave = 4
function = "read-input-registers"
address = 16
every_ms = 50
read = [{ name = "a", type = "float", to = "WordInputReg[6]" }, { name = "b", type = "byte", to = "WordInputReg[7]" }, { pad = 1 }]

[[recipe.exchange]]
slave = 5
function = "write-coil"
address = 7
on = ["start", "change"]
write = [{ name = "a", from = "WordOutputReg[1]" }]

[[recipe.exchange]]
slave = 6
function = "write-register"
address = 8
on = ["start", "change"]
write = [{ name = "a", type = "word", from = "WordOutputReg[2]" }]

[[recipe.exchange]]
slave = 6
function = "read-holding-registers"
address = 9
every_ms = 50
read = [{ name = "a", type = "word", to = "WordInputReg[8]" }]

[[recipe.exchange]]
slave = 7
function = "write-coils"
address = 0
on = ["start", "change"]
write = [{ name = "a", from = "WordOutputReg[1]" }, { pad = 8 }, { name = "b", value = 1 }]

[[recipe.exchange]]
slave = 8
function = "write-registers"
address = 0x0020
on = ["start", "change"]
write = [{ name = "a", type = "int", from = "WordOutputReg[2]" }, { name = "b", type = "word", value = 513 }]

[[recipe.exchange]]
slave = 9
function = "read-write-registers"
address = 0x0010
write_address = 0x0020
every_ms = 50
write = [{ name = "a", type = "word", from = "WordOutputReg[3]" }]
read = [{ name = "a", type = "word", to = "WordInputReg[9]" }]

[[port]]
name = "line"
bus = "modbus-rtu"
baud = 19200
recipe = "line"
timeout_ms = 1000
absent_ms = 500
on_timeout = { "WordInputReg[8]" = 99, "WordInputReg[9]" = 98 }
"""
EVERY_TABLE = {
    1: {1: {3: [1] + [0] * 8 + [1]}},
    2: {2: {0: [1, 1]}},
    # 0x0001_E240 is 123456, its low word first; 0xFF9C is -100.
    3: {3: {0x100: [0xE240, 0x0001, 0xFF9C]}},
    # 12.0 as a float; a byte and one that is skipped.
    4: {4: {16: [0x4140, 0x0000, 0x4DFF]}},
    5: {},
    6: {3: {9: [60]}},
    7: {},
    8: {},
    9: {3: {0x10: [90]}},
}
OUTPUTS = {
    "first.jspf": 'set("WordOutputReg[1]", 1); set("WordOutputReg[2]", 222); set("WordOutputReg[3]", 333);',
    "second.jspf": 'set("WordOutputReg[1]", 0); set("WordOutputReg[2]", 444); set("WordOutputReg[3]", 555);',
}


def written(slaves, coil, word, other):
    """Waits until the slaves have what the robot's outputs say."""
    wanted = {(5, 1, 7): [coil], (6, 3, 8): [word], (7, 1, 0): [coil], (9, 3, 0x20): [other]}
    for (slave, function, address), values in wanted.items():
        until(f"{values} at slave {slave}", lambda: slaves.get(slave, function, address) == values)
    until("the block of slave 8", lambda: slaves.get(8, 3, 0x20, 3) == [0, word, 513])
    equal(slaves.get(7, 1, 9), [True], "the coil of a constant")


@case("a gateway as RTU master with pymodbus's server: every function, both ways")
def master():
    with cell(EVERY_FUNCTION, OUTPUTS) as (running, robot), Command(robot) as client:
        with Slaves(running.device("line"), EVERY_TABLE) as slaves:
            registers(robot, {f"WordInputReg[{n}]": v for n, v in enumerate((1, 1, 1, 123, 100, 12, 0x4D, 60, 90), 1)})
            registers(robot, {"BitInputReg[2]": 0x20})
            # -200; then a value that no word has, which the gateway rejects.
            slaves.set(3, 3, 0x102, [0xFF38])
            slaves.set(1, 1, 3, [False])
            registers(robot, {"WordInputReg[5]": 200, "WordInputReg[1]": 0})
            slaves.set(3, 3, 0x102, [200])
            running.until_stats("a rejection", lambda stats: stats["ports"]["line"]["rejected_fields"] > 0)
            registers(robot, {"WordInputReg[5]": 200})
            slaves.set(3, 3, 0x102, [0xFF38])
            client.start("first.jspf")
            written(slaves, True, 222, 333)
            before = {slave: len(slaves.requests[slave]) for slave in (5, 7, 8)}
            client.start("second.jspf")
            written(slaves, False, 444, 555)
            # Each change of a value was one write, or two if the robot's outputs changed in two steps.
            for slave, count in before.items():
                check(1 <= len(slaves.requests[slave]) - count <= 2, f"slave {slave}: {slaves.requests[slave]}")


@case("a gateway as RTU master: a slave without power, safe values, and it comes back")
def lost_slave():
    with cell(EVERY_FUNCTION, OUTPUTS, ["initial.WordOutputReg[2]=7"]) as (running, robot):
        with Slaves(running.device("line"), EVERY_TABLE) as slaves:
            registers(robot, {"WordInputReg[8]": 60, "WordInputReg[9]": 90})
            until("the write at the start", lambda: slaves.get(6, 3, 8) == [7])
            running.until_stats("all answer", lambda stats: stats["ports"]["line"]["state"] == "working")
            slaves.stop(6)
            registers(robot, {"WordInputReg[8]": 99, "WordInputReg[9]": 90})
            until_peer(running, 6, "down")
            equal(running.stats["ports"]["line"]["state"], "silent", "the port's state")
            # Only what was asked in vain for `absent_ms` has started when it is back.
            until("an absence that is seen", lambda: peer(running, 6)["counters"]["timeouts"] >= 6)
            equal(peer(running, 9)["presence"], "up", "slave 9")
            slaves.start(6)
            equal(slaves.get(6, 3, 8), [0], "what the slave has forgotten")
            registers(robot, {"WordInputReg[8]": 60})
            until("the write of the start again", lambda: slaves.get(6, 3, 8) == [7])
            until_peer(running, 6, "up")
            running.until_stats("all answer again", lambda stats: stats["ports"]["line"]["state"] == "working")


# What the robot reads of one slave.
ONE = """
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 9
function = "read-input-registers"
address = 0
every_ms = 200
timeout_ms = 100
read = [{ name = "a", type = "word", to = "WordInputReg[1]" }, { name = "b", type = "word", to = "WordInputReg[2]" }]

[[port]]
name = "line"
bus = "modbus-rtu"
recipe = "line"
timeout_ms = 2000
"""


@case("a gateway as RTU master behind an adapter that delivers a reply in pieces, each 16 ms")
def reply_in_pieces():
    with cell(ONE) as (running, robot), serial.Serial(running.device("line"), timeout=PATIENCE) as port:
        reply = bytes([9, 4, 4, 3, 232, 1, 44])
        reply += FramerRTU.compute_CRC(reply).to_bytes(2, "big")
        for _ in range(10):
            equal(port.read(8)[:2], b"\x09\x04", "the request")
            for at in range(0, len(reply), 3):
                port.write(reply[at : at + 3])
                # The adapter's own clock: what is tested is this pause.
                time.sleep(0.016)
        registers(robot, {"WordInputReg[1]": 1000, "WordInputReg[2]": 300})
        ports = running.stats["ports"]["line"]
        check(ports["frames_in"] >= 8, f"10 replies came, and so many were taken: {ports['frames_in']}")


# A PLC writes jobs and lamps and reads values; the gateway is slave 5.
SERVED = """
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "modbus-rtu-slave"
address = 5

[[recipe.block]]
table = "holding-registers"
address = 100
fields = [
    { name = "a", type = "word", to = "WordInputReg[1]" },
    { name = "b", type = "int", to = "WordInputReg[2]" },
]

[[recipe.block]]
table = "holding-registers"
address = 103
fields = [{ name = "c", type = "word", to = "WordInputReg[3]" }]

[[recipe.block]]
table = "holding-registers"
address = 200
fields = [
    { name = "d", type = "word", from = "WordOutputReg[1]" },
    { name = "e", type = "dword", from = "WordOutputReg[2]" },
    { name = "f", type = "word", value = 513 },
]

[[recipe.block]]
table = "input-registers"
address = 0
fields = [{ name = "x", type = "float", from = "WordOutputReg[2]", scale = 0.5 }]

[[recipe.block]]
table = "coils"
address = 0
fields = [{ name = "g", to = "WordInputReg[4]" }, { pad = 8 }, { name = "h", to = "WordInputReg[5]" }]

[[recipe.block]]
table = "discrete-inputs"
address = 32
fields = [{ name = "i", from = "WordOutputReg[3]" }, { name = "j", value = 1 }]

[[port]]
name = "line"
bus = "modbus-rtu-slave"
baud = 19200
recipe = "line"
timeout_ms = 1000
on_timeout = { "WordInputReg[3]" = 99 }
"""
SERVED_OUTPUTS = ["initial.WordOutputReg[1]=11", "initial.WordOutputReg[2]=3", "initial.WordOutputReg[3]=1"]
UNIT = {"device_id": 5}


def known(client):
    until("the gateway knows the robot's outputs", lambda: not client.read_holding_registers(200, count=1, **UNIT).isError())


@contextlib.contextmanager
def plc(running):
    client = ModbusSerialClient(running.device("line"), baudrate=BAUD, timeout=PATIENCE, retries=0)
    check(client.connect(), "pymodbus did not open the line")
    with contextlib.closing(client):
        yield client


@case("a gateway as RTU slave with pymodbus's client: blocks, parts of blocks, refusals, silence")
def slave():
    with cell(SERVED, initial=SERVED_OUTPUTS) as (running, robot), plc(running) as client:
        known(client)
        read = lambda address, count: client.read_holding_registers(address, count=count, **UNIT)
        equal(read(200, 4).registers, [11, 0, 3, 513], "a block")
        equal(read(201, 2).registers, [0, 3], "a part of it")
        equal(client.read_input_registers(0, count=2, **UNIT).registers, [0x3FC0, 0], "1.5 as a float")
        equal(client.read_discrete_inputs(32, count=2, **UNIT).bits[:2], [True, True], "inputs")
        check(not client.write_registers(100, [1000, 0, 2000], **UNIT).isError(), "a block was refused")
        check(not client.write_register(103, 3000, **UNIT).isError(), "a block of one register was refused")
        check(not client.write_coils(0, [True] + [False] * 8 + [True], **UNIT).isError(), "coils were refused")
        registers(robot, {f"WordInputReg[{n}]": value for n, value in enumerate((1000, 2000, 3000, 1, 1), 1)})
        equal(read(100, 4).registers, [1000, 0, 2000, 3000], "two blocks that were written, read in one request")
        refused = {
            "a write of a part": client.write_register(100, 7, **UNIT),
            "a write of two blocks": client.write_registers(100, [7, 7, 7, 7], **UNIT),
            "a write of what is read": client.write_register(200, 7, **UNIT),
            "one coil of a block": client.write_coil(0, False, **UNIT),
            "a read beyond a block": read(203, 2),
            "a read of nothing": client.read_input_registers(9, **UNIT),
        }
        for what, reply in refused.items():
            equal(reply.exception_code, 2, what)
        equal(read(100, 4).registers, [1000, 0, 2000, 3000], "what was written after refusals")
        # Nothing is written for longer than the port's timeout.
        registers(robot, {"WordInputReg[1]": 1000, "WordInputReg[3]": 99})
        client.write_register(103, 4000, **UNIT)
        registers(robot, {"WordInputReg[3]": 4000})
        counters = peer(running, 5)["counters"]
        check(counters["refused"] >= len(refused) and counters["checksums"] == 0, f"{counters}")


@case("a gateway as RTU slave whose controller is not there: exception 4 until its values are known")
def slave_without_controller():
    with contextlib.ExitStack() as stack:
        ports = {name: stack.enter_context(Reserved()) for name in ("command", "state", "modbus")}
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="foreign-")))
        (folder / "gateway.toml").write_text(SERVED)
        (folder / "controller.toml").write_text("")
        ways = [f"controller.ports.{name}={port}" for name, port in ports.items()]
        running = stack.enter_context(Program("gateway", folder / "gateway.toml", ways, {"line": "pty:line"}))
        client = stack.enter_context(plc(running))
        read = lambda address, count: client.read_holding_registers(address, count=count, **UNIT)
        equal(read(200, 1).exception_code, 4, "an unknown value")
        equal(read(203, 1).exception_code, 4, "a constant beside an unknown value")
        equal(read(100, 1).exception_code, 4, "what nobody has written")
        equal(client.read_discrete_inputs(32, count=2, **UNIT).exception_code, 4, "an unknown input")
        listens = ["listen.udp2011=0", *(f"listen.{name}={port}" for name, port in ports.items())]
        stack.enter_context(Program("controller", folder / "controller.toml", [*listens, *SERVED_OUTPUTS]))
        known(client)
        equal(read(200, 4).registers, [11, 0, 3, 513], "the values")


@case("a gateway as RTU slave with mbpoll: libmodbus reads and writes, and prints the refusals")
def slave_of_mbpoll():
    def mbpoll(running, *arguments):
        command = ["mbpoll", "-m", "rtu", "-b", str(BAUD), "-P", "none", "-a", "5", "-0", "-1", "-o", "3"]
        device = [running.device("line")]
        at = arguments.index("--") if "--" in arguments else len(arguments)
        done = subprocess.run(
            [*command, *arguments[:at], *device, *arguments[at + 1 :]],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=PATIENCE,
        )
        values = [float(row.split(":")[1].split()[0]) for row in done.stdout.splitlines() if row.startswith("[")]
        return values, done.returncode, done.stdout

    with cell(SERVED, initial=SERVED_OUTPUTS) as (running, robot):
        until("the outputs are known", lambda: mbpoll(running, "-t", "4", "-r", "200")[1] == 0)
        equal(mbpoll(running, "-t", "4", "-r", "200", "-c", "4")[0], [11, 0, 3, 513], "a block")
        equal(mbpoll(running, "-t", "4", "-r", "202", "-c", "2")[0], [3, 513], "a part of it")
        equal(mbpoll(running, "-t", "3:float", "-B", "-r", "0")[0], [1.5], "a float, its high word first")
        equal(mbpoll(running, "-t", "1", "-r", "32", "-c", "2")[0], [1, 1], "inputs")
        equal(mbpoll(running, "-t", "4", "-r", "100", "--", "1000", "0", "2000")[1], 0, "a block is written")
        equal(mbpoll(running, "-t", "0", "-r", "0", "--", *"1000000001")[1], 0, "coils are written")
        registers(robot, {f"WordInputReg[{n}]": value for n, value in ((1, 1000), (2, 2000), (4, 1), (5, 1))})
        text = mbpoll(running, "-t", "4", "-r", "100", "--", "7")[2]
        check("Illegal data address" in text, f"a part was written: {text}")
        check("Illegal data address" in mbpoll(running, "-t", "4", "-r", "300")[2], "no refusal of an unknown address")
        registers(robot, {"WordInputReg[1]": 1000, "WordInputReg[2]": 2000})


# Slave, period in ms.
LIVE = {1: 100, 2: 100, 3: 200, 4: 200, 5: 500, 6: 1000}
DEAD = {7: 100, 8: 500}
LASTING = 30.0


@case("eight RTU slaves at 19200 bit/s, two of them dead: the others keep their periods")
def eight_slaves():
    # Two dead slaves that were asked in each period would take 1.4 times the line's time: a request takes 4 ms, and
    # nothing else is sent for its timeout of 60 ms, which is spent twice with the repetition.
    exchanges = "".join(
        f"[[recipe.exchange]]\nslave = {slave}\nfunction = 'read-input-registers'\naddress = {slave}\n"
        f"every_ms = {period}\ntimeout_ms = 60\nread = [{{ name = 'v', type = 'word', to = 'WordInputReg[{slave}]' }}]\n"
        for slave, period in {**LIVE, **DEAD}.items()
    )
    config = (
        "[controller]\naddress = '127.0.0.1'\n[[recipe]]\nname = 'line'\nkind = 'modbus-rtu'\n" + exchanges
        + f"[[port]]\nname = 'line'\nbus = 'modbus-rtu'\nbaud = {BAUD}\nrecipe = 'line'\ntimeout_ms = 3000\n"
    )
    initial = {slave: {4: {slave: [1000 + slave]}} for slave in {**LIVE, **DEAD}}
    with cell(config, bind="pty-paced:line") as (running, robot):
        with Slaves(running.device("line"), initial) as slaves:
            slaves.silent.update(DEAD)
            registers(robot, {f"WordInputReg[{slave}]": 1000 + slave for slave in LIVE})
            for slave in DEAD:
                until_peer(running, slave, "down")
            begin = time.monotonic()
            # The time itself is what is measured.
            time.sleep(LASTING)
            end = time.monotonic()
            asked = {s: [at for at, _ in list(all) if begin <= at < end] for s, all in slaves.requests.items()}
            ports = running.stats["ports"]["line"]
            rejected = {key: value for key, value in ports.items() if key.startswith("rejected") and value}
        wrong = []
        for slave, period in LIVE.items():
            times = asked[slave]
            late = sorted(abs(b - a - period / 1e3) * 1e3 for a, b in zip(times, times[1:]))
            share = len(times) * period / 1e3 / (end - begin)
            half, most = statistics.median(late), late[-1]
            missed = ports["peers"][str(slave)]["missed_periods"]
            print(
                f"      slave {slave}, each {period} ms: {len(times)} requests, {share:.1%} of them all; off its period: "
                f"median {half:.1f} ms, 99 % within {late[len(late) * 99 // 100]:.1f} ms, most {most:.1f} ms; missed {missed}"
            )
            # A busy machine delays single requests, and the next ones come in time again. It does not take a tenth
            # of all periods, nor move the median.
            if share < 0.9 or half > period / 5:
                wrong.append(slave)
        for slave, period in DEAD.items():
            share = len(asked[slave]) * 64 / 1e3 / (end - begin)
            print(f"      dead slave {slave}, each {period} ms: {len(asked[slave])} requests, {share:.1%} of the line")
            if not asked[slave] or share > 0.05:
                wrong.append(slave)
        equal(wrong, [], "slaves that are not asked as they should be")
        equal(rejected, {}, "rejected frames")
