#!/usr/bin/env python3
"""Installs a package of make_deb.py into a folder, and runs its gateway with the rights of the service.

    python3 try_deb.py PACKAGE [--runs-with COMMAND]

systemd judges the unit; its service manager does not run here, so its part is played: the user, the capabilities,
the environment, and the socket that it is told things on. COMMAND runs binaries of another architecture: they are
installed, started and ended, as the own user. Needs root, Python 3.11, dpkg, systemd-analyze, setpriv and chrt.
"""

import argparse
import json
import os
import pathlib
import shlex
import signal
import socket
import subprocess
import tempfile

UNIT = "usr/lib/systemd/system/recipe-gateway@.service"
CELL = "press"
# What a service that may use serial devices, CAN interfaces and real-time scheduling needs; 0 is best, 10 is worst.
EXPOSURE = 2.5
NOBODY = 65534
SYS_NICE = 1 << 23
PATIENCE = 20


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=pathlib.Path)
    parser.add_argument("--runs-with", type=shlex.split, default=[])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="deb.") as folder:
        top = pathlib.Path(folder)
        # The service's user has to come in.
        top.chmod(0o755)
        root = top / "root"
        install(arguments.package, root)
        if not arguments.runs_with:
            judge(root)
        run(root, top, arguments.runs_with)
        remove(root)
    print(f"{arguments.package.name}: installed, run and removed")


def install(package, root):
    for place in ("var/lib/dpkg/info", "var/lib/dpkg/updates", "var/lib/dpkg/triggers", "var/log"):
        (root / place).mkdir(parents=True)
    for place in ("status", "available"):
        (root / "var/lib/dpkg" / place).touch()
    dpkg(root, "-i", package)
    for place in ("usr/bin/host-sim", UNIT, "etc/recipe-gateway", "usr/share/doc/recipe-gateway/copyright"):
        assert (root / place).exists(), place
    listed = dpkg(root, "-V", "recipe-gateway")
    assert not listed, f"files differ from the package:\n{listed}"


def remove(root):
    """A cell's own files stay, and nothing of the package."""
    dpkg(root, "--purge", "recipe-gateway")
    left = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
    left = {path for path in left if not path.startswith("var/")}
    assert left == {f"etc/recipe-gateway/{CELL}.toml", f"etc/recipe-gateway/{CELL}.env"}, left


