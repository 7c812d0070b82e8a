// What the page computes, without a browser: node --test tests/unit.mjs
import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { load } from "./load.mjs";

const { read, replaced, linesOf, same } = await load("toml.ts");
const { pieces, parsedBytes, sizeOf, timeOnLine } = await load("frame.ts");
const { changes, diff } = await load("diff.ts");
const { templateOf, withTemplate } = await load("template.ts");

const CONFIGS = "../../configs";
const BOARDS = "../../../firmware/src/board";
const examples = readdirSync(CONFIGS).filter((name) => name.endsWith(".toml") && !name.endsWith("-controller.toml"));
const textOf = (name) => readFileSync(join(CONFIGS, name), "utf8");

test("every example file is read, and its tables are found", () => {
    assert.ok(examples.length > 10);
    for (const name of examples) {
        const text = textOf(name);
        const file = read(text);
        for (const kind of ["recipe", "port"])
            for (const [nth, table] of file[kind].entries()) {
                const [first, last] = linesOf(text, kind, nth);
                const alone = text.split("\n").slice(first, last + 1).join("\n");
                assert.ok(same(read(alone)[kind], [table]), `${name}: ${alone}`);
            }
        assert.equal(linesOf(text, "recipe", file.recipe.length), null, name);
    }
});

test("a table that is put back as it was leaves the file as it was", () => {
    for (const name of examples) {
        const text = textOf(name);
        const file = read(text);
        for (const kind of ["recipe", "port"])
            for (const [nth, table] of file[kind].entries()) {
                const again = replaced(text, kind, nth, table);
                assert.ok(same(read(again), file), name);
                // What is edited in the form also reads as before; other recipes are edited as a text.
                if (kind === "port" || (["stream", "can"].includes(table.kind) && !table.exchange)) assert.equal(again, text, name);
            }
    }
});

test("only what was edited changes, with its comments", () => {
    const text = `# About the file.
[controller]
address = "127.0.0.1"

[[recipe]]
name = "a" # its name
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
fields = [
    # the first
    { name = "x", type = "byte" },
    { name = "y", type = "byte" },
]

# About the port.
[[port]]
name = "p"
bus = "rs485"
recipe = "a"
`;
    const recipe = read(text).recipe[0];
    recipe.input.fields[1] = { name: "y", type: "word" };
    const newer = replaced(text, "recipe", 0, recipe);
    assert.equal(newer, text.replace('{ name = "y", type = "byte" }', '{ name = "y", type = "word" }'));
    assert.deepEqual(
        changes(diff(text, newer), 0).map((line) => line.sign + line.text.trim()),
        ['-{ name = "y", type = "byte" },', '+{ name = "y", type = "word" },'],
    );
    const gone = replaced(text, "port", 0, null);
    assert.equal(read(gone).port, undefined);
    const more = replaced(text, "recipe", 1, { name: "b", kind: "stream", mode: "user", input: { tail: [10], fields: [{ name: "q", type: "byte" }] } });
    assert.deepEqual(read(more).recipe.map(({ name }) => name), ["a", "b"]);
    assert.ok(more.indexOf('name = "b"') < more.indexOf("[[port]]"));
});

test("a header inside a text is no header", () => {
    const text = `[[recipe]]\nname = "a"\nkind = "stream"\nmode = "user"\n[recipe.input]\nhead = [1]\nfields = [{ name = "x", type = "byte" }]\n[[port]]\nname = """\n[[recipe]]\n"""\nrecipe = "a"\n`;
    // It is not damaged; at worst it is refused.
    try {
        assert.ok(same(read(replaced(text, "recipe", 0, read(text).recipe[0])), read(text)));
    } catch (error) {
        assert.match(error.message, /only be edited as a text/);
    }
});

test("the bytes of frames", () => {
    const part = read(textOf("force-sensor.toml")).recipe[0].input;
    const drawn = pieces(part);
    assert.deepEqual(drawn.map(({ label, bytes }) => [label, bytes]), [["head", 2], ["ForceEnd[1..6]", 24], ["tail", 2]]);
    assert.equal(timeOnLine(28, { baud: 460800 }).toFixed(3), "0.608");
    assert.equal(sizeOf("WordInputReg[3]"), 2);
    assert.equal(sizeOf("Nothing[3]"), null);
    assert.equal(sizeOf({ type: "byte", bits: 3 }), null);
    assert.equal(pieces({ fields: [], checksum: { kind: "crc16-modbus" } }), null);
    assert.deepEqual(parsedBytes("48 AA"), [0x48, 0xaa]);
    assert.deepEqual(parsedBytes("0x0D,0x0A"), [13, 10]);
    assert.deepEqual(parsedBytes("255 255"), [255, 255]);
    assert.deepEqual(parsedBytes(""), []);
    assert.equal(parsedBytes("4G"), null);
    assert.equal(parsedBytes("300"), null);
});

