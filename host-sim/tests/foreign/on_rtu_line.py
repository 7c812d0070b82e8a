"""proto-core's Modbus RTU slave on a pseudoterminal with pymodbus and mbpoll (libmodbus)."""

import contextlib
import os
import pathlib
import pty
import signal
import subprocess
import threading
import tty

from pymodbus.client import ModbusSerialClient

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


@case("RTU slave with pymodbus's serial client: every function, refusals, broadcast, other addresses")
def slave():
    with Line("5") as line:
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

    with Line("5") as line:
        line.until_line("ready")
        mbpoll(line, "-t", "4", "-r", "10", line.device, "7", "8", "65535")
        mbpoll(line, "-t", "4", "-r", "13", line.device, "513")
        equal(mbpoll(line, "-t", "4", "-r", "10", "-c", "4", line.device)[:2], [7, 8], "registers 10 and 11")
        equal(mbpoll(line, "-t", "4", "-r", "13", line.device), [513], "register 13")
        mbpoll(line, "-t", "0", "-r", "32", line.device, "1", "0", "1", "1")
        mbpoll(line, "-t", "0", "-r", "37", line.device, "1")
        equal(mbpoll(line, "-t", "0", "-r", "32", "-c", "6", line.device), [1, 0, 1, 1, 0, 1], "coils 32-37")
