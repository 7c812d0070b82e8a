// Images as the page makes and reads them, beside those of `host-sim image`: node --test tests/image.mjs
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { after, test } from "node:test";
import { imageTypes } from "../types.mjs";
import { load } from "./load.mjs";

const { crc32, decode, encode, headOf } = await load("image.ts");
const { NAMES, compile } = await load("compile.ts");
const { decompile } = await load("decompile.ts");
const { read } = await load("toml.ts");

const PROGRAM = resolve(process.env.HOST_SIM ?? "../../../target/debug/host-sim");
const folder = mkdtempSync(join(tmpdir(), "rgw-image-"));
after(() => rmSync(folder, { recursive: true }));

/** What `host-sim image` makes of a text; `null` if it refuses it. */
function made(text) {
    writeFileSync(join(folder, "cell.toml"), text);
    try {
        execFileSync(PROGRAM, ["image", "cell.toml", "-o", "cell.img"], { cwd: folder, stdio: "pipe" });
    } catch {
        return null;
    }
    return readFileSync(join(folder, "cell.img"));
}

const files = ["../../configs", "../../templates", "../../config/tests/files/good"].flatMap((folder) =>
    readdirSync(folder)
        .filter((name) => name.endsWith(".toml"))
        .map((name) => [name, readFileSync(join(folder, name), "utf8")]),
);
const gateways = files.map(([name, text]) => [name, text, made(text)]).filter(([, , image]) => image);
const attempt = (text) => {
    try {
        return Buffer.from(encode(compile(read(text))));
    } catch (error) {
        assert.ok(error.key, `${error}`);
        return error;
    }
};

test("variables have the numbers of proto-core", () => {
    assert.deepEqual(NAMES, imageTypes().variables);
    assert.equal(crc32(Buffer.from("123456789")), 0xcbf43926);
});

test("of every file the page makes the same image, or says why it cannot", () => {
    assert.ok(gateways.length > 40);
    const same = gateways.filter(([name, text, image]) => {
        const own = attempt(text);
        if (own instanceof Error) return false;
        assert.deepEqual(own, image, name);
        return true;
    });
    const names = same.map(([name]) => name);
    for (const worked of ["rs485-user", "rs485-system", "can-user", "can-system", "udp-server", "client", "request-response", "can-hand", "force-sensor"])
        assert.ok(names.includes(`${worked}.toml`), `${worked}: not the same`);
});

/** Every key that the page writes, with another value than the usual one. */
const ALL_KEYS = `[controller]
address = "robot.cell"
dialect = "v2.6"
ports = { command = 2100, state = 2101, modbus = 1502, udp2011 = 2111 }
recipe_link = { udp = 2111, recipe = "up" }
[network]
address = "192.168.12.20/24"
router = "192.168.12.1"
dns = "192.168.12.2"
[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [0xFF, 0xFF]
tail = [0xEE, 0xEE]
fields = ["FloatInputReg[1..2]", "DigitalOutputCommand[1]"]
[[recipe]]
name = "panel"
kind = "stream"
mode = "user"
[recipe.input]
head = [1, 2, 3, 4, 5, 6, 7, 8]
fields = [
    { name = "a", type = "char", commands = { 1 = "run(a.jspf,50)", "2..100" = "speed({value})" }, idle = -3, base = "keep" },
    { name = "b", type = "short", to = "FloatInputReg[1]", scale = 0.1, offset = -273.15 },
    { name = "c", type = "int", to = "BitInputReg[3].4" },
    { name = "d", type = "double", to = "__FloatInputReg_2" },
    { name = "e", type = "dword" },
    { name = "f", type = "byte", when = "frame", commands = { 7 = "stop" } },
    { name = "g", type = "byte", to = "DigitalOutputCommand[1]" },
]
[recipe.output]
tail = [13, 10]
send = "rising:BitOutputReg[3].0"
on_stale = "stop"
fields = [
    { name = "a", type = "float", from = "controller.joint_torque[3]", scale = 1e-3 },
    { name = "b", type = "byte", from = "controller.mode" },
    { name = "c", type = "byte", from = "controller.speed" },
    { name = "d", type = "word", from = "port.age_ms" },
    { name = "e", type = "dword", from = "port.bus.frames" },
    { name = "f", type = "byte", from = "link.modbus.up", scale = -1, offset = 1 },
    { name = "g", type = "byte", from = "link.listens.up" },
    { name = "h", type = "byte", from = "counter" },
    { name = "i", type = "byte", from = "reply" },
    { name = "j", type = "double", value = -1.5 },
    { name = "k", type = "byte", from = "DigitalOutputCommand[1].0" },
    { name = "l", type = "word", from = "WordOutputReg[32]" },
]
[[recipe]]
name = "frames"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 0x1FFFFFFF
extended = true
fields = [{ name = "a", type = "word", to = "WordInputReg[1]" }]
[[port]]
name = "line"
bus = "rs485"
recipe = "panel"
baud = 4000000
parity = "odd"
stop_bits = 2
idle_gap_ms = 0.5
turnaround_us = 0
echo = false
absent_ms = 4500.5
cycle_ms = 7.5
timeout_ms = "never"
stale_after_ms = 1234.5
health = { alive = "WordInputReg[20]", frames = "WordInputReg[21]", age_ms = "WordInputReg[23]", rejected = "WordInputReg[22]" }
[[port]]
name = "bus"
bus = "can"
recipe = "frames"
bitrate = 10000
safe_at_start = true
on_timeout = { "WordInputReg[1]" = 65535 }
[[port]]
name = "listens"
bus = "udp-listen"
listen = "0.0.0.0:50000"
recipe = "up"
`;

