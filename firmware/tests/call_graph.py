#!/usr/bin/env python3
"""Call graph of an image for a Cortex-M: where it could panic, and how much stack it needs.

    call_graph.py --panics ELF         every place that calls a panic, with what was inlined around it
    call_graph.py --stack REGEX ELF    the deepest stack of each function whose name matches

Both fail on what they find: a panic outside the functions that --except allows to have one, recursion, a
call through a pointer.

The image has to be linked with `-C link-arg=--emit-relocs`: calls are read from the relocations, which
the linker itself acted on, not from a disassembly. For --stack it also has to be built with
`-Z emit-stack-sizes`. Needs the c++filt and addr2line of binutils.
"""

import argparse
import bisect
import collections
import re
import struct
import subprocess
import sys

PANICS = re.compile(
    r"core::(panicking::|option::(unwrap|expect)_failed|result::unwrap_failed|cell::panic_"
    r"|slice::index::slice_.*fail|slice::copy_from_slice_impl|slice::.*_fail$|str::slice_error_fail)"
    r"|alloc::(alloc::handle_alloc_error|raw_vec::.*(overflow|handle_error))|__rustc::rust_begin_unwind"
)
# Of `ELF for the Arm Architecture`, table of relocation codes.
CALLS = {10, 30, 51, 102, 103}  # bl and the branches
ABSOLUTE = 2
# Type of a symbol.
FUNCTION = 2


class Image:
    def __init__(self, path):
        self.path = path
        with open(path, "rb") as file:
            self.data = file.read()
        (sections_at,) = struct.unpack_from("<I", self.data, 32)
        size, count, names = struct.unpack_from("<HHH", self.data, 46)
        raw = [struct.unpack_from("<10I", self.data, sections_at + n * size) for n in range(count)]
        strings = raw[names]
        self.sections = {self.text(strings, s[0]): s for s in raw}
        self.functions = {}  # address: (name, size)
        self.symbols = []
        table = self.sections[".symtab"]
        for at in range(table[4], table[4] + table[5], 16):
            name, value, size, info, _, section = struct.unpack_from("<IIIBBH", self.data, at)
            self.symbols.append((value, info & 15, section))
            if info & 15 == FUNCTION and section:
                self.functions[value & ~1] = (self.text(self.sections[".strtab"], name), size)
        self.starts = sorted(self.functions)
        self.names = self.demangled()

    def text(self, section, at):
        start = section[4] + at
        return self.data[start : self.data.index(b"\0", start)].decode()

    def demangled(self):
        mangled = [self.functions[start][0] for start in self.starts]
        result = subprocess.run(["c++filt"], input="\n".join(mangled), text=True, check=True, capture_output=True)
        # Without the hashes of crates and the types of constants.
        names = re.sub(r"\[[0-9a-f]{6,16}\]|(?<=\d): [ui]size", "", result.stdout)
        return dict(zip(self.starts, names.split("\n")))

    def function_at(self, address):
        """The start of the function that the address is in."""
        place = bisect.bisect_right(self.starts, address) - 1
        if place < 0:
            return None
        start = self.starts[place]
        return start if address < start + max(self.functions[start][1], 1) else None

    def relocations(self, section):
        """Where, what kind, and the symbol's value and type."""
        found = self.sections.get(".rel" + section)
        if found is None:
            sys.exit(f"{self.path}: no relocations of {section}: link it with -C link-arg=--emit-relocs")
        for at in range(found[4], found[4] + found[5], 8):
            where, info = struct.unpack_from("<II", self.data, at)
            value, kind, _ = self.symbols[info >> 8]
            yield where, info & 255, value, kind

    def calls(self):
        """Caller, callee and place of each direct call."""
        for where, kind, value, _ in self.relocations(".text"):
            if kind in CALLS:
                yield self.function_at(where), value & ~1, where

    def addresses_taken(self):
        """Functions that something other than a direct call and the vector table refers to."""
        for section in (".text", ".rodata", ".data"):
            if ".rel" + section not in self.sections:
                continue
            for where, kind, value, type_ in self.relocations(section):
                if kind == ABSOLUTE:
                    # Relative to a section's start, perhaps: what was linked says it all.
                    _, _, _, start, offset, *_ = self.sections[section]
                    (value,) = struct.unpack_from("<I", self.data, offset + where - start)
                elif kind in CALLS or type_ != FUNCTION:
                    continue
                if value & ~1 in self.functions:
                    yield where, value & ~1

    def stack_sizes(self):
        section = self.sections.get(".stack_sizes")
        if section is None:
            sys.exit(f"{self.path}: no stack sizes: build it with -Z emit-stack-sizes")
        sizes, at, end = {}, section[4], section[4] + section[5]
        while at < end:
            (address,) = struct.unpack_from("<I", self.data, at)
            at, size, shift = at + 4, 0, 0
            while True:
                byte = self.data[at]
                at, size, shift = at + 1, size | (byte & 127) << shift, shift + 7
                if byte < 128:
                    break
            sizes[address & ~1] = size
        return sizes

    def stack_by_code(self, start):
        """All that a function of `compiler_builtins`, which has no stack sizes, ever pushes."""
        text = self.sections[".text"]
        at, end = start, start + self.functions[start][1]
        pushed = 0
        while at < end:
            half, next_ = struct.unpack_from("<HH", self.data, text[4] + at - text[3])
            if half & 0xFE00 == 0xB400:  # push
                pushed += 4 * (half & 0x1FF).bit_count()
            elif half & 0xFF80 == 0xB080:  # sub sp
                pushed += 4 * (half & 0x7F)
            elif half == 0xE92D:  # push.w
                pushed += 4 * next_.bit_count()
            elif half & 0xFFBF == 0xED2D:  # vpush
                pushed += 4 * (next_ & 0xFF)
            elif half == 0xF84D and next_ & 0xFFF == 0xD04:  # str [sp, #-4]!
                pushed += 4
            elif half & 0xFBFF in (0xF2AD, 0xF1AD):  # sub.w sp
                sys.exit(f"{self.names[start]}: its stack cannot be read from its code")
            at += 4 if half >> 11 in (0b11101, 0b11110, 0b11111) else 2
        return pushed


