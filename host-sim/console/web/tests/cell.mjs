// A cell of real processes for the tests: simulated controller, gateway, and devices on pseudoterminals.
import { spawn } from "node:child_process";
import { closeSync, mkdtempSync, openSync, readFileSync, rmSync, writeFileSync, writeSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";

export const PROGRAM = resolve(process.env.HOST_SIM ?? "../../../target/debug/host-sim");
export const KEY = "00112233445566778899aabbccddeeff";

/** Starts host-sim and waits for its line `ready`. */
export async function start(folder, args) {
    const child = spawn(PROGRAM, args, { cwd: folder, stdio: ["ignore", "pipe", "pipe"] });
    let log = "";
    child.stderr.on("data", (data) => (log = (log + data).slice(-20_000)));
    const ready = await new Promise((taken, failed) => {
        let text = "";
        child.stdout.on("data", (data) => {
            text += data;
            const found = /^ready (.*)$/m.exec(text);
            if (found) taken(JSON.parse(found[1]));
        });
        child.on("exit", (code) => failed(new Error(`host-sim ${args[0]} ended with ${code}:\n${text}${log}`)));
    });
    const ended = new Promise((done) => child.on("exit", done));
    return { child, ready, ended, log: () => log };
}

/** Something that sends a frame again and again, until it is unplugged. */
class Device {
    constructor(path, frame, ms) {
        this.path = path;
        this.frame = frame;
        this.ms = ms;
        this.plug();
    }
    plug() {
        this.timer = setInterval(() => {
            try {
                this.file ??= openSync(this.path, "r+");
                writeSync(this.file, this.frame());
            } catch {
                // The gateway is being replaced: the line comes back as a USB adapter does.
                this.close();
            }
        }, this.ms);
    }
    close() {
        if (this.file !== undefined) closeSync(this.file);
        this.file = undefined;
    }
    unplug() {
        if (this.timer === undefined) return;
        clearInterval(this.timer);
        this.close();
        this.timer = undefined;
    }
}

export const ROBOT = `[listen]
address = "127.0.0.1"
command = 0
state = 0
modbus = 0
udp2011 = 0
[robot]
power = "enabled"
mode = "remote"
[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["ForceEnd[1..6]"]
[[port]]
name = "udp2011"
bus = "udp-server"
recipe = "up"
[[program]]
name = "wave.jspf"
script = """
loop { set("DO[3]", true); sleep(0.2); set("DO[3]", false); sleep(0.2); }
"""
[[program]]
name = "talk.jspf"
script = """
log("<img src=x onerror=window.xss=1>");
"""
`;

/** A gateway's file for the servers of a controller. */
export function gatewayFile(ready, recipesAndPorts, udp = true) {
    const port = (address) => Number(address.split(":").at(-1));
    return `# The cell of the tests.
[controller]
address = "127.0.0.1"
${udp ? `recipe_link = { udp = ${port(ready.udp2011)}, recipe = "up" }\n` : ""}ports = { command = ${port(ready.command)}, state = ${port(ready.state)}, modbus = ${port(ready.modbus)} }

${recipesAndPorts}`;
}

export const FORCE_AND_PANEL = `[[recipe]]
name = "force-sensor"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [0x48, 0xAA]
tail = [0x0D, 0x0A]
fields = ["ForceEnd[1..6]"]

[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["ForceEnd[1..6]"]

[[recipe]]
name = "three-bytes"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [
    { name = "input1", type = "byte", to = "WordInputReg[1]" },
    { name = "input2", type = "byte", to = "WordInputReg[2]" },
    { name = "input3", type = "byte", to = "WordInputReg[3]" },
]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = [{ name = "mode", type = "byte", from = "controller.mode" }]

[[port]]
name = "force"
bus = "rs485"
baud = 460800
recipe = "force-sensor"
idle_gap_ms = 5
timeout_ms = 500
[port.on_timeout]
"ForceEnd[1]" = 0.0

[[port]]
name = "panel"
bus = "rs485"
recipe = "three-bytes"
timeout_ms = 1000
cycle_ms = 50
`;

/** A running cell. */
export class Cell {
    static async start({ recipesAndPorts = FORCE_AND_PANEL, udp = true, robot = ROBOT } = {}) {
        const cell = new Cell();
        cell.folder = mkdtempSync(join(tmpdir(), "rgw-console-"));
        writeFileSync(join(cell.folder, "key"), `${KEY}\n`, { mode: 0o600 });
        writeFileSync(join(cell.folder, "robot.toml"), robot);
        cell.controller = await start(cell.folder, ["controller", "-c", "robot.toml", "--console", "127.0.0.1:0", "--console-key", "key"]);
        cell.file = gatewayFile(cell.controller.ready, recipesAndPorts, udp);
        writeFileSync(join(cell.folder, "cell.toml"), cell.file);
        cell.ports = [...cell.file.matchAll(/\[\[port\]\]\nname = "([^"]+)"/g)].map(([, name]) => name);
        cell.devices = {};
        await cell.startGateway();
        return cell;
    }

    async startGateway() {
        const binds = this.ports.flatMap((name, nth) => ["--bind", `${name}=pty:line${nth}`]);
        this.gateway = await start(this.folder, ["gateway", "-c", "cell.toml", ...binds, "--console", "127.0.0.1:0", "--console-key", "key", "--console-state", "kept"]);
    }

    /** A device on the nth port. */
    device(nth, frame, ms) {
        return (this.devices[nth] = new Device(join(this.folder, `line${nth}`), frame, ms));
    }

    /** The devices of `FORCE_AND_PANEL`. */
    plugAll() {
        const began = Date.now();
        this.device(
            0,
            () => {
                const bytes = Buffer.alloc(28);
                bytes.set([0x48, 0xaa]);
                for (let axis = 0; axis < 6; axis++) bytes.writeFloatLE(10 * Math.sin(((Date.now() - began) / 1000) * (axis + 1)), 2 + 4 * axis);
                bytes.set([0x0d, 0x0a], 26);
                return bytes;
            },
            8,
        );
        this.device(1, () => Buffer.from([255, 255, 41, 42, 43, 238, 238]), 50);
    }

    address(of = "gateway") {
        return `http://${this[of].ready.console}`;
    }

    async ask(name, of = "gateway") {
        return (await fetch(`${this.address(of)}/api/v1/${name}`)).json();
    }

    /** What the robot has: values of the simulated controller's items. */
    async robot(...items) {
        const answer = await fetch(`${this.address("controller")}/api/v1/pendant`, {
            method: "POST",
            headers: { Authorization: `Bearer ${KEY}`, "Content-Type": "application/json" },
            body: JSON.stringify({ do: "get", items }),
        });
        return (await answer.json()).result;
    }

    async end() {
        for (const device of Object.values(this.devices)) device.unplug();
        for (const { child, ended } of [this.gateway, this.controller].filter(Boolean)) {
            child.kill("SIGTERM");
            await ended;
        }
        rmSync(this.folder, { recursive: true, force: true });
    }
}

/** Waits until something holds; says what it was instead. */
export async function until(what, holds, ms = 10_000) {
    const end = Date.now() + ms;
    for (;;) {
        const found = await holds();
        if (found) return found;
        if (Date.now() > end) throw new Error(`not within ${ms} ms: ${what}`);
        await new Promise((done) => setTimeout(done, 50));
    }
}

/** A page; with SLOW=6 in a browser that is six times slower, which finds what looks once instead of waiting. */
export async function newPage(context) {
    const page = await context.newPage();
    if (process.env.SLOW) {
        const session = await context.newCDPSession(page);
        await session.send("Emulation.setCPUThrottlingRate", { rate: Number(process.env.SLOW) });
    }
    return page;
}

export const read = (path) => readFileSync(path, "utf8");
