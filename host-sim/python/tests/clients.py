"""The least that a client of port 2001 and of Modbus has to know, for the tests."""

import socket
import struct

PACKET_BYTES = 1468


class ModbusException(Exception):
    def __init__(self, code):
        super().__init__(f"exception {code}")
        self.code = code


class Modbus:
    """A Modbus TCP client; works as ``with Modbus(address) as modbus:``."""

    def __init__(self, address):
        self._socket = socket.create_connection(address, timeout=10)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()

    def read_registers(self, address, count):
        data = self._ask(struct.pack(">BHH", 3, address, count))
        return list(struct.unpack(f">{count}H", data[1:]))

    def read_coil(self, address):
        return bool(self._ask(struct.pack(">BHH", 1, address, 1))[1])

    def write_register(self, address, value):
        self._ask(struct.pack(">BHH", 6, address, value))

    def write_coil(self, address, on):
        self._ask(struct.pack(">BHH", 5, address, 0xFF00 if on else 0))

    def _ask(self, pdu):
        self._socket.sendall(struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu)
        head = receive(self._socket, 7)
        answer = receive(self._socket, struct.unpack(">H", head[4:6])[0] - 1)
        if answer[0] & 0x80:
            raise ModbusException(answer[1])
        return answer[1:]


def receive(connection, count):
    """Exactly so many bytes."""
    received = b""
    while len(received) < count:
        piece = connection.recv(count - len(received))
        if not piece:
            raise ConnectionError("closed")
        received += piece
    return received


def digital_input(packet, nth):
    """DI ``nth`` in a state packet."""
    return bool(packet[736 + nth - 1])
