"""A gateway on a CANopen bus with a node of the package canopen: SDO, NMT, PDO, heartbeats."""

import contextlib
import threading

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from cell import Modbus, case, check, controller, equal, gateway, link_is_up, until
from on_can import join

NODE = 5
BUS = {"encoder": "slcan-tcp:127.0.0.1:0"}
ROBOT_PORT = {"rs485": "pty:rs485"}
# WordInputReg[1] and the next ones: position, state of the node, error register.
FIRST = 8


def dictionary():
    """The objects of an encoder as CiA 406 has them, as far as the gateway uses them."""
    objects = canopen.ObjectDictionary()

    def add(index, name, kind, default=0):
        variable = ODVariable(name, index)
        variable.data_type, variable.access_type, variable.default = kind, "rw", default
        variable.pdo_mappable = True
        objects.add_object(variable)

    add(0x1001, "Error register", datatypes.UNSIGNED8)
    add(0x1017, "Producer heartbeat time", datatypes.UNSIGNED16)
    add(0x6004, "Position value", datatypes.UNSIGNED32)
    add(0x6200, "Cyclic timer", datatypes.UNSIGNED16)
    return objects


class Encoder:
    """Node 5: after NMT start it sends its position with the period of its cyclic timer."""

    def __init__(self, running):
        self.network = canopen.Network()
        self.network.bus = join(running, "encoder")
        self.network.connect()
        self.node = self.network.create_node(NODE, dictionary())
        self.node.set_data(0x1001, 0, bytes([0]))
        self.written = []
        self.node.add_write_callback(lambda index, subindex, od, data: self.written.append((index, bytes(data))))
        self.heard = []
        self.network.subscribe(0x77F, lambda identifier, data, at: self.heard.append(bytes(data)))
        self.position = 0
        self.over = threading.Event()
        # What each node says when it has booted (CiA 301), and the package does not.
        self.network.send_message(0x700 + NODE, bytes([0]))
        self.node.nmt.state = "PRE-OPERATIONAL"
        self.sender = threading.Thread(target=self._send, daemon=True)
        self.sender.start()

    def _send(self):
        while not self.over.wait(0.01):
            if self.node.nmt.state == "OPERATIONAL":
                self.network.send_message(0x180 + NODE, self.position.to_bytes(4, "little"))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.over.set()
        self.sender.join()
        self.node.nmt.stop_heartbeat()
        self.network.disconnect()


CONFIGURED = {(0x1017, (100).to_bytes(2, "little")), (0x6200, (10).to_bytes(2, "little"))}


def is_running(encoder):
    """The gateway has configured the node, and started it behind that."""
    until("both objects written by SDO", lambda: CONFIGURED <= set(encoder.written))
    until("the node's start by NMT", lambda: encoder.node.nmt.state == "OPERATIONAL")


@contextlib.contextmanager
def cell():
    with controller("rs485-system-controller.toml", binds=ROBOT_PORT) as robot, Modbus(robot) as modbus:
        with gateway("canopen-encoder.toml", robot, binds=BUS) as running:
            link_is_up(running, "modbus")
            yield running, modbus


@case("a CANopen node of the package canopen: configured, started, its position in the robot's registers")
def node():
    with cell() as (running, modbus):
        with Encoder(running) as encoder:
            is_running(encoder)
            encoder.position = 0x12345678
            modbus.until_registers(FIRST, [0x5678, 0x1234, 5, 0])
            encoder.node.set_data(0x1001, 0, bytes([0x21]))
            encoder.position = 3
            modbus.until_registers(FIRST, [3, 0, 5, 0x21])
            until("the gateway's own heartbeat", lambda: len(encoder.heard) >= 3)
            equal(set(encoder.heard), {bytes([5])}, "its data")
            counters = running.stats["ports"]["encoder"]
            check(counters["refused"] == 0, f"refused: {counters}")


@case("a CANopen node that dies and comes back: safe value, then configured and started again")
def restarted_node():
    with cell() as (running, modbus):
        with Encoder(running) as encoder:
            is_running(encoder)
            encoder.position = 7
            modbus.until_registers(FIRST, [7, 0, 5])
        modbus.until_registers(FIRST + 2, [255])
        with Encoder(running) as encoder:
            is_running(encoder)
            encoder.position = 9
            modbus.until_registers(FIRST, [9, 0, 5])


@case("a CANopen node whose heartbeat alone fails: its state is the safe value, its position goes on")
def no_heartbeat():
    with cell() as (running, modbus):
        with Encoder(running) as encoder:
            is_running(encoder)
            encoder.position = 11
            modbus.until_registers(FIRST, [11, 0, 5])
            encoder.node.nmt.stop_heartbeat()
            modbus.until_registers(FIRST + 2, [255])
            encoder.position = 12
            modbus.until_registers(FIRST, [12, 0, 255])
