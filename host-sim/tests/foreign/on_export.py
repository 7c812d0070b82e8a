"""Exports, captures and recordings as the tools read them that they are for: cantools, tshark, mcap."""

import csv
import http.server
import io
import json
import os
import pathlib
import random
import re
import shutil
import struct
import subprocess
import tempfile
import threading
import tomllib

import cantools
from mcap.reader import make_reader

import cell
import on_dbc
from cell import CONFIGS, Failed, Stream, case, check, equal

TEMPLATES = CONFIGS.parent / "templates"
ROUNDS = 8


def host_sim(*arguments):
    done = subprocess.run([cell.host_sim, *map(str, arguments)], capture_output=True, text=True, timeout=60)
    if done.returncode or done.stderr:
        raise Failed(f"host-sim {' '.join(map(str, arguments))}: {done.stderr or done.stdout}")
    return done.stdout


def database(path):
    # Strict: no signal may be outside of its message, or on top of another.
    return cantools.database.load_string(host_sim("export", "dbc", path), "dbc", strict=True)


def unmangled(identifier):
    """The name of an identifier (docs/export.md)."""
    token = re.compile(r"_x([0-9a-f]+)_|_([0-9]+)_|__")

    def name(match):
        if match[1]:
            return chr(int(match[1], 16))
        return f"[{match[2]}]" if match[2] else "-"

    return token.sub(name, identifier)


def any_value(signal, chance):
    if signal.is_float:
        layout = "<f" if signal.length == 32 else "<d"
        return struct.unpack(layout, struct.pack(layout, chance.uniform(-1e6, 1e6)))[0]
    return on_dbc.any_value(signal, chance)


@case("CAN databases of every example and template: cantools decodes what encode makes")
def examples():
    chance, seen, skipped = random.Random(12), 0, []
    for path in sorted([*CONFIGS.glob("*.toml"), *TEMPLATES.glob("*.toml")]):
        config = tomllib.loads(path.read_text())
        if not any(port["bus"] == "can" for port in config.get("port", [])):
            continue
        for message in database(path).messages:
            recipe, _, rest = message.comment.removeprefix("recipe ").partition(", ")
            roles = rest.rpartition(", port ")[0].split(", ")
            if roles not in (["input"], ["output"]):
                skipped.append(message.name)
                continue
            for _ in range(ROUNDS):
                values = {}
                for signal in message.signals:
                    always = re.search(r"always (-?[0-9]+)", signal.comment or "")
                    values[signal.name] = int(always[1]) if always else any_value(signal, chance)
                tokens = [f"{unmangled(name)}={value!r}" for name, value in values.items()]
                arguments = ["--recipe", recipe, "--part", roles[0], "--id", hex(message.frame_id)]
                line = host_sim("encode", path, *arguments, *tokens)
                data = bytes.fromhex(line.strip().split("#")[1])
                decoded = message.decode(data, decode_choices=False, scaling=False)
                equal({name: decoded[name] for name in values}, values, f"{path.name} {message.name} {data.hex()}")
                seen += 1
    check(seen >= 80, f"only {seen} frames were compared")
    # Those of CANopen, which the case of SDO looks at.
    check(all(name.startswith(("encoder__", "keypad__")) for name in skipped), f"skipped: {skipped}")


@case("a CAN database made of a file that was made of a CAN database: the same values")
def round_trip():
    source = cantools.database.load_string(on_dbc.DBC, "dbc")
    chance = random.Random(2012)
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        path = pathlib.Path(folder) / "dbc.toml"
        port = '\n[[port]]\nname = "bus"\nbus = "can"\nrecipe = "dbc"\n'
        path.write_text(on_dbc.file(source) + port)
        made = database(path)
    equal({m.frame_id for m in made.messages}, {m.frame_id for m in source.messages}, "ids")
    for _ in range(400):
        message = chance.choice(source.messages)
        number, used = chance.choice(on_dbc.frames(message))
        values = {s.name: number if s.is_multiplexer else on_dbc.any_value(s, chance) for s in used}
        data = message.encode(values, scaling=False)
        other = made.get_message_by_frame_id(message.frame_id)
        equal(other.is_extended_frame, message.is_extended_frame, "extended")
        found = other.decode(data, decode_choices=False, scaling=False)
        equal({name: found.get(name) for name in values}, values, f"{message.name} {data.hex()}")


