"""A gateway as an edge node of Sparkplug B, behind Debian's mosquitto, read with the classes of pysparkplug."""

import pathlib
import socket
import subprocess
import tempfile

import serial
from pysparkplug import DataType
from pysparkplug._protobuf import Payload

from cell import PATIENCE, case, check, controller, equal, gateway, link_is_up, until

FILE = """
[broker]
address = "127.0.0.1:{port}"
plain = true
[node]
group = "hall"
name = "press"
[report]
sample_ms = 100
interval_ms = 100
[[rule]]
values = "RobotState[8..11]"
dead_band = 0.25
"""


def free_port():
    with socket.socket() as any_port:
        any_port.bind(("127.0.0.1", 0))
        return any_port.getsockname()[1]


class Broker:
    """A broker, and a client of it that reads everything."""

    def __init__(self):
        self.port = free_port()
        self.folder = tempfile.TemporaryDirectory(prefix="foreign-")
        path = pathlib.Path(self.folder.name)
        (path / "mosquitto.conf").write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\nuser root\n")
        (path / "sparkplug.toml").write_text(FILE.format(port=self.port))
        self.file = str(path / "sparkplug.toml")
        self.lines = path / "messages"

    def __enter__(self):
        command = ["mosquitto", "-c", f"{self.folder.name}/mosquitto.conf"]
        self.broker = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until("the broker", self.listens)
        command = ["stdbuf", "-oL", "mosquitto_sub", "-d", "-p", str(self.port), "-t", "spBv1.0/#", "-F", "%t %x"]
        with self.lines.open("wb") as lines:
            self.client = subprocess.Popen(command, stdout=lines, stderr=subprocess.DEVNULL)
        until("the subscription", lambda: "Subscribed" in self.lines.read_text())
        return self

    def __exit__(self, *_):
        for process in (self.client, self.broker):
            process.kill()
            process.wait()

    def listens(self):
        try:
            socket.create_connection(("127.0.0.1", self.port), PATIENCE).close()
            return True
        except OSError:
            return False

    def messages(self):
        """Verb, device and payload of each message so far."""
        messages = []
        # A line may be half written.
        for line in self.lines.read_text().rpartition("\n")[0].splitlines():
            if line.startswith("spBv1.0/"):
                topic, _, text = line.partition(" ")
                payload = Payload()
                payload.ParseFromString(bytes.fromhex(text))
                equal(payload.ByteSize(), len(text) // 2, f"bytes of {topic} as others write it")
                _, _, verb, _, *device = topic.split("/")
                messages.append((verb, *(device or [None]), payload))
        return messages


def value_of(metric):
    return None if metric.is_null else getattr(metric, metric.WhichOneof("value"))


def last_values(messages):
    """The newest value of each metric, by owner and name; sequence numbers, aliases and types are checked."""
    values, aliases, seq = {}, {}, None
    for verb, device, payload in messages:
        if verb == "NDEATH":
            check(not payload.HasField("seq"), "NDEATH has a sequence number")
            continue
        equal(payload.seq, 0 if verb == "NBIRTH" else (seq + 1) % 256, f"sequence number of {verb}")
        seq = payload.seq
        for metric in payload.metrics:
            if verb.endswith("BIRTH"):
                check(DataType(metric.datatype) in DataType, metric.name)
                name = metric.name
                if metric.HasField("alias"):
                    aliases[metric.alias] = (device, name)
            else:
                check(not metric.HasField("datatype") and not metric.HasField("name"), "data has names")
                owner, name = aliases[metric.alias]
                equal(owner, device, name)
            values[device, name] = value_of(metric)
    return values


@case("an edge node of Sparkplug B, payloads of pysparkplug: births, data, death")
def births_and_data():
    with Broker() as broker, controller("rs485-system-controller.toml", binds={"rs485": "pty:rs485"}) as robot:
        extra = ["--sparkplug", broker.file]
        with gateway("rs485-system.toml", robot, binds={"rs485-1": "pty:rs485-1"}, extra=extra) as running:
            link_is_up(running, "modbus")
            with serial.Serial(running.device("rs485-1"), baudrate=115200, timeout=PATIENCE) as field:
                key = ("rs485-1", "DigitalOutputCommand/1")

                def is_told(wanted):
                    field.write(bytes([0xFF, 0xFF, wanted, 0xEE, 0xEE]))
                    return last_values(broker.messages()).get(key) == wanted

                for wanted in (1, 6, 0x80):
                    until(f"the value {wanted}", lambda: is_told(wanted))
            messages = broker.messages()
            equal(messages[0][0], "NBIRTH", "the first message")
            values = last_values(messages)
            for name in ("controller/mode", "Node Info/Version", "gateway/health"):
                check(values[None, name], name)
            equal(values[None, "Node Control/Rebirth"], False, "the request for births")
            birth = messages[0][2]
            pose = next(metric for metric in birth.metrics if metric.name == "controller/RobotState/8")
            properties = dict(zip(pose.properties.keys, pose.properties.values))
            equal(properties["engUnit"].string_value, "m", "unit")
        until("the death", lambda: broker.messages()[-1][0] == "NDEATH")
        equal(value_of(broker.messages()[-1][2].metrics[0]), 0, "bdSeq of the death")
