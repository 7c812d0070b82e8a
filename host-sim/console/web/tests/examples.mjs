// The controller's six worked examples, built from an empty gateway by nothing but the page, each then on real
// pseudoterminals and sockets, byte for byte: node --test tests/examples.mjs
import assert from "node:assert/strict";
import { closeSync, constants, mkdirSync, mkdtempSync, openSync, readSync, rmSync, writeFileSync, writeSync } from "node:fs";
import { connect, createServer } from "node:net";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { after, before, test } from "node:test";
import { chromium } from "playwright-core";
import { KEY, newPage, start, until } from "./cell.mjs";

const CONFIGS = resolve("../../configs");
const PICTURES = "../../../target/console";
mkdirSync(PICTURES, { recursive: true });

const DO1 = "DigitalOutputCommand[1]";
/** The six floats of the frame that example 5 was captured with. */
const POSE = Buffer.from("392F0BBF8687133FBFBD9D3F37FCC8BF17A01BBF59FCEABE", "hex");
const CAN_POSE = Buffer.from("EF54EF3EA7E7D13E", "hex");
const HEAD = Buffer.from([255, 255]);
const OUT_TAIL = Buffer.from([254, 254]);
const switched = (on) => Buffer.from([255, 255, on, 238, 238]);

let browser;
before(async () => {
    browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ["--no-sandbox"] });
});
after(() => browser?.close());

/** A device on a pseudoterminal. */
class Line {
    constructor(path) {
        this.file = openSync(path, constants.O_RDWR | constants.O_NONBLOCK | constants.O_NOCTTY);
        this.rest = Buffer.alloc(0);
    }
    send(bytes) {
        writeSync(this.file, bytes);
    }
    read() {
        const chunk = Buffer.alloc(4096);
        try {
            this.rest = Buffer.concat([this.rest, chunk.subarray(0, readSync(this.file, chunk))]);
        } catch (error) {
            if (error.code !== "EAGAIN") throw error;
        }
    }
    /** Drops what comes before these bytes, and them. */
    async until(bytes) {
        await until(bytes.toString("hex"), () => {
            this.read();
            const at = this.rest.indexOf(bytes);
            if (at >= 0) this.rest = this.rest.subarray(at + bytes.length);
            return at >= 0;
        });
    }
    async take(length) {
        await until(`${length} bytes`, () => {
            this.read();
            return this.rest.length >= length;
        });
        const taken = this.rest.subarray(0, length);
        this.rest = this.rest.subarray(length);
        return taken;
    }
    close() {
        closeSync(this.file);
    }
}

/** A device on the user-space CAN bus, which speaks slcan. */
class Bus {
    constructor(address) {
        const [host, port] = address.split(":");
        this.frames = [];
        let rest = "";
        this.socket = connect(Number(port), host);
        this.socket.write("C\rS6\rO\r");
        this.socket.on("data", (data) => {
            const parts = (rest + data.toString("latin1")).split("\r");
            rest = parts.pop();
            for (const part of parts) {
                const found = /t([0-9A-F]{3})(\d)([0-9A-F]*)/i.exec(part);
                if (found) this.frames.push([parseInt(found[1], 16), Buffer.from(found[3], "hex")]);
            }
        });
    }
    send(id, bytes) {
        this.socket.write(`t${id.toString(16).padStart(3, "0")}${bytes.length}${Buffer.from(bytes).toString("hex").toUpperCase()}\r`);
    }
    async frame(id, wanted) {
        await until(`id ${id}`, () => {
            while (this.frames.length > 0) {
                const [found, bytes] = this.frames.shift();
                if (found === id && (!wanted || bytes.equals(wanted))) return true;
            }
            return false;
        });
    }
    close() {
        this.socket.destroy();
    }
}

const key = ["--console-key", "key"];

