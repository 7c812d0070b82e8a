"""proto-core's Modbus RTU master and slave on a pseudoterminal with pymodbus and mbpoll (libmodbus)."""

import asyncio
import contextlib
import os
import pathlib
import pty
import signal
import subprocess
import threading
import tty

from pymodbus.client import ModbusSerialClient
from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import ModbusSerialServer

import cell
from cell import PATIENCE, case, check, equal, until

BAUD = 19200


class Line:
    """The example program on one end of a pseudoterminal; what it prints, line by line."""

    def __init__(self, *arguments):
        self.near, self.far = pty.openpty()
        tty.setraw(self.far)
        self.device = os.ttyname(self.far)
        program = pathlib.Path(cell.host_sim).parent / "examples" / "modbus_rtu"
        self.process = subprocess.Popen(
            [program, *arguments], stdin=self.near, stdout=self.near, stderr=subprocess.PIPE, text=True
        )
        self.lines = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stderr:
            self.lines.append(line.rstrip("\n"))

    def until_line(self, wanted, after=0):
        until(f"the line {wanted!r}; printed: {self.lines[-10:]}", lambda: wanted in self.lines[after:])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        os.close(self.near)
        os.close(self.far)


@contextlib.contextmanager
def server(device, store):
    """pymodbus's server as slave 5 in a thread of its own."""
    loop = asyncio.new_event_loop()
    ready = threading.Event()
    context = ModbusServerContext(devices={5: store}, single=False)

    async def serve():
        running = ModbusSerialServer(context, port=device, baudrate=BAUD)
        task = asyncio.create_task(running.serve_forever())
        stop = asyncio.Event()
        loop.stop_serving = lambda: loop.call_soon_threadsafe(stop.set)
        ready.set()
        await stop.wait()
        await running.shutdown()
        await asyncio.gather(task, return_exceptions=True)

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),), daemon=True)
    thread.start()
    check(ready.wait(PATIENCE), "pymodbus's server did not start")
    try:
        yield
    finally:
        loop.stop_serving()
        thread.join(PATIENCE)
        check(not thread.is_alive(), "pymodbus's server did not stop")
        loop.close()


def block(value):
    return ModbusSequentialDataBlock(1, [value(at) for at in range(100)])


@case("RTU master with pymodbus's serial server: every function, values, coming back")
def master():
    store = ModbusDeviceContext(
        hr=block(lambda at: 1000 + at), ir=block(lambda at: 2000 + at),
        co=block(lambda at: at % 3 == 0), di=block(lambda at: at % 2 == 0),
    )
    with Line("master") as line:
        line.until_line("slave Down")
        with server(line.device, store):
            line.until_line("slave Up")
            line.until_line("0 registers [1000, 1001, 1002, 1003]")
            line.until_line("1 registers [2010, 2011]")
            line.until_line("2 coils [1, 0, 0, 1, 0, 0, 1, 0, 0, 1]")
            line.until_line("3 coils [0, 1, 0]")
            for exchange in (4, 5, 6, 7):
                line.until_line(f"{exchange} written")
            # Before or after the registers 20-22 were written, but with what it wrote itself.
            written = (f"8 registers {[1020, 1021, 1022, 0x3132]}", f"8 registers {[0x3132, 0x3334, 0x3536, 0x3132]}")
            until("FC 23's reply", lambda: any(reply in line.lines for reply in written))
            line.until_line(f"9 registers {[0x3132, 0x3334, 0x3536, 0x3132]}")
            line.until_line("10 coils [1, 0, 0, 0, 1, 1, 0, 0, 0, 1, 1, 1]")
            line.until_line("11 registers [3]")
        line.until_line("slave Down", len(line.lines))
        before = len(line.lines)
        with server(line.device, store):
            line.until_line("slave Up", before)
            line.until_line("4 written", before)


@case("RTU slave with pymodbus's serial client: every function, refusals, broadcast, other addresses")
def slave():
    with Line("slave", "5") as line:
        line.until_line("ready")
        client = ModbusSerialClient(line.device, baudrate=BAUD, timeout=1, retries=1)
        check(client.connect(), "pymodbus did not open the line")
        with contextlib.closing(client):
            ask = {"device_id": 5}
            check(not client.write_registers(0, list(range(100)), **ask).isError(), "FC 16")
            check(not client.write_register(99, 0xBEEF, **ask).isError(), "FC 6")
            equal(client.read_holding_registers(0, count=100, **ask).registers, [*range(99), 0xBEEF], "registers")
            check(not client.write_coils(0, [True, False, True] * 5, **ask).isError(), "FC 15")
            check(not client.write_coil(99, True, **ask).isError(), "FC 5")
            equal(client.read_coils(0, count=15, **ask).bits[:15], [True, False, True] * 5, "coils")
            equal(client.read_coils(99, count=1, **ask).bits[0], True, "coil 99")
            equal(client.read_holding_registers(99, count=2, **ask).exception_code, 2, "beyond the map")
            equal(client.read_input_registers(0, **ask).exception_code, 1, "FC 4")
            client.write_register(7, 77, device_id=0, no_response_expected=True)
            until("the broadcast", lambda: client.read_holding_registers(7, **ask).registers == [77])


@case("RTU slave with mbpoll: libmodbus reads and writes")
def slave_of_mbpoll():
    def mbpoll(line, *arguments):
        command = ["mbpoll", "-m", "rtu", "-b", str(BAUD), "-P", "none", "-a", "5", "-0", "-1", "-o", "3"]
        done = subprocess.run(
            [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=PATIENCE
        )
        equal(done.returncode, 0, f"mbpoll's exit code; it printed {done.stdout}")
        return [int(row.split(":")[1].split()[0]) for row in done.stdout.splitlines() if row.startswith("[")]

    with Line("slave", "5") as line:
        line.until_line("ready")
        mbpoll(line, "-t", "4", "-r", "10", line.device, "7", "8", "65535")
        mbpoll(line, "-t", "4", "-r", "13", line.device, "513")
        equal(mbpoll(line, "-t", "4", "-r", "10", "-c", "4", line.device)[:2], [7, 8], "registers 10 and 11")
        equal(mbpoll(line, "-t", "4", "-r", "13", line.device), [513], "register 13")
        mbpoll(line, "-t", "0", "-r", "32", line.device, "1", "0", "1", "1")
        mbpoll(line, "-t", "0", "-r", "37", line.device, "1")
        equal(mbpoll(line, "-t", "0", "-r", "32", "-c", "6", line.device), [1, 0, 1, 1, 0, 1], "coils 32-37")
