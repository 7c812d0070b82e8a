#!/usr/bin/env python3
"""Clients that others wrote against running host-sim programs: one line PASS or FAIL a case.

    python run.py --host-sim target/debug/host-sim [WORD ...]

With words, only cases whose title has one of them. Exit code 0 only when every case passed. Needs
requirements.txt and Debian's mbpoll and mosquitto.
"""

import argparse
import importlib
import pathlib
import shutil
import signal
import sys
import threading
import time
import traceback

sys.dont_write_bytecode = True

import cell  # noqa: E402

MODULES = (
    "on_sockets", "on_habits", "on_modbus", "on_rtu_line", "on_serial", "on_can", "on_canopen", "on_dbc",
    "on_export", "on_metrics", "on_recipe_sockets", "through_gateway", "on_modbus_ports",
    "on_sparkplug",
)
# A case that hangs in somebody's library ends here.
CASE_LIMIT = 60


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host-sim", default=cell.ROOT / "target" / "debug" / "host-sim", type=pathlib.Path)
    parser.add_argument("--logs", default=cell.ROOT / "target" / "foreign" / "logs", type=pathlib.Path)
    parser.add_argument("words", nargs="*")
    arguments = parser.parse_args()
    cell.host_sim = str(arguments.host_sim.resolve())
    shutil.rmtree(arguments.logs, ignore_errors=True)
    arguments.logs.mkdir(parents=True)
    cell.log_folder = arguments.logs
    for module in MODULES:
        importlib.import_module(module)

    chosen = [
        (title, function)
        for title, function in cell.cases
        if not arguments.words or any(word in title for word in arguments.words)
    ]
    if not chosen:
        sys.exit("no case has one of these words in its title")
    signal.signal(signal.SIGALRM, out_of_time)
    failed = sum(not passes(number, *chosen_case) for number, chosen_case in enumerate(chosen, 1))
    print(f"{len(chosen) - failed} of {len(chosen)} passed; logs are in {arguments.logs}")
    sys.exit(1 if failed else 0)


def passes(number, title, function):
    name = f"{number:02}"
    threading.current_thread().name = name
    begin = time.monotonic()
    signal.alarm(CASE_LIMIT)
    try:
        function()
        outcome = "PASS"
    except Exception as error:
        outcome = "FAIL"
        reason = str(error) if isinstance(error, cell.Failed) else traceback.format_exc()
    finally:
        signal.alarm(0)
    print(f"{outcome}  {title}  ({time.monotonic() - begin:.1f} s)", flush=True)
    if outcome == "FAIL":
        print("      " + reason.strip().replace("\n", "\n      "))
        for log in sorted(cell.log_folder.glob(f"{name}-*.log")):
            lines = log.read_text(errors="replace").splitlines()
            print("      " + "\n      ".join([f"{log}:", *lines[-12:]]), flush=True)
    return outcome == "PASS"


def out_of_time(*_):
    raise cell.Failed(f"not done within {CASE_LIMIT} s")


if __name__ == "__main__":
    main()
