"""Signals of a CAN database, encoded and decoded by the package cantools and by host-sim."""

import pathlib
import random
import subprocess
import tempfile

import cantools

import cell
from cell import Failed, case, check, equal

# Intel and Motorola signals, signed and scaled ones, across bytes, side by side, and multiplexed.
DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 intel: 8 A
 SG_ i12a : 0|12@1+ (1,0) [0|0] "" A
 SG_ i12b : 12|12@1- (0.5,-10) [0|0] "" A
 SG_ i16c : 28|16@1- (0.01,0) [0|0] "" A
 SG_ i1d : 44|1@1+ (1,0) [0|0] "" A
 SG_ i19e : 45|19@1+ (1,0) [0|0] "" A
BO_ 257 motorola: 8 A
 SG_ m12a : 7|12@0+ (1,0) [0|0] "" A
 SG_ m12b : 11|12@0- (0.25,3) [0|0] "" A
 SG_ m17c : 31|17@0+ (1,0) [0|0] "" A
 SG_ m3d : 46|3@0- (1,0) [0|0] "" A
 SG_ m20e : 43|20@0- (0.1,0) [0|0] "" A
BO_ 258 mixed: 8 A
 SG_ im : 4|10@1+ (1,0) [0|0] "" A
 SG_ mm : 23|14@0- (1,0) [0|0] "" A
 SG_ wide : 32|32@1- (1,0) [0|0] "" A
 SG_ low : 0|4@1- (1,0) [0|0] "" A
BO_ 259 short: 5 A
 SG_ s30 : 5|30@0+ (1,0) [0|0] "" A
 SG_ s6 : 32|6@1- (1,0) [0|0] "" A
BO_ 2566844672 multiplexed: 6 A
 SG_ mux M : 3|4@0+ (1,0) [0|0] "" A
 SG_ one m1 : 8|20@1- (0.001,0) [0|0] "" A
 SG_ two m2 : 15|13@0+ (1,0) [0|0] "" A
 SG_ both m2 : 32|16@1+ (1,0) [0|0] "" A
 SG_ always : 4|4@1+ (1,0) [0|0] "" A
"""

TYPES = {1: "byte", 2: "word", 3: "uint24", 4: "dword", 5: "uint40", 6: "uint48", 7: "uint56", 8: "uint64"}
ROUNDS = 400


def bits(signal, length):
    """First and last bit of a signal in the number that all bytes of its frame are, in its byte order."""
    if signal.byte_order == "little_endian":
        return signal.start, signal.start + signal.length - 1
    # The start is the highest bit; the first byte is the highest.
    last = 8 * (length - 1 - signal.start // 8) + signal.start % 8
    return last - signal.length + 1, last


def field(signal, length, equals=None):
    first, last = bits(signal, length)
    keys = [f'name = "{signal.name}"', f'type = "{TYPES[length]}"', f'bits = "{first}..{last}"', "new = false"]
    if length > 1:
        keys.append(f'endian = "{signal.byte_order.split("_")[0]}"')
    if signal.is_signed:
        keys.append("signed = true")
    if equals is not None:
        keys.append(f"equals = {equals}")
    return "    { " + ", ".join(keys) + " },\n"


def frames(message):
    """The frames of a message: one for each number of its multiplexer, or one."""
    switch = next((signal for signal in message.signals if signal.is_multiplexer), None)
    if not switch:
        return [(None, message.signals)]
    numbers = sorted({number for signal in message.signals for number in signal.multiplexer_ids or []})
    always = [signal for signal in message.signals if not signal.multiplexer_ids]
    return [
        (number, always + [signal for signal in message.signals if number in (signal.multiplexer_ids or [])])
        for number in numbers
    ]


def file(database):
    text = '[controller]\naddress = "127.0.0.1"\n\n[[recipe]]\nname = "dbc"\nkind = "can"\nmode = "user"\n'
    for message in database.messages:
        for number, signals in frames(message):
            text += f"\n[[recipe.input.frame]]\nid = {message.frame_id:#x}\n"
            text += "extended = true\n" if message.is_extended_frame else ""
            text += "fields = [\n"
            for signal in signals:
                text += field(signal, message.length, number if signal.is_multiplexer else None)
            text += "]\n"
    return text


def run(command, path, lines):
    """The lines that `decode` or `encode` makes of these."""
    arguments = [cell.host_sim, command, str(path), "--part", "input"]
    done = subprocess.run(arguments, input="\n".join(lines), capture_output=True, text=True, timeout=30)
    if done.returncode or done.stderr:
        raise Failed(f"{command}: {done.stderr or done.stdout}")
    return done.stdout.splitlines()


def any_value(signal, chance):
    if signal.is_signed:
        low, high = -(1 << signal.length - 1), (1 << signal.length - 1) - 1
    else:
        low, high = 0, (1 << signal.length) - 1
    return chance.choice([low, high, chance.randint(low, high), chance.randint(low, high)])


@case("signals of a CAN database, Intel and Motorola: decode and encode agree with cantools")
def signals():
    database = cantools.database.load_string(DBC, "dbc")
    chance = random.Random(2011)
    sent, expected = [], []
    for _ in range(ROUNDS):
        message = chance.choice(database.messages)
        number, used = chance.choice(frames(message))
        values = {signal.name: number if signal.is_multiplexer else any_value(signal, chance) for signal in used}
        data = message.encode(values, scaling=False)
        equal(message.decode(data, scaling=False), values, "what cantools itself decodes")
        identifier = f"{message.frame_id:08X}" if message.is_extended_frame else f"{message.frame_id:03X}"
        sent.append(f"{identifier}#{data.hex().upper()}")
        expected.append(values)
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        path = pathlib.Path(folder) / "dbc.toml"
        path.write_text(file(database))
        shown = run("decode", path, sent)
        check(len(shown) == len(sent), f"{len(shown)} of {len(sent)} frames decoded")
        for frame, line, values in zip(sent, shown, expected):
            pairs = dict(token.split("=") for token in line.split()[1:] if not token.startswith("raw="))
            # A multiplexer is a constant, shown where a message has more than one.
            equal({name: int(value) for name, value in pairs.items()}, values, f"the values of {frame}")
        without_raw = [" ".join(token for token in line.split() if not token.startswith("raw=")) for line in shown]
        equal(run("encode", path, without_raw), sent, "the frames made of the values")
