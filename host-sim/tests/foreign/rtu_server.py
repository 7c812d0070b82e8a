"""pymodbus's serial server with several slaves, each of which can fall silent."""

import asyncio
import threading
import time

from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.simulator.simruntime import SimRuntime

from cell import PATIENCE, check

# A function to the place of its table in a device's data.
TABLES = {1: 0, 5: 0, 15: 0, 2: 1, 3: 2, 6: 2, 16: 2, 23: 2, 4: 3}
# Coils and registers of each table of a slave, from 0.
SIZES = (64, 64, 512, 512)


class Slaves:
    """Slaves on one end of a line. `initial` has values by slave and function: `{9: {3: {0x10: [1, 2]}}}`."""

    def __init__(self, device, initial, baud=19200):
        self.initial = initial
        self.silent = set()
        # The requests to each slave in the order of their arrival: time, function.
        self.requests = {slave: [] for slave in initial}
        self._device, self._baud = device, baud

    def _new(self, slave):
        tables = [[0] * size for size in SIZES]
        for function, blocks in self.initial[slave].items():
            for address, values in blocks.items():
                tables[TABLES[function]][address : address + len(values)] = values
        kinds = (DataType.BITS, DataType.BITS, DataType.REGISTERS, DataType.REGISTERS)
        values = [[bool(bit) for bit in table] if kind == DataType.BITS else table for kind, table in zip(kinds, tables)]
        return SimDevice(slave, simdata=tuple([SimData(0, values=v, datatype=k)] for v, k in zip(values, kinds)))

    def stop(self, slave):
        """The slave loses its power."""
        self.silent.add(slave)

    def start(self, slave):
        """It has its power again, and has forgotten what was written."""
        self._server.context.devices[slave] = SimRuntime(self._new(slave))
        self.silent.discard(slave)

    def set(self, slave, function, address, values):
        """Changes what a master reads."""
        self._do(self._server.async_setValues(slave, function, address, values))

    def get(self, slave, function, address, count=1):
        """What a master has written."""
        return self._do(self._server.async_getValues(slave, function, address, count))

    def _do(self, work):
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE)

    def _pdu(self, is_sent, pdu):
        if not is_sent and pdu.dev_id in self.requests:
            self.requests[pdu.dev_id].append((time.monotonic(), pdu.function_code))
        return pdu

    def _packet(self, is_sent, data):
        # What a slave without power does not say.
        return b"" if is_sent and data[:1] and data[0] in self.silent else data

    def __enter__(self):
        self._loop = asyncio.new_event_loop()
        ready = threading.Event()

        async def serve():
            self._server = ModbusSerialServer(
                [self._new(slave) for slave in self.initial], port=self._device, baudrate=self._baud,
                trace_pdu=self._pdu, trace_packet=self._packet,
            )
            task = asyncio.create_task(self._server.serve_forever())
            self._stop = asyncio.Event()
            ready.set()
            await self._stop.wait()
            await self._server.shutdown()
            await asyncio.gather(task, return_exceptions=True)

        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(serve(),), daemon=True)
        self._thread.start()
        check(ready.wait(PATIENCE), "pymodbus's server did not start")
        return self

    def __exit__(self, *_):
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(PATIENCE)
        check(not self._thread.is_alive(), "pymodbus's server did not stop")
        self._loop.close()
