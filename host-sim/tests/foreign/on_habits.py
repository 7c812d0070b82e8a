"""Port 2000 from clients with the habits that robot code has: one socket a command, parentheses after each keyword, a
terminal, a poller beside a running program. What has really happened is asked for at the control socket."""

import json
import subprocess
import threading
import time

from cell import PATIENCE, Command, Stream, case, check, controller, equal, until

CONFIG = "rs485-user-controller.toml"
BINDS = {"rs485": "pty:rs485"}


class Control(Stream):
    """A client of the control socket (docs/control.md)."""

    def __init__(self, robot):
        super().__init__(robot.address("control"))

    def do(self, operation, **arguments):
        self.send(json.dumps({"do": operation, **arguments}).encode() + b"\n")
        line = b""
        while not line.endswith(b"\n"):
            line += self.read(1)
        answer = json.loads(line)
        check(answer["ok"], f"{operation}: {answer.get('error')}")
        return answer["result"]


@case("port 2000: power, enable and a program with parentheses after each keyword")
def parentheses():
    with controller(CONFIG, ["robot.power=off"], BINDS) as robot, Command(robot) as client, Control(robot) as control:
        control.do("upload", program="one.jspf", script="wait_ms(100);")
        client.ask("state()", "4:0:4:2")
        client.ask("poweron()", "poweron success")
        client.ask("enable()", "enable success")
        client.ask("run(one.jspf)", "run start")
        until("it has finished", lambda: asked(client, b"isprogfinish()", 1) == b"1")
        client.ask("stop()", "stop fail")
        client.ask("disable()", "disable success")
        client.ask("poweroff()", "poweroff success")


@case("port 2000: a socket for each command, fifty times")
def a_socket_each():
    with controller(CONFIG, binds=BINDS) as robot:
        for _ in range(25):
            for request, reply in [("speed(50)", "set success"), ("state", "6:0:5:2")]:
                with Command(robot) as client:
                    client.ask(request, reply)
        until("all have left", lambda: robot.stats.get("command", {}).get("open") == 0)
        equal(robot.stats["command"]["opened"], 50, "clients so far")


@case("port 2000: telnet, a line at a time")
def telnet():
    with controller(CONFIG, binds=BINDS) as robot:
        host, port = robot.address("command")
        terminal = subprocess.Popen(
            ["busybox", "telnet", host, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )
        seen = bytearray()

        def read():
            while byte := terminal.stdout.read(1):
                seen.extend(byte)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            for request, reply in [(b"state", b"6:0:5:2"), (b"speed(30)", b"set success"), (b"hello", b"unknown command")]:
                seen.clear()
                terminal.stdin.write(request + b"\n")
                until(f"{reply!r}", lambda reply=reply: reply in seen)
        finally:
            terminal.kill()
            terminal.wait(PATIENCE)
            reader.join(PATIENCE)


@case("port 2000: the state polled at 20 Hz beside a program does not change what the program does")
def polled():
    script = 'for n in 1..41 { set("WordOutputReg[1]", n); wait_ms(50); }'
    with controller(CONFIG, binds=BINDS) as robot, Command(robot) as client, Control(robot) as control:
        control.do("upload", program="work.jspf", script=script)
        stop, replies = threading.Event(), []

        def poll():
            with Command(robot) as poller:
                while not stop.wait(0.05):
                    replies.append(asked(poller, b"state", 7))

        poller = threading.Thread(target=poll)
        poller.start()
        try:
            client.ask("run(work.jspf)", "run start")
            until("it has finished", lambda: asked(client, b"isprogfinish", 1) == b"1")
        finally:
            stop.set()
            poller.join(PATIENCE)
        check(len(replies) > 10 and set(replies) <= {b"6:0:5:2", b"6:2:5:2"}, f"replies {set(replies)}")
        check(b"6:2:5:2" in replies, "the poller never saw it run")
        run = control.do("state")["last_run"]
        equal(run["outcome"], "finished", "how the program ended")
        # On an idle machine 2.000 s; each wait of a program begins when the one before is over.
        check(run["ended_s"] - run["started_s"] >= 2.0, f"it was too fast: {run}")
        equal(robot.stats["command"]["refusals"], 0, "refused commands")


def asked(client, request, length):
    """The reply, which has this length."""
    client.send(request)
    return client.read(length)