def panics(image, allowed):
    """Prints each place that calls a panic, except in functions with an allowed name; how many there are."""
    places, passed = collections.defaultdict(list), collections.Counter()
    for caller, callee, where in image.calls():
        caller_name = image.names.get(caller, "")
        if not PANICS.match(image.names.get(callee, "")) or PANICS.match(caller_name):
            continue
        if allowed and re.match(allowed, caller_name):
            passed[caller_name] += 1
        else:
            places[caller].append((where, callee))
    for name, count in passed.items():
        print(f"allowed: {count:3} in {name}")
    where = [hex(place) for found in places.values() for place, _ in found]
    if not where:
        if not passed and any("rust_begin_unwind" in name for name in image.names.values()):
            sys.exit(f"{image.path}: has a panic handler that nobody calls: are the names others now?")
        return 0
    command = ["addr2line", "-e", image.path, "-a", "-f", "-i", "-C", *where]
    output = subprocess.run(command, text=True, check=True, capture_output=True).stdout
    lines = {}
    for part in re.split(r"^0x", output, flags=re.M)[1:]:
        address, *frames = part.rstrip("\n").split("\n")
        lines[int(address, 16)] = frames
    for caller, found in places.items():
        for place, callee in found:
            print(f"{image.names[caller]} ({place:#x}) calls {image.names[callee]}")
            frames = lines.get(place, [])
            for name, line in zip(frames[::2], frames[1::2]):
                line = re.sub(r"^.*/(library|registry/src/[^/]*)/", "", line)
                print(f"    {name[:90]}  {line}")
    return len(where)


def stack(image, names):
    """Prints the deepest stack of the functions whose names begin so; what keeps it from being known."""
    sizes = image.stack_sizes()
    callees = collections.defaultdict(set)
    for caller, callee, _ in image.calls():
        callees[caller].add(callee)
    problems = []
    for where, target in image.addresses_taken():
        # Whoever holds the address may call it: that cannot be followed.
        holder = image.function_at(where)
        if holder is None:
            problems.append(f"an address in data: {image.names[target]} could be called through a pointer")
        else:
            callees[holder].add(None)
    deepest = {}

    def depth(function, path):
        if function in path:
            loop = " -> ".join(image.names[f] for f in (*path[path.index(function) :], function))
            raise RecursionError(f"calls itself: {loop}")
        if function is None:
            raise RecursionError("calls through a pointer: " + " -> ".join(image.names[f] for f in path))
        if function not in deepest:
            own = sizes[function] if function in sizes else image.stack_by_code(function)
            below = [depth(callee, (*path, function)) for callee in callees[function]]
            total, chain = max(below, default=(0, ()))
            deepest[function] = (own + total, ((image.names[function], own), *chain))
        return deepest[function]

    rows = []
    for start in image.starts:
        name = image.names[start]
        if re.match(names, name):
            try:
                rows.append((*depth(start, ()), name))
            except RecursionError as error:
                problems.append(f"{name} {error}")
    for total, chain, name in sorted(rows, reverse=True):
        path = ", ".join(f"{short(step)} {own}" for step, own in chain[1:] if own >= 64)
        print(f"{total:7}  {name}" + (f"  ({path})" if path else ""))
    if not rows and not problems:
        problems.append(f"no function begins with {names}")
    return problems


def short(name):
    """The name without the types it was made for."""
    while "<" in name and (less := re.sub(r"<[^<>]*>", "", name)) != name:
        name = less
    return "::".join(name.split("::")[-2:]).strip("<>:")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--panics", action="store_true")
    parser.add_argument("--except", metavar="REGEX", dest="allowed", help="functions that may call a panic")
    parser.add_argument("--stack", metavar="REGEX")
    parser.add_argument("elf", metavar="ELF")
    arguments = parser.parse_args()
    image = Image(arguments.elf)
    failed = False
    if arguments.panics:
        count = panics(image, arguments.allowed)
        print(f"{count} places call a panic" + (", besides those allowed" if arguments.allowed else ""))
        failed = count > 0
    if arguments.stack:
        problems = stack(image, arguments.stack)
        print("\n".join(problems), end="\n" if problems else "")
        failed |= bool(problems)
    sys.exit(failed)


if __name__ == "__main__":
    main()