@case("a CAN database of CANopen's SDO: replies and refusals told apart by two constants")
def multiplexed():
    made = database(CONFIGS / "canopen-encoder.toml")
    reply = made.get_message_by_frame_id(0x585)
    errors = reply.decode(bytes.fromhex("4F01100007000000"), decode_choices=False)
    equal(errors.get("errors"), 7, "the error register")
    refused = reply.decode(bytes.fromhex("8017100000000206"), decode_choices=False)
    equal(refused.get("why"), 0x06020000, "why it was refused")
    request = made.get_message_by_frame_id(0x605)
    asked = request.decode(bytes.fromhex("2B17100064000000"), decode_choices=False)
    equal(asked.get("milliseconds__request__1__4119"), 100, "the heartbeat's time")
    equal(made.get_message_by_frame_id(0x77F).cycle_time, 200, "the cycle of the gateway's heartbeat")
    equal(made.get_message_by_frame_id(0).cycle_time, 1000, "the period of the start")
    panel = database(CONFIGS / "can-panel.toml").get_message_by_frame_id(0x181)
    equal(str(panel.get_signal_by_name("start").choices[1]), "run(pick.jspf,50)", "the name of a value")


def tshark(capture, plugin, shown, *fields):
    if not shutil.which("tshark"):
        raise Failed("tshark is not installed")
    arguments = ["tshark", "-n", "-X", f"lua_script:{plugin}", "-r", str(capture), "-Y", shown, "-T", "fields"]
    for field in fields:
        arguments += ["-e", field]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    check(done.returncode == 0 and "Lua: Error" not in done.stderr, done.stderr)
    return [line.split("\t") for line in done.stdout.splitlines()]


@case("a capture of a serial line and of CAN, in tshark with our plugin: fields by name")
def captured():
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        folder = pathlib.Path(folder)
        # Serial: three good frames, noise, and a wrong tail.
        capture, plugin = folder / "line.pcapng", folder / "line.lua"
        with cell.controller("rs485-system-controller.toml", binds={"rs485": "pty:robot"}) as robot:
            extra = ["--capture", str(capture), "--capture-links"]
            with cell.gateway("rs485-system.toml", robot, binds={"rs485-1": "tcp-listen:127.0.0.1:0"}, extra=extra) as running:
                cell.link_is_up(running, "modbus", "state")
                with Stream(running.address("rs485-1")) as line:
                    for value in (1, 0, 3):
                        line.send(bytes([0xFF, 0xFF, value, 0xEE, 0xEE]))
                    line.send(bytes.fromhex("FF FF 01 EE 00 12 34"))
                    line.send(bytes([0xFF, 0xFF, 5, 0xEE, 0xEE]))
                    running.until_stats("four frames", lambda stats: stats["ports"]["rs485-1"]["frames_in"] >= 4)
                    running.until_stats("the pose", lambda stats: stats["ports"]["rs485-1"]["frames_out"] >= 4)
        host_sim("export", "lua", CONFIGS / "rs485-system.toml", "-o", plugin)
        value = "rgw.system.input.DigitalOutputCommand_1_"
        rows = tshark(capture, plugin, value, "frame.interface_name", "rgw.recipe", "rgw.frame", value)
        equal(rows, [["rs485-1", "system", "input", str(v)] for v in (1, 0, 3, 5)], "the frames in")
        rejected = tshark(capture, plugin, "rgw.no_frame", "frame.comment", "frame.packet_flags_direction")
        check(rejected and rejected[0] == ["rejected: no frame found", "0x00000001"], f"rejected: {rejected}")
        pose = tshark(capture, plugin, "rgw.system.output.RobotState_8_", "rgw.system.output.RobotState_8_", "frame.packet_flags_direction")
        check(pose, "no frame of the pose")
        check(all(abs(float(angle) + 0.5436893) < 1e-6 and way == "0x00000002" for angle, way in pose), f"pose: {pose[:3]}")
        links = {row[0] for row in tshark(capture, plugin, "frame", "frame.interface_name")}
        check({"link modbus", "link state"} <= links, f"interfaces: {links}")
        # CAN.
        capture, plugin = folder / "can.pcapng", folder / "can.lua"
        with cell.controller("can-user-controller.toml", binds={"can": "slcan-tcp:127.0.0.1:0"}) as robot:
            binds = {"hand": "slcan-tcp:127.0.0.1:0"}
            with cell.gateway("can-hand.toml", robot, binds=binds, extra=["--capture", str(capture)]) as running:
                with Stream(running.address("hand")) as bus:
                    bus.send(b"S8\rO\r")
                    bus.send(b"t502402001027\r")
                    bus.send(b"t1232AABB\r")
                    running.until_stats("a frame", lambda stats: stats["ports"]["hand"]["frames_in"] >= 1)
        host_sim("export", "lua", CONFIGS / "can-hand.toml", "-o", plugin)
        fields = [f"rgw.hand.input.{name}" for name in ("state", "error", "grip")]
        equal(tshark(capture, plugin, fields[0], "can.id", *fields), [["1282", "2", "0", "10000"]], "the hand's frame")
        foreign = tshark(capture, plugin, "can.id == 0x123", "frame.comment")
        equal(foreign, [["rejected: a CAN id that the recipe does not have"]], "a foreign frame")