/** A controller, an empty gateway beside it, and its page. */
async function empty(robotFile, robotArguments, binds, run) {
    const folder = mkdtempSync(join(tmpdir(), "rgw-examples-"));
    const processes = [];
    const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, locale: "en-GB" });
    try {
        writeFileSync(join(folder, "key"), `${KEY}\n`, { mode: 0o600 });
        writeFileSync(join(folder, "empty.toml"), '[controller]\naddress = "127.0.0.1"\n');
        const any = ["command", "state", "modbus", "udp2011"].flatMap((server) => ["--set", `listen.${server}=0`]);
        const robot = await start(folder, ["controller", "-c", join(CONFIGS, robotFile), ...any, ...robotArguments, "--console", "127.0.0.1:0", ...key]);
        processes.push(robot);
        const servers = ["command", "state", "modbus", "udp2011"].filter((server) => robot.ready[server]);
        const sets = servers.flatMap((server) => ["--set", `controller.ports.${server}=${robot.ready[server].split(":").at(-1)}`]);
        const bound = binds.flatMap((bind) => ["--bind", bind]);
        const gateway = await start(folder, ["gateway", "-c", "empty.toml", ...sets, ...bound, "--console", "127.0.0.1:0", ...key]);
        processes.push(gateway);
        await context.addInitScript((key) => sessionStorage.setItem("recipe-gateway-key", key), KEY);
        context.setDefaultTimeout(10_000);
        const page = await newPage(context);
        await page.goto(`http://${gateway.ready.console}/#recipes`);
        const info = async () => (await fetch(`http://${gateway.ready.console}/api/v1/info`)).json();
        const item = async (name) => {
            const body = JSON.stringify({ do: "get", items: [name] });
            const headers = { Authorization: `Bearer ${KEY}`, "Content-Type": "application/json" };
            return (await (await fetch(`http://${robot.ready.console}/api/v1/pendant`, { method: "POST", headers, body })).json()).result[name];
        };
        const is = (name, value) => until(`${name} = ${value}`, async () => (await item(name)) === value);
        await run({ page, folder, robot, info, is }).catch(async (error) => {
            await page.screenshot({ path: `${PICTURES}/example-wrong.png`, fullPage: true });
            throw error;
        });
    } finally {
        await context.close();
        for (const { child, ended } of processes.reverse()) {
            child.kill("SIGTERM");
            await ended;
        }
        rmSync(folder, { recursive: true, force: true });
    }
}

const part = (page, nth) => page.locator("section.part").nth(nth);
const row = (part, nth) => part.locator("ol.fields > li").nth(nth);
/** A choice by the beginning of its label, whose text has all options behind it. */
const choice = (scope, label) => scope.locator("label").filter({ hasText: new RegExp(`^${label}`) }).locator("select");
async function type(field, text) {
    await field.fill(text);
    await field.press("Tab");
}

/** Adds a recipe; what its parts get is up to `fill`. */
async function addRecipe(page, { name, kind, mode }) {
    await page.getByRole("button", { name: "Add a recipe" }).click();
    await type(page.getByLabel("Name", { exact: true }).first(), name);
    if (kind === "can") await choice(page, "Kind").selectOption("can");
    if (mode === "realtime") await choice(page, "Fields are").selectOption("realtime");
    await page.getByRole("button", { name: "Add an output" }).click();
}

async function addPort(page, name, recipe, bus = "rs485") {
    await page.getByRole("button", { name: "Add a port" }).click();
    if (bus !== "rs485") await choice(page, "Bus").selectOption(bus);
    await type(page.getByLabel("Name", { exact: true }), name);
    await choice(page, "Recipe").selectOption(recipe);
}

async function run(page) {
    await page.getByText("This file can run.").waitFor();
    await page.getByRole("button", { name: "Look at them and apply" }).click();
    await page.getByRole("dialog").getByRole("button", { name: "Apply on trial" }).click();
    await page.getByRole("button", { name: "Keep it" }).click();
    await page.getByText(/is on trial/).waitFor({ state: "detached" });
    await page.getByRole("link", { name: "Overview" }).click();
    await page.getByRole("heading", { name: "Controller", exact: true }).waitFor();
    await until("all links", async () => (await page.locator("section.card").last().getByText("connected").count()) > 0 && (await page.getByText("no connection").count()) === 0);
}

/** Three bytes to word registers, and the answer 125, 125, 125: the fields of examples 1 and 3. */
async function threeBytes(page) {
    for (const nth of [0, 1, 2]) {
        if (nth > 0) await part(page, 0).getByRole("button", { name: "Add a field" }).click();
        await type(row(part(page, 0), nth).getByLabel("To the variable"), `WordInputReg[${nth + 1}]`);
    }
    for (const nth of [0, 1, 2]) {
        if (nth > 0) await part(page, 1).getByRole("button", { name: "Add a field" }).click();
        await type(row(part(page, 1), nth).getByLabel("or the constant"), "125");
    }
    await choice(part(page, 1), "Send").selectOption("frame");
}

/** What switches DO1..8 and shows variables: the fields of the other examples on lines. */
async function system(page, shown) {
    await addRecipe(page, { name: "system", mode: "realtime" });
    await type(row(part(page, 0), 0).getByLabel("To the variable"), DO1);
    await type(row(part(page, 1), 0).getByLabel("From"), shown);
}

async function poseAndOutput(device, pose, is) {
    await device.until(pose);
    for (let nth = 0; nth < 20; nth++) assert.deepEqual(await device.take(pose.length), pose, `frame ${nth} behind the first`);
    for (const on of [1, 0, 1]) {
        device.send(switched(on));
        await is(DO1, on);
    }
}

const UDP_ROBOT = "udp-server-controller.toml";
const pose = (floats) => Buffer.concat([HEAD, POSE.subarray(0, 4 * floats), OUT_TAIL]);

