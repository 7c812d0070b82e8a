"""The files that are used if none is given."""

from __future__ import annotations

#: A controller with a serial line of its own frames (``rs485``, a user recipe), UDP port 2011 with variables of the
#: controller (``udp2011``, a realtime recipe), and the program ``pick.jspf``. All of it can be replaced at run time.
CONTROLLER_FILE = '''\
[robot]
power = "enabled"
mode = "remote"

# The program talks with a scale on the serial line: it sends FF FF, a command byte, FE FE, and gets
# FF FF, the mass in grams (low byte first), EE EE.
[[recipe]]
name = "scale"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [{ name = "grams", type = "word" }]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = [{ name = "command", type = "byte" }]

# Whoever sends a datagram to UDP 2011 gets the TCP's position every 20 ms. What it sends are 8 bits and a word.
[[recipe]]
name = "status"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["BitInputReg[3]", "WordInputReg[32]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["RobotState[8..10]", "WordOutputReg[1]"]

[[port]]
name = "rs485"
bus = "rs485"
baud = 115200
recipe = "scale"

[[port]]
name = "udp2011"
bus = "udp-server"
recipe = "status"
cycle_ms = 20

# Waits for a part (DI1) for 2 s, moves there, closes the gripper (DO1), and moves back. WordInputReg[1] is the
# number of the place, from 0; WordOutputReg[1] counts the parts.
[[program]]
name = "pick.jspf"
script = """
let waited = 0;
while !get("DI[1]") {
    if waited >= 2000 {
        throw "no part";
    }
    wait_ms(10);
    waited += 10;
}
let place = get("WordInputReg[1]");
movej([0.1 * place, -0.4, 0.5, 0.0, 0.6, 0.0], 1.5);
set("DO[1]", 1);
wait_ms(200);
movej([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1.5);
let parts = get("WordOutputReg[1]") + 1;
set("WordOutputReg[1]", parts);
log("part " + parts);
"""

# Asks the scale and shows the mass in WordOutputReg[2].
[[program]]
name = "weigh.jspf"
script = """
comm_send("rs485", [1]);
let values = comm_recv("rs485");
set("WordOutputReg[2]", values[0]);
"""
'''

#: A gateway with one device on a serial line: what it sends switches DO1 to DO8, and it gets the TCP's position.
GATEWAY_FILE = """\
[controller]
address = "127.0.0.1"

[[recipe]]
name = "station"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["DigitalOutputCommand[1]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["RobotState[8..10]"]

[[port]]
name = "rs485-1"
bus = "rs485"
baud = 115200
recipe = "station"
cycle_ms = 20
timeout_ms = 200
on_timeout = { "DigitalOutputCommand[1]" = 0 }
"""