test("what a port and its devices lost is one list, with a name for each", async () => {
    const { losses } = await load("words.ts");
    const { en } = await load("en.ts");
    const events = { done: 5, refused: 0, accepted: 1, unknown: 1, expired: 2, out_of_limits: 1, no_value: 1, away: 1, still_open: 1, stopped: 1, not_followed: 1 };
    const port = {
        counters: { frames_in: 9, rejected_fields: 3, timeouts: 0, refused: 1 },
        peers: {
            1: { counters: { requests: 7, timeouts: 4, late_replies: 2, unconfirmed: 1, events } },
            2: { counters: { late_replies: 1, events: { expired: 3 } } },
            3: {},
        },
    };
    const lost = Object.fromEntries(losses(port));
    assert.deepEqual(lost, {
        rejected_fields: 3, refused: 1, late_replies: 3, unconfirmed: 1, event_unknown: 1, event_expired: 5, event_out_of_limits: 1,
        event_no_value: 1, event_away: 1, event_still_open: 1, event_stopped: 1, event_not_followed: 1,
    });
    for (const name of Object.keys(lost)) assert.ok(name in en, name);
    assert.deepEqual(losses({ counters: { frames_in: 1 } }), []);
});

test("every text is there in Chinese, and none that nobody shows", async () => {
    const { zh } = await load("zh.ts");
    const { en } = await load("en.ts");
    const sources = ["src", "src/pages"].flatMap((folder) =>
        readdirSync(folder).filter((name) => /\.tsx?$/.test(name) && !/^(zh|en)\.ts$/.test(name)).map((name) => readFileSync(join(folder, name), "utf8")),
    );
    const all = sources.join("\n");
    const used = new Set(Object.keys(en));
    for (const [, text] of all.matchAll(/\bt\(\s*("(?:[^"\\]|\\.)*")/g)) used.add(JSON.parse(text));
    for (const text of used) assert.ok(text in zh, `not in Chinese: ${text}`);
    // Why a board takes no update, as its firmware says it.
    const boards = readdirSync(BOARDS, { recursive: true }).filter((name) => name.endsWith(".rs")).map((name) => readFileSync(join(BOARDS, name), "utf8")).join("\n");
    const cannot = [...boards.matchAll(/^(?!.*let none).*(?:(?:slots: |=> | )Err|\bok_or)\("([^"]+)"\)/gm)].map(([, text]) => text);
    assert.ok(cannot.length >= 5);
    for (const text of cannot) assert.ok(text in zh, `not in Chinese: ${text}`);
    // Names of the API are shown by what they are called there.
    for (const text of Object.keys(zh))
        assert.ok(used.has(text) || all.includes(`"${text}"`) || cannot.includes(text) || /^[A-Za-z-]+$/.test(text), `shown nowhere: ${text}`);
    for (const [text, chinese] of Object.entries(zh)) {
        const parts = (of) => (of.match(/\{\w+\}/g) ?? []).sort();
        assert.deepEqual(parts(chinese), parts(text), text);
    }
});

test("a device is a template that can be brought to another file", () => {
    const cell = textOf("force-sensor.toml");
    const template = templateOf(cell, 0);
    assert.match(template, /^# .*\n#\n# Wiring:/);
    assert.deepEqual(read(template).port.length, 1);
    const hand = textOf("can-hand.toml");
    const both = withTemplate(hand, template);
    assert.ok(both.startsWith(hand.slice(0, hand.indexOf("[[recipe]]")).split("[controller]")[0]));
    assert.deepEqual(read(both).port.map(({ name }) => name), ["hand", read(cell).port[0].name]);
    // The way up comes along.
    assert.deepEqual(read(both).controller.recipe_link?.recipe, read(cell).controller.recipe_link?.recipe);
    // The same again changes nothing, another one of the same name gets a new name.
    assert.equal(withTemplate(both, template), both);
    const other = withTemplate(both, template.replace("baud = 460800", "baud = 230400"));
    assert.equal(read(other).port.length, 3);
    assert.equal(read(other).port[2].name, `${read(cell).port[0].name}-2`);
    assert.equal(read(other).port[2].baud, 230400);
    const changed = template.replace("0x48", "0x49");
    const renamed = read(withTemplate(both, changed));
    assert.equal(renamed.port[2].recipe, `${read(cell).port[0].recipe}-2`);
    // Comments come along.
    for (const name of ["kunwei-kwr75", "robotiq-ft300", "witmotion-imu"]) {
        const device = readFileSync(`../../templates/${name}.toml`, "utf8");
        const taken = withTemplate('[controller]\naddress = "127.0.0.1"\n', device);
        const wanted = read(device);
        assert.ok(same(read(taken).recipe, wanted.recipe) && same(read(taken).port, wanted.port), name);
        for (const line of device.slice(device.indexOf("[[recipe]]")).split("\n").filter((line) => line.startsWith("#"))) assert.ok(taken.includes(line), `${name}: ${line}`);
    }
});

test("the controller's table is edited as the others are", () => {
    const text = textOf("udp-server.toml");
    const { controller } = read(text);
    assert.equal(replaced(text, "controller", 0, controller), text);
    const newer = replaced(text, "controller", 0, { ...controller, ports: { modbus: 1502 } });
    assert.equal(read(newer).controller.ports.modbus, 1502);
    assert.ok(newer.startsWith(text.slice(0, text.indexOf("[controller]"))));
    const placed = replaced(newer, "network", 0, { address: "10.0.0.2/24" });
    assert.ok(placed.indexOf("[network]") < placed.indexOf("[[recipe]]"));
    assert.equal(replaced(placed, "network", 0, null).trim(), newer.trim());
});