test("example 1: three bytes on RS-485", () =>
    empty(UDP_ROBOT, [], ["rs485-1=pty:line"], async ({ page, folder, is }) => {
        await addRecipe(page, { name: "three-bytes" });
        await threeBytes(page);
        await page.screenshot({ path: `${PICTURES}/example-1.png`, fullPage: true });
        await addPort(page, "rs485-1", "three-bytes");
        await run(page);
        const device = new Line(join(folder, "line"));
        for (const bytes of [[1, 2, 3], [4, 5, 6]]) {
            device.send(Buffer.from([255, 255, ...bytes, 238, 238]));
            assert.deepEqual(await device.take(7), Buffer.from([255, 255, 125, 125, 125, 254, 254]));
            for (const [nth, byte] of bytes.entries()) await is(`WordInputReg[${nth + 1}]`, byte);
        }
        device.close();
    }));

test("example 2: the pose and an output on RS-485", () =>
    empty(UDP_ROBOT, [], ["rs485-1=pty:line"], async ({ page, folder, is }) => {
        await system(page, "RobotState[8..11]");
        await addPort(page, "rs485-1", "system");
        await run(page);
        const device = new Line(join(folder, "line"));
        await poseAndOutput(device, pose(4), is);
        device.close();
    }));

test("example 3: three bytes on CAN", () =>
    empty(UDP_ROBOT, [], ["can-1=slcan-tcp:127.0.0.1:0"], async ({ page, info, is }) => {
        await addRecipe(page, { name: "three-bytes", kind: "can" });
        await threeBytes(page);
        await addPort(page, "can-1", "three-bytes", "can");
        await run(page);
        const bus = new Bus((await info()).places.ports["can-1"]);
        for (const bytes of [[1, 2, 3], [4, 5, 6]]) {
            bus.send(1, bytes);
            await bus.frame(2, Buffer.from([125, 125, 125]));
            for (const [nth, byte] of bytes.entries()) await is(`WordInputReg[${nth + 1}]`, byte);
        }
        bus.close();
    }));

test("example 4: the pose and an output on CAN", () =>
    empty("can-system-controller.toml", ["--bind", "can=slcan-tcp:127.0.0.1:0"], ["can-1=slcan-tcp:127.0.0.1:0"], async ({ page, info, is }) => {
        await addRecipe(page, { name: "system", kind: "can", mode: "realtime" });
        await type(row(part(page, 0), 0).getByLabel("To the variable"), DO1);
        for (const nth of [0, 1, 2]) {
            if (nth > 0) await part(page, 1).getByRole("button", { name: "Add a CAN frame" }).click();
            const frame = part(page, 1).locator(".frame").nth(nth);
            assert.equal(await frame.getByLabel("Identifier").inputValue(), `0x${nth + 2}`);
            await type(row(frame, 0).getByLabel("From"), `RobotState[${8 + 2 * nth}..${9 + 2 * nth}]`);
        }
        await page.screenshot({ path: `${PICTURES}/example-4.png`, fullPage: true });
        await addPort(page, "can-1", "system", "can");
        await run(page);
        const bus = new Bus((await info()).places.ports["can-1"]);
        await bus.frame(2, CAN_POSE);
        for (const id of [3, 4, 2, 3, 4]) await bus.frame(id);
        for (const on of [1, 0, 1]) {
            bus.send(1, [on]);
            await is(DO1, on);
        }
        bus.close();
    }));

test("example 5: recipes by UDP 2011", () =>
    empty(UDP_ROBOT, [], ["rs485-1=pty:line"], async ({ page, folder, is }) => {
        await system(page, "RobotState[8..13]");
        await addPort(page, "rs485-1", "system");
        await page.getByRole("button", { name: /^Controller/ }).click();
        await choice(page, "Recipe").selectOption("system");
        await page.screenshot({ path: `${PICTURES}/example-5.png`, fullPage: true });
        await run(page);
        await page.getByText("Recipe link (UDP 2011)").waitFor();
        const device = new Line(join(folder, "line"));
        await poseAndOutput(device, pose(6), is);
        device.close();
    }));

for (const bus of ["tcp-listen", "udp-listen"])
    test(`example 6: recipes by the controller's ${bus.slice(0, 3).toUpperCase()} client`, async () => {
        const free = createServer().listen(0, "127.0.0.1");
        await new Promise((done) => free.once("listening", done));
        const to = `127.0.0.1:${free.address().port}`;
        await new Promise((done) => free.close(done));
        const [used, other] = bus === "tcp-listen" ? ["tcp1", "udp1"] : ["udp1", "tcp1"];
        const clients = ["--set", `port.${used}.to=${to}`, "--set", `port.${other}.to=127.0.0.1:9`];
        await empty("client-controller.toml", clients, ["rs485-1=pty:line"], async ({ page, folder, is }) => {
            await system(page, "RobotState[8..13]");
            await addPort(page, "rs485-1", "system");
            await addPort(page, "up", "system", bus);
            await type(page.getByLabel("The controller connects to"), to);
            await run(page);
            const device = new Line(join(folder, "line"));
            await poseAndOutput(device, pose(6), is);
            device.close();
        });
    });
