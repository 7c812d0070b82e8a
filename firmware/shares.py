#!/usr/bin/env python3
r"""Where the instructions of engine passes on a Cortex-M7 go: the picture of docs/performance.md section 2, or lines.

    firmware/shares.py --program target/thumbv7em-none-eabihf/firmware/examples/counts \
        --host-sim target/debug/host-sim --output docs/pictures/cortex-m7.svg
    firmware/shares.py --program ... --host-sim ... --lines "CAN frame to its Modbus request"

QEMU names each instruction that it executes (-singlestep -d exec,nochain), and llvm-symbolizer the functions that it
is of, inlined ones too. The sum of a pass has to be that of the page's table, to 5 %: the table has the call of the
loop, too. Needs Python, QEMU and LLVM's symbolizer (Debian: qemu-system-arm, llvm).
"""

import argparse
import collections
import json
import pathlib
import re
import subprocess
import sys
import tempfile

import counts

# What it is called in the table; how many calls of the driver's loop it takes, and how many of these are counted: the
# others tell the engine what became of its output.
PASSES = {
    "28-byte stream frame to its frame over UDP": (2, 1),
    "the same frame byte by byte": (29, 28),
    "CAN frame to its Modbus request": (3, 1),
}
LOOP = "counts::pass"
# As often as the program does it.
REPEATED = 10
TOLERANCE = 0.05

# Parts of a pass, in the order of their work: what is done, a colour, and the functions it is done in, as FILE:NAME.
# An instruction is of the innermost one of these.
PARTS = [
    ("the driver's loop", "#c9ced6", ["counts.rs:pass"]),
    (
        "which input, of which port",
        "#8ecae6",
        [
            "mod.rs:handle",
            "mod.rs:handle_fast",
            "mod.rs:handle_full",
            "mod.rs:poll_full",
            "mod.rs:port_bytes",
            "mod.rs:port_can",
            "port.rs:can",
        ],
    ),
    (
        "is it a frame of the recipe",
        "#ffc857",
        [
            "port.rs:hold",
            "deframer.rs:next_frame",
            "can.rs:has",
            "can.rs:accept_frame",
        ],
    ),
    ("its values into the image", "#90be6d", ["frames.rs:take"]),
    ("what is to be written, until when", "#f4978e", ["store.rs:accepted"]),
    ("which links write it", "#cdb4db", ["mod.rs:after_frame"]),
    ("which link may send", "#84c5b1", ["mod.rs:poll_output", "mod.rs:poll_work", "links.rs:next_link_frame"]),
    ("what it sends, and its latency", "#f6ad6b", ["modbus.rs:write", "recipe.rs:send"]),
    ("the bytes of that", "#a8b6ff", ["client.rs:start", "values.rs:from_little_endian", "stream.rs:encode"]),
    ("until when to sleep", "#e3d26f", ["clock.rs:sleep"]),
]