def dpkg(root, *arguments):
    # What it depends on is in this system, not in that folder.
    forced = ["--force-script-chrootless", "--force-depends", "--force-architecture", "--force-not-root"]
    command = ["dpkg", f"--root={root}", "--no-triggers", *forced, *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, f"{command}:\n{done.stdout}{done.stderr}"
    return done.stdout if arguments[0] == "-V" else done.stderr


def judge(root):
    """systemd finds nothing wrong with the unit, and not much that it could do to the system."""
    unit = root / UNIT
    text = unit.read_text().replace("/usr/bin/host-sim", f"{root}/usr/bin/host-sim")
    text = text.replace("file:///usr/share", f"file://{root}/usr/share")
    copy = root.parent / f"recipe-gateway@{CELL}.service"
    copy.write_text(text)
    found = subprocess.run(["systemd-analyze", "verify", "--man=no", copy], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    mine = [line for line in found.stdout.splitlines() if "recipe-gateway" in line]
    assert found.returncode == 0 and not mine, found.stdout
    # It must be able to find something.
    copy.write_text(text.replace("Type=notify", "Type=notifyy"))
    found = subprocess.run(["systemd-analyze", "verify", "--man=no", copy], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert "notifyy" in found.stdout, found.stdout
    copy.write_text(text)
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", f"--threshold={EXPOSURE * 10:.0f}", copy]
    found = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert found.returncode == 0, found.stdout
    print(found.stdout.strip().splitlines()[-1])


def run(root, top, runs_with):
    """Starts the gateway as the unit says, waits until it is ready and told to be alive, and ends it."""
    settings = read_unit(root / UNIT)
    etc, runtime = root / "etc/recipe-gateway", top / "runtime"
    runtime.mkdir()
    os.chown(runtime, NOBODY, NOBODY)
    example = root / "usr/share/doc/recipe-gateway/examples/force-sensor.toml"
    (etc / f"{CELL}.toml").write_bytes(example.read_bytes())
    # The emulator has no pseudoterminals.
    device = "tcp-listen:127.0.0.1:0" if runs_with else f"pty:{runtime}/line"
    (etc / f"{CELL}.env").write_text(f"OPTIONS=--set controller.address=127.0.0.1 --bind force={device}\n")
    told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    told.bind(str(top / "notify"))
    (top / "notify").chmod(0o777)
    told.settimeout(PATIENCE)
    environment = {
        "PATH": "/usr/bin:/bin",
        "RUNTIME_DIRECTORY": str(runtime),
        "NOTIFY_SOCKET": str(top / "notify"),
        "WATCHDOG_USEC": str(int(settings["WatchdogSec"]) * 1_000_000),
    }
    for line in (etc / f"{CELL}.env").read_text().splitlines():
        name, value = line.split("=", 1)
        environment[name] = value
    rights = [] if runs_with else [
        "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--groups=dialout", "--no-new-privs",
        "--bounding-set=-all,+sys_nice", "--inh-caps=-all,+sys_nice", "--ambient-caps=-all,+sys_nice",
    ]
    command = [*rights, *runs_with, *words(settings["ExecStart"], root, environment)]
    gateway = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        assert next_news(told, gateway) == "READY=1\nSTATUS=running\n"
        ready = json.loads((runtime / "ready.json").read_text())
        assert "force" in ready["ports"], ready
        if not runs_with:
            check_rights(gateway.pid)
        assert next_news(told, gateway) == "WATCHDOG=1\n"
        gateway.send_signal(signal.SIGTERM)
        while (news := next_news(told, gateway)) == "WATCHDOG=1\n":
            pass
        assert news == "STOPPING=1\nSTATUS=ending\n", news
        assert gateway.wait(PATIENCE) == 0
        assert not (runtime / "ready.json").exists()
    finally:
        gateway.kill()


def next_news(told, gateway):
    try:
        return told.recv(4096).decode()
    except TimeoutError:
        gateway.kill()
        raise AssertionError(f"the service manager is told nothing:\n{gateway.stderr.read()}") from None


def check_rights(pid):
    """Not root, one capability, and real-time scheduling for the thread of the gateway alone."""
    status = dict(line.split(":\t", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines())
    assert status["Uid"].split() == [str(NOBODY)] * 4, status["Uid"]
    for kind in ("CapEff", "CapPrm", "CapBnd", "CapAmb"):
        assert int(status[kind], 16) == SYS_NICE, (kind, status[kind])
    policies = {}
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        shown = subprocess.run(["chrt", "-p", task.name], stdout=subprocess.PIPE, text=True, check=True).stdout
        policies[(task / "comm").read_text().strip()] = shown.splitlines()[0].rsplit(": ", 1)[1]
    assert policies["gateway"].startswith("SCHED_FIFO"), policies
    assert policies["host-sim"] == "SCHED_OTHER", policies


def read_unit(path):
    """The settings of a unit; of one that is given twice, the last."""
    lines = (line for line in path.read_text().splitlines() if "=" in line and not line.startswith("#"))
    return dict(line.split("=", 1) for line in lines)


def words(line, root, environment):
    """The command line of a unit: ${X} is one word, $X as many as it has."""
    for word in line.replace("%i", CELL).split():
        if word.startswith("$") and not word.startswith("${"):
            yield from environment[word[1:]].split()
            continue
        for name, value in environment.items():
            word = word.replace(f"${{{name}}}", value)
        yield str(root) + word if word.startswith(("/usr/", "/etc/")) else word


if __name__ == "__main__":
    main()
