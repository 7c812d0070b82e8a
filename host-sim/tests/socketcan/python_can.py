"""python-can on a kernel interface: python_can.py INTERFACE 3|4, a worked example."""

import sys
import time

import can


def receive(bus, identifier):
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        message = bus.recv(1)
        if message and message.arbitration_id == identifier:
            return message
    sys.exit(f"no frame with id {identifier:#x}")


def equal(message, data):
    if message.is_extended_id or message.is_remote_frame or bytes(message.data) != data:
        sys.exit(f"{message} instead of {data.hex()}")


interface, example = sys.argv[1:]
with can.Bus(interface="socketcan", channel=interface) as bus:
    if example == "3":
        bus.send(can.Message(arbitration_id=1, data=[1, 2, 3], is_extended_id=False))
        equal(receive(bus, 2), bytes([0x7D, 0x7D, 0x7D]))
    else:
        for _ in range(20):
            equal(receive(bus, 2), bytes.fromhex("EF 54 EF 3E A7 E7 D1 3E"))
        bus.send(can.Message(arbitration_id=1, data=[1], is_extended_id=False))