def messages(path):
    with open(path, "rb") as file:
        return [(schema, channel, message) for schema, channel, message in make_reader(file).iter_messages()]


@case("a recording as the package mcap reads it: values by name with their schema")
def recorded():
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        with cell.controller("can-user-controller.toml", binds={"can": "slcan-tcp:127.0.0.1:0"}) as robot:
            binds = {"hand": "slcan-tcp:127.0.0.1:0"}
            with cell.gateway("can-hand.toml", robot, binds=binds, extra=["--record", folder]) as running:
                with Stream(running.address("hand")) as bus:
                    bus.send(b"S8\rO\r")
                    for state in range(3):
                        bus.send(b"t50240%d001027\r" % state)
                    bus.send(b"t5023010010\r")
                    running.until_stats("three frames", lambda stats: stats["ports"]["hand"]["frames_in"] >= 3)
        (path,) = pathlib.Path(folder).glob("*.mcap")
        found = messages(path)
        of = {topic: [m for _, c, m in found if c.topic == topic] for topic in {c.topic for _, c, _ in found}}
        values = [json.loads(message.data) for message in of["/hand/input/502"]]
        equal(values, [{"state": n, "error": 0, "grip": 10000} for n in range(3)], "the hand's frames")
        (rejected,) = [json.loads(message.data) for message in of["/hand/rejected"]]
        equal((rejected["why"], rejected["id"]), ("a frame of another length", 0x502), "a short frame")
        schema = next(s for s, c, _ in found if c.topic == "/hand/input/502")
        equal(schema.encoding, "jsonschema", "the encoding of the schema")
        properties = json.loads(schema.data)["properties"]
        equal(properties["grip"]["type"], "integer", "a property")
        equal([m.sequence for m in of["/engine"]], list(range(1, len(of["/engine"]) + 1)), "the engine's calls")
        check("the same to the end" in host_sim("replay", folder), "replay")


class Api(http.server.BaseHTTPRequestHandler):
    """A gateway's API that has a capture."""

    protocol_version = "HTTP/1.1"
    capture = b""

    def do_GET(self):
        found = self.path == "/api/v1/capture.pcapng"
        self.send_response(200 if found else 404)
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        for part in (self.capture[:100], self.capture[100:]):
            self.wfile.write(b"%x\r\n%s\r\n" % (len(part), part))
        self.wfile.write(b"0\r\n\r\n")

    def log_message(self, *_):
        pass


# tshark looks for programs in its own folder; here they are in another one with that name.
EXTCAP = """set -e
folder=$(tshark -G folders 2>/dev/null | sed -n 's/^\\(Global \\)\\?Extcap path:[[:space:]]*//Ip' | tail -1)
mount -t tmpfs extcap "$folder"
ln -s "$1" "$folder/host-sim-extcap"
tshark -D 2>/dev/null
tshark -n -X "lua_script:$2" -i rgw -c 3 -T fields -e frame.interface_name -e "$3" 2>/dev/null
"""


@case("tshark lists a running gateway among its interfaces, and captures from it")
def extcap():
    frames = [("rs485-1", 1, bytes([0xFF, 0xFF, value, 0xEE, 0xEE])) for value in (1, 0, 3)]
    Api.capture = capture_of(frames)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Api) as server, tempfile.TemporaryDirectory() as folder:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        ready, plugin = pathlib.Path(folder) / "ready.json", pathlib.Path(folder) / "cell.lua"
        ready.write_text(json.dumps({"console": f"127.0.0.1:{server.server_port}"}))
        host_sim("export", "lua", CONFIGS / "rs485-system.toml", "-o", plugin)
        field = "rgw.system.input.DigitalOutputCommand_1_"
        command = ["unshare", "-rm", "sh", "-c", EXTCAP, "sh", cell.host_sim, plugin, field]
        environment = {**os.environ, "RGW_READY": str(ready), "HOME": folder}
        done = subprocess.run(command, capture_output=True, text=True, timeout=40, env=environment)
        server.shutdown()
    check("rgw (Recipe gateway)" in done.stdout, f"interfaces: {done.stdout} {done.stderr}")
    equal(done.stdout.splitlines()[-3:], [f"rs485-1\t{value}" for value in (1, 0, 3)], "the packets")