test("every key that the page writes", () => {
    const wanted = made(ALL_KEYS);
    assert.ok(wanted, "host-sim image takes it");
    assert.deepEqual(attempt(ALL_KEYS), wanted);
    const again = decompile(wanted);
    assert.ok(!again.includes('kind = "image"'), again);
    assert.deepEqual(made(again), wanted);
});

test("an image is shown as a file that makes the same image", () => {
    let kept = 0;
    for (const [name, , image] of gateways) {
        assert.deepEqual(Buffer.from(encode(decode(image))), image, name);
        const text = decompile(image);
        assert.deepEqual(attempt(text), image, name);
        if (text.includes('kind = "image"')) kept++;
        // What is written in full, host-sim reads as well.
        else assert.deepEqual(made(text), image, `${name}:\n${text}`);
    }
    assert.ok(kept > 0 && kept < gateways.length);
    for (const name of readdirSync(`../../../proto-core/tests/golden/v${imageTypes().version}`).filter((name) => name.endsWith(".img"))) {
        const image = readFileSync(`../../../proto-core/tests/golden/v${imageTypes().version}/${name}`);
        assert.deepEqual(Buffer.from(encode(decode(image))), image, name);
    }
});

test("what stays as an image can be moved between others", () => {
    const scale = gateways.find(([name]) => name === "scale.toml")[2];
    const [, , hand] = gateways.find(([name]) => name === "can-hand.toml");
    const recipe = decompile(scale).match(/\[\[recipe\]\][\s\S]*?(?=\n\[\[port\]\])/)[0];
    const text = decompile(hand);
    const [before, behind] = [text.replace("[[recipe]]", `${recipe}\n[[recipe]]`), text.replace("[[port]]", `${recipe}\n[[port]]`)];
    for (const one of [before, behind]) {
        const shown = decompile(attempt(one));
        assert.equal(shown.match(/kind = "image"/g).length, 1);
        assert.deepEqual(attempt(shown), attempt(one));
    }
});

test("the form edits a port beside exchanges that stay as they are", () => {
    const [, , image] = gateways.find(([name]) => name === "events.toml");
    const shown = decompile(image);
    assert.equal(shown.match(/kind = "image"/g).length, 2);
    assert.ok(shown.includes("absent_ms = 5000") && shown.includes("echo = false"), shown);
    // The usual echo is not written.
    assert.equal(shown.match(/echo/g).length, 1);
    const [, toml] = files.find(([name]) => name === "events.toml");
    const edits = [["absent_ms = 5000", "absent_ms = 250"], ["echo = false", "echo = true"]];
    const edited = (text) => edits.reduce((text, [from, to]) => text.replace(from, to), text);
    assert.notEqual(edited(shown), shown);
    assert.deepEqual(attempt(edited(shown)), made(edited(toml)));
});

test("mistakes have their place", () => {
    const [, text] = files.find(([name]) => name === "rs485-user.toml");
    for (const [from, to, key, said] of [
        ["WordInputReg[2]", "WordInputReg[99]", "recipe.three-bytes.input.fields[2].to", "no variable"],
        ['type = "byte", to', 'type = "bite", to', "recipe.three-bytes.input.fields[1].type", "allowed: byte"],
        ['bus = "rs485"', 'bus = "rs485"\nbaud = 300', "port.rs485-1.baud", "1200..=4000000"],
        ['bus = "rs485"', 'bus = "rs485"\nbadu = 9600', "port.rs485-1.badu", "cannot write this"],
        ['bus = "rs485"', 'bus = "rs485"\necho = "maybe"', "port.rs485-1.echo", 'true, false or "auto"'],
        ['bus = "rs485"', 'bus = "rs485"\nabsent_ms = 0', "port.rs485-1.absent_ms", "out of range"],
        ['recipe = "three-bytes"', 'recipe = "four"', "port.rs485-1.recipe", "no recipe"],
        ["head = [255, 255]", "head = [255, 256]", "recipe.three-bytes.input.head", "8 bytes"],
        ['value = 125 },\n    { name = "output2"', 'value = 125, from = "reply" },\n    { name = "output2"', "recipe.three-bytes.output.fields[1].from", "from or value"],
    ]) {
        assert.ok(text.includes(from), from);
        const mistake = attempt(text.replace(from, to));
        assert.ok(mistake instanceof Error, to);
        assert.equal(mistake.key, key);
        assert.ok(mistake.message.includes(said), mistake.message);
    }
});

test("damaged images are told", () => {
    const [, , image] = gateways[0];
    assert.equal(headOf(image).length, image.length);
    for (let at = 0; at < image.length; at++) {
        const damaged = Buffer.from(image);
        damaged[at] ^= 0x10;
        assert.throws(() => decode(damaged), Error, `byte ${at}`);
        assert.throws(() => decode(image.subarray(0, at)), Error, `cut at ${at}`);
    }
    // What is behind it in flash does not matter.
    assert.deepEqual(decode(Buffer.concat([image, Buffer.alloc(9, 255)])), decode(image));
});
