"""Ports 2000 and 2001 from a client that was written from their description, with plain sockets."""

import struct
import time

from cell import Command, Modbus, Stream, case, check, controller, equal, state_packet, until

CONFIG = "rs485-system-controller.toml"
BINDS = {"rs485": "pty:rs485"}


@case("port 2000: requests without a terminator, with CR LF, with parentheses")
def terminators():
    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client:
        client.ask("state", "6:0:5:2")
        client.ask("state\r\n", "6:0:5:2")
        client.ask("state()", "6:0:5:2")
        client.ask(" state \n", "6:0:5:2")
        client.ask("state\0", "6:0:5:2")
        client.ask("isprogfinish", "1")
        client.ask("speed(50)", "set success")
        client.ask("speed(0)", "set fail")
        client.ask("speed(101)", "set fail")
        client.ask("speed(0.5)", "set success")


@case("port 2000: a request byte by byte, each in a segment of its own")
def byte_by_byte():
    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client:
        for request, reply in [("speed(20)", b"set success"), ("state", b"6:0:5:2"), ("stop\r", b"stop fail")]:
            for byte in request.encode():
                client.send(bytes([byte]))
                # As somebody types; slower than the pause that ends a bare keyword.
                time.sleep(0.025)
            client.expect(reply, f"reply to {request!r}")
        client.ask("state", "6:0:5:2")


@case("port 2000: two requests in one segment are answered in order")
def pipelined():
    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client:
        client.ask("speed(50)speed(0)", "set successset fail")
        client.ask("state\r\nisprogfinish\r\n", "6:0:5:21")
        client.ask("speed(10)state", "set success6:0:5:2")
        client.ask("stop\nst", "stop fail")
        client.ask("ate\n", "6:0:5:2")


@case("port 2000: unknown and overlong commands are answered and do not close the connection")
def unknown():
    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client:
        client.ask("Stop\r\n", "unknown command")
        client.ask("stop(1)", "unknown command")
        client.ask("x" * 300 + "\r\n", "unknown command")
        client.ask("state", "6:0:5:2")


@case("port 2000: every action in its state, and fail in the wrong one")
def actions():
    def reaches(client, codes):
        def probe():
            client.send(b"state")
            reply = client.read(7)
            return reply == codes

        until(f"state {codes.decode()}", probe)

    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client:
        client.ask("resume", "resume fail")
        client.ask("pause", "pause fail")
        client.ask("shutdown", "shutdown fail")
        client.ask("run(nothing.jspf)", "run fail")
        client.send(b"getlasterror")
        text = b""
        while not text.endswith(b"\n"):
            text += client.read(1)
        number, _, message = text.decode().partition(":")
        check(int(number, 16) != 0 and len(message) > 1, f"getlasterror: {text!r}")
        client.ask("disable", "disable success")
        until("disabled", lambda: robot_state(client) == 5)
        client.ask("poweroff", "poweroff success")
        until("powered off", lambda: robot_state(client) == 4)
        client.ask("enable", "enable fail")
        client.ask("poweron", "poweron success")
        until("powered on", lambda: robot_state(client) == 5)
        client.ask("enable", "enable success")
        reaches(client, b"6:0:5:2")


def robot_state(client):
    client.send(b"state")
    return int(client.read(7).split(b":")[0])


@case("port 2000: run, pause, resume, stop of a program")
def program():
    script = "program.echo.script=let n = 0; while true { n += 1; wait_ms(10); }"
    sets = [script.replace("echo", '"echo.jspf"')]
    with controller("rs485-user-controller.toml", sets, BINDS) as robot, Command(robot) as client:
        for name in ('run(echo.jspf)', 'run("echo.jspf",70)', "run(program/echo.jspf,70)"):
            client.ask(name, "run start")
            client.ask("isprogfinish", "0")
            client.ask("run(echo.jspf)", "run fail")
            client.ask("pause", "pause success")
            until("paused", lambda: program_state(client) == 3)
            client.ask("resume", "resume success")
            until("running", lambda: program_state(client) == 2)
            client.ask("stop", "stop success")
            until("stopped", lambda: program_state(client) == 0)
            client.ask("isprogfinish", "1")


def program_state(client):
    client.send(b"state")
    return int(client.read(7).split(b":")[1])


@case("port 2001: whole packets, the same for all, each value where its description says")
def packets():
    sets = [
        "initial.WordOutputReg[1]=4711",
        "initial.FloatOutputReg[2]=2.5",
        "initial.DI[3]=true",
        "initial.AI_V[1]=5.5",
    ]
    with controller(CONFIG, sets, BINDS) as robot:
        packet = state_packet(robot)
        joints = struct.unpack_from("<6f", packet, 0)
        check(all(abs(joint) < 6.3 for joint in joints), f"joints {joints}")
        equal(packet[1448:1452], bytes([2, 6, 0, 5]), "mode, robot, program, safety state")
        equal(struct.unpack_from("<H", packet, 1312)[0], 4711, "WordOutputReg[1]")
        equal(struct.unpack_from("<f", packet, 964)[0], 2.5, "FloatOutputReg[2]")
        equal(packet[736:752], bytes([0, 0, 1] + [0] * 13), "DI1..16")
        equal(struct.unpack_from("<f", packet, 784)[0], 5.5, "AI_V1")
        with Modbus(robot) as modbus:
            modbus.client.write_coil(193, True)
            modbus.client.write_register(9, 1234)
        with Stream(robot.address("state")) as one, Stream(robot.address("state")) as other:
            packet = one.read(1468)
            equal(packet[752:755], b"\0\1\0", "DO1..3 after DO2 was written")
            equal(struct.unpack_from("<H", packet, 1250)[0], 1234, "WordInputReg[2]")
            both = [one.read(14680), other.read(14680)]
        packets = [[data[at : at + 1468] for at in range(0, len(data), 1468)] for data in both]
        check(any(packet in packets[1] for packet in packets[0]), "two clients see no packet in common")
        for packet in packets[0]:
            equal(packet[1448:1452], bytes([2, 6, 0, 5]), "the codes in each of ten packets")