def trace(program, image, name):
    """The addresses of the instructions that are executed, in order, where only one kind of pass is done."""
    # Arguments end with a blank.
    words = ",".join("arg=" + word.replace(",", ",,") for word in ("counts", str(image), name.replace(" ", "_")))
    command = ["timeout", "-k", "5", "120", "qemu-system-arm", "-M", "mps2-an500", "-icount", "shift=6"]
    command += ["-singlestep", "-d", "exec,nochain", "-D", "/dev/stderr"]
    command += ["-display", "none", "-monitor", "none", "-serial", "null", "-nic", "none"]
    command += ["-semihosting-config", f"enable=on,target=native,{words}", "-kernel", str(program)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        for line in run.stderr:
            if line.startswith(b"Trace"):
                yield int(line.split(b"/", 2)[1], 16)
    if run.returncode != 0:
        sys.exit(f"QEMU ended with {run.returncode}")


class Names:
    """The functions of a program, by address."""

    def __init__(self, program):
        self.program = program
        listed = subprocess.run(["nm", "-CS", program], capture_output=True, text=True, check=True).stdout
        rows = [line.split(" ", 3) for line in listed.splitlines() if re.match(r"\S+ \S+ [tTwW] ", line)]
        # The first address of the function that an address is in.
        self.starts, self.loop = {}, None
        for start, size, _, name in rows:
            first = int(start, 16) & ~1
            self.starts.update((address, first) for address in range(first, first + int(size, 16), 2))
            if name == LOOP:
                self.loop = first
        if self.loop is None:
            sys.exit(f"{program} has no function {LOOP}")
        self.chains = {}

    def learn(self, addresses):
        """Asks for the functions that are inlined at these addresses, the outermost first: file, name, line."""
        asked = "".join(f"{address:#x}\n" for address in addresses)
        command = ["llvm-symbolizer", "--inlines", "--demangle", "--output-style=JSON", f"--obj={self.program}"]
        said = subprocess.run(command, input=asked, capture_output=True, text=True, check=True).stdout
        for address, line in zip(addresses, said.splitlines(), strict=True):
            frames = [
                (pathlib.PurePath(frame["FileName"]).name, short(frame["FunctionName"]), frame["Line"])
                for frame in json.loads(line)["Symbol"]
            ]
            self.chains[address] = frames[::-1]


def short(name):
    """A function's name without its path and without the types that it was made for."""
    while (less := re.sub(r"<[^<>]*>", "", name)) != name:
        name = less
    return name.removesuffix("::").rsplit("::", 1)[-1] or "?"


def profile(program, image, name):
    """Stacks of functions, the outermost first, with how many instructions of a pass were executed there."""
    calls, counted = PASSES[name]
    names = Names(program)
    # For each call of the loop: how often an address was executed, with the addresses of the calls that led there.
    loops, stack, last = [], [], None
    for at in trace(program, image, name):
        if at == names.loop:
            loops.append(collections.Counter())
            stack, last = [], at
        elif last is None:
            continue
        here = names.starts.get(at)
        if here != names.starts.get(last):
            if at == here:
                stack.append(last)
            else:
                # A return, maybe to the caller's caller: a function may end with a jump to another one.
                while stack and names.starts.get(stack.pop()) != here:
                    pass
                if here != names.loop and not stack:
                    # Out of the loop.
                    last = None
                    continue
        loops[-1][tuple(stack), at] += 1
        last = at
    sums = collections.Counter()
    # Those before are of the engine's start.
    for nth, executed in enumerate(loops[-calls * REPEATED :]):
        if nth % calls < counted:
            sums.update(executed)
    names.learn(sorted({address for stack, at in sums for address in (*stack, at)}))
    shares = collections.Counter()
    for (stack, at), count in sums.items():
        shares[tuple(step for address in (*stack, at) for step in names.chains[address])] += count / REPEATED
    return shares


def print_lines(shares, least):
    """A tree in lines of text, of what takes at least so many instructions: with what it calls, and without."""
    tree = collections.Counter()
    for stack, count in shares.items():
        for depth in range(len(stack)):
            tree[stack[: depth + 1]] += count
    order = {stack: [(-tree[stack[: depth + 1]], stack[depth]) for depth in range(len(stack))] for stack in tree}
    for stack in sorted(tree, key=order.get):
        if tree[stack] >= least:
            file, name, line = stack[-1]
            print(f"{tree[stack]:8.1f} {shares[stack]:8.1f}  {'  ' * (len(stack) - 1)}{name}  {file}:{line}")


def by_part(shares):
    """Instructions of each of PARTS, and the names of their functions that were met."""
    part_of = {function: nth for nth, (_, _, functions) in enumerate(PARTS) for function in functions}
    sums, met = [0.0] * len(PARTS), set()
    for stack, count in shares.items():
        steps = [f"{file}:{name}" for file, name, _ in stack]
        innermost = next((step for step in reversed(steps) if step in part_of), None)
        if innermost is None:
            sys.exit(f"of no part: {' '.join(steps)}")
        sums[part_of[innermost]] += count
        met.update(steps)
    return sums, met & part_of.keys()


STYLE = """
    text { font: 13px system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; fill: #1b1f24; }
    .title { font-weight: 600; }
    .quiet { fill: #57606a; font-size: 11.5px; }
    .in { fill: #14181d; font-size: 12px; }
    .page { fill: #ffffff; }
    @media (prefers-color-scheme: dark) {
      text { fill: #e6edf3; }
      .quiet { fill: #9aa4af; }
      .in { fill: #14181d; }
      .page { fill: #0d1117; }
    }"""
WIDTH, MARGIN, BAR = 900, 20, 30


def picture(found):
    """Bars, one for each pass, and what their colours are; `found` has the instructions of each part by name."""
    inner = WIDTH - 2 * MARGIN
    body, y = [], MARGIN + 8
    for nth, (name, sums) in enumerate(found.items(), 1):
        total = sum(sums)
        body.append(f'<text class="title" x="{MARGIN}" y="{y}">{nth}. {name}: {total:.0f} instructions</text>')
        x = float(MARGIN)
        for (words, colour, _), count in zip(PARTS, sums):
            width = count / total * inner
            box = f'x="{x:.1f}" y="{y + 9}" width="{max(width - 1, 0):.1f}" height="{BAR}"'
            body.append(f'<rect {box} fill="{colour}"><title>{words}: {count:.0f}</title></rect>')
            label = f"{count:.0f}"
            if width > 8 * len(label) + 4:
                middle = f'x="{x + width / 2:.1f}" y="{y + 28}" text-anchor="middle"'
                body.append(f'<text class="in" {middle}>{label}</text>')
            x += width
        y += BAR + 42
    columns = [WIDTH - MARGIN - 70 * (len(found) - 1 - nth) for nth in range(len(found))]
    for nth, right in enumerate(columns, 1):
        body.append(f'<text class="title" x="{right}" y="{y}" text-anchor="end">{nth}.</text>')
    y += 22
    for part, (words, colour, functions) in enumerate(PARTS):
        body.append(f'<rect x="{MARGIN}" y="{y - 12}" width="16" height="16" fill="{colour}"/>')
        body.append(f'<text x="{MARGIN + 26}" y="{y + 1}">{words}</text>')
        inside = ", ".join(dict.fromkeys(function.partition(":")[2] for function in functions))
        body.append(f'<text class="quiet" x="{MARGIN + 265}" y="{y + 1}">{inside}</text>')
        for right, sums in zip(columns, found.values()):
            share = 100 * sums[part] / sum(sums)
            text = f"{share:.0f} %" if sums[part] else "–"
            body.append(f'<text x="{right}" y="{y + 1}" text-anchor="end">{text}</text>')
        y += 24
    height = y - 24 + MARGIN
    title = "Where the instructions of three engine passes go on a Cortex-M7"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">'
    start = [head, f"  <title>{title}</title>", f"  <style>{STYLE}\n  </style>"]
    start.append(f'  <rect class="page" width="{WIDTH}" height="{height}"/>')
    return "\n".join([*start, *(f"  {line}" for line in body), "</svg>\n"])


def draw(program, image):
    """The picture of all passes."""
    known = counts.split(counts.PAGE.read_text())[1]
    found, met = {}, set()
    for name in PASSES:
        found[name], functions = by_part(profile(program, image, name))
        met |= functions
        total, listed = sum(found[name]), known[name][0]
        if abs(total - listed) > TOLERANCE * listed:
            sys.exit(f"{name}: {total:.0f} instructions here, {listed} in {counts.PAGE}")
    missing = {function for _, _, functions in PARTS for function in functions} - met
    if missing:
        sys.exit(f"no such function in any pass: {', '.join(sorted(missing))}; correct PARTS")
    return picture(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, help="the example counts, built for the board")
    parser.add_argument("--host-sim", required=True, help="makes the configuration image")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--output", metavar="FILE", type=pathlib.Path, help="write the picture, in SVG")
    what.add_argument("--lines", metavar="PASS", choices=PASSES, help="print a pass by function and line")
    parser.add_argument("--least", metavar="COUNT", type=float, default=5, help="of such a line, in instructions")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        image = counts.make_image(options.host_sim, folder)
        if options.lines:
            print_lines(profile(options.program, image, options.lines), options.least)
        else:
            options.output.write_text(draw(options.program, image))
            print(f"written to {options.output}")


if __name__ == "__main__":
    main()