def block(kind, body):
    body += bytes(-len(body) % 4)
    return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)


def option(code, value):
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


def capture_of(packets):
    """A capture that no program of ours has made: interface, direction and bytes of each packet."""
    text = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    ports = sorted({port for port, _, _ in packets})
    for port in ports:
        text += block(1, struct.pack("<HHI", 147, 0, 0) + option(2, port.encode()) + option(0, b""))
    for nth, (port, direction, data) in enumerate(packets):
        head = struct.pack("<IIIII", ports.index(port), 0, nth, len(data), len(data))
        options = option(2, struct.pack("<I", direction)) + option(0, b"")
        text += block(6, head + data + bytes(-len(data) % 4) + options)
    return text


# Numbers in every order, digits, characters, bits, lengths, checksums, escape bytes, exchanges.
SERIAL = ("force-sensor-crc", "gripper", "modbus-line", "datalogic-quickscan", "mettler-toledo-sics", "witmotion-imu")
# Of a slave, which receives requests and sends the rest.
SLAVES = ("siemens-s7-1200",)


def value_for(kind, nth):
    if kind.startswith("text"):
        return "A" * int(kind.removeprefix("text of ")) if " of " in kind else "AB"
    return 2.5 if kind.startswith(("float", "double")) else nth % 2


@case("the dissector in Lua and decode see the same in serial frames of every kind")
def dissected():
    compared, fields_seen = 0, 0
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        folder = pathlib.Path(folder)
        for name in SERIAL + SLAVES:
            path = CONFIGS / f"{name}.toml"
            path = path if path.exists() else TEMPLATES / f"{name}.toml"
            frames = {}
            for row in csv.DictReader(io.StringIO(host_sim("export", "map", path, "--format", "csv"))):
                field, _, kind = row["field"].partition(" (")
                if field:
                    key = (row["port"], row["recipe"], row["frame"])
                    frames.setdefault(key, {})[field] = kind.removesuffix(")")
            packets, expected = [], []
            for (port, recipe, role), kinds in frames.items():
                part, _, number = role.partition("-")
                which = ["--recipe", recipe, "--part", part, *(["--exchange", number] if number else [])]
                tokens = [f"{field}={value_for(kind, nth)}" for nth, (field, kind) in enumerate(kinds.items())]
                done = subprocess.run([cell.host_sim, "encode", path, *which, *tokens], capture_output=True, text=True)
                if done.returncode:
                    continue
                shown = host_sim("decode", path, *which, *done.stdout.split()).split()
                shown = dict(token.split("=", 1) for token in shown if "=" in token and not token.startswith("raw="))
                sent = part in ("output", "request") if name in SERIAL else part in ("reply", "refusal")
                packets.append((port, 2 if sent else 1, bytes.fromhex(done.stdout)))
                expected.append((role, shown, done.stdout.strip()))
            capture, plugin = folder / f"{name}.pcapng", folder / f"{name}.lua"
            capture.write_bytes(capture_of(packets))
            host_sim("export", "lua", path, "-o", plugin)
            arguments = ["tshark", "-n", "-X", f"lua_script:{plugin}", "-r", str(capture), "-T", "json"]
            done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
            check(done.returncode == 0 and "Lua: Error" not in done.stderr, f"{name}: {done.stderr}")
            packets = json.loads(done.stdout)
            equal(len(packets), len(expected), f"{name}: packets")
            for packet, (role, shown, data) in zip(packets, expected):
                tree = packet["_source"]["layers"].get("rgw", {})
                # Requests and refusals of several exchanges may have the same bytes.
                equal(str(tree.get("rgw.frame")).split("-")[0], role.split("-")[0], f"{name}: the frame of {data}")
                found = {unmangled(key.split(".")[3]): value for key, value in tree.items() if key.count(".") == 3}
                for field, value in shown.items():
                    seen = found.get(field)
                    same = seen == value.strip('"') or seen is not None and is_number(seen) and is_number(value) and float(seen) == float(value)
                    check(same, f"{name} {role} {field}: tshark {seen!r}, decode {value!r}, of {data}")
                    fields_seen += 1
                compared += 1
    check(compared >= 12 and fields_seen >= 40, f"only {compared} frames with {fields_seen} fields were compared")


def is_number(text):
    try:
        float(text)
        return True
    except ValueError:
        return False
