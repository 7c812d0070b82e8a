#!/usr/bin/env python3
"""Instructions of engine passes on a Cortex-M7, beside those of docs/performance.md section 2.

    firmware/counts.py --program target/thumbv7em-none-eabihf/firmware/examples/counts \
        --host-sim target/debug/host-sim [--update]

Fails if a figure differs by more than a tenth: then rewrite the table with --update. Needs Python and QEMU.
"""

import argparse
import pathlib
import re
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/performance.md"
HEAD = "| what the engine does | mean | most |\n|---|---:|---:|\n"
COMPILER = re.compile(r"(?<=\nCompiler: `)[^`]*(?=`\.)")
TOLERANCE = 0.10


def count(program, image):
    """Runs the program in QEMU; returns mean and maximum by name."""
    command = ["timeout", "-k", "5", "60", "qemu-system-arm", "-M", "mps2-an500", "-icount", "shift=6"]
    command += ["-display", "none", "-monitor", "none", "-serial", "null", "-nic", "none"]
    command += ["-semihosting-config", f"enable=on,target=native,arg=counts,arg={image}", "-kernel", program]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode != 0:
        sys.exit(f"QEMU ended with {run.returncode}\n{run.stdout}{run.stderr}")
    lines = [line.split("\t") for line in run.stdout.splitlines()]
    return {name: (int(mean), int(most)) for mean, most, name in lines}


def make_image(host_sim, folder):
    """The configuration image of the cell whose passes are counted."""
    image = pathlib.Path(folder) / "counts.img"
    source = ROOT / "firmware/examples/counts.toml"
    subprocess.run([host_sim, "image", source, "-o", image], check=True, stdout=subprocess.DEVNULL)
    return image


def compiler(program):
    """The compiler's version, as noted in the program."""
    found = re.search(rb"\0rustc version ([^\0]+)", b"\0" + pathlib.Path(program).read_bytes())
    return "rustc " + found.group(1).decode() if found else "unknown"


def split(page):
    """The page before the table, the table's rows, and the rest of the page."""
    before, _, rest = page.partition(HEAD)
    rows = re.match(r"(?:\|.*\n)*", rest).group(0)
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows.splitlines()]
    return before, {name: (int(mean), int(most)) for name, mean, most in cells}, rest[len(rows):]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, help="the example counts, built for the board")
    parser.add_argument("--host-sim", required=True, help="makes the configuration image")
    parser.add_argument("--update", action="store_true", help="write the table anew")
    options = parser.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        image = make_image(options.host_sim, folder)
        found = count(options.program, image)
        if found != count(options.program, image):
            sys.exit("two runs counted differently")

    page = PAGE.read_text()
    before, known, after = split(page)
    used = compiler(options.program)
    if options.update:
        rows = "".join(f"| {name} | {mean} | {most} |\n" for name, (mean, most) in found.items())
        PAGE.write_text(COMPILER.sub(used, before + HEAD + rows + after))
        print(f"written to {PAGE}")
        return

    named = COMPILER.search(page).group(0)
    if named != used:
        print(f"the table is of {named}; this is {used}")
    wrong = set(known) ^ set(found)
    for name, figures in found.items():
        print("{:8d} {:8d}  {}".format(*figures, name))
        for label, now, then in zip(("mean", "most"), figures, known.get(name, figures)):
            if abs(now - then) > TOLERANCE * then:
                print(f"    {'GREW' if now > then else 'shrank'}: {label} was {then}")
                wrong.add(name)
    if wrong:
        print("not as in docs/performance.md section 2: " + ", ".join(sorted(wrong)))
        sys.exit("if that is intended: firmware/counts.py --update")


if __name__ == "__main__":
    main()
