// A board's firmware is updated in a browser; the board is a server that answers as one: node --test tests/updating.mjs
import assert from "node:assert/strict";
import { copyFileSync, mkdirSync, mkdtempSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, afterEach, before, test } from "node:test";
import { chromium } from "playwright-core";
import { KEY, newPage, until } from "./cell.mjs";
import { Board, HEADER, lengthened, resealed, signed } from "./firmware.mjs";

const axe = createRequire(import.meta.url).resolve("axe-core/axe.min.js");
const PICTURES = "../../../target/console";
mkdirSync(PICTURES, { recursive: true });
const folder = mkdtempSync(join(tmpdir(), "rgw-updating-"));
const LENGTH = 300_001;

let browser;
let board;
const files = {};
before(async () => {
    for (const version of ["0.2.0", "0.3.1"]) files[version] = signed(folder, version, LENGTH);
    browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ["--no-sandbox"] });
});
afterEach(async () => {
    for (const context of browser.contexts()) await context.close();
    board?.end();
});
after(async () => {
    if (process.env.DOCS === "write") copyFileSync(`${PICTURES}/update.png`, "../../../docs/pictures/update.png");
    await browser?.close();
    rmSync(folder, { recursive: true });
});

/** The page of a new board. */
async function open(changes = {}, options = {}) {
    board = await Object.assign(new Board(KEY), changes).listen();
    const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, locale: "en-GB", ...options });
    context.setDefaultTimeout(15_000);
    await context.addInitScript((key) => sessionStorage.setItem("recipe-gateway-key", key), KEY);
    const page = await newPage(context);
    page.errors = [];
    page.on("pageerror", (error) => page.errors.push(error.message));
    await page.goto(`${board.address()}/#firmware`);
    return page;
}

const card = (page, title) => page.locator("section.card").filter({ has: page.getByRole("heading", { name: title, exact: true }) });
const shot = (page, name) => page.screenshot({ path: `${PICTURES}/${name}.png`, clip: { x: 0, y: 0, width: 1280, height: 640 } });
const fact = (page, title, name, text) => card(page, title).locator(`dt:text-is("${name}") + dd:text-is("${text}")`).waitFor();

async function choose(page, bytes, label = "Choose a file …") {
    const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.getByRole("button", { name: label }).click()]);
    await chooser.setFiles({ name: "firmware.rgu", mimeType: "application/octet-stream", buffer: Buffer.from(bytes) });
}

async function send(page, version = "0.3.1") {
    await choose(page, files[version]);
    await page.getByRole("button", { name: "Send it to the board" }).click();
    await page.getByText(`${version} is whole in slot`).waitFor();
}

async function tryIt(page) {
    await page.getByRole("button", { name: "Try it …" }).click();
    await page.getByRole("dialog").getByRole("button", { name: "Run it on trial" }).click();
}

test("what runs, and files that are refused before anything is sent", async () => {
    const page = await open();
    await card(page, "What runs").getByText("slot A").waitFor();
    await fact(page, "What runs", "Board", "nucleo-h743zi");
    await fact(page, "What runs", "Firmware", "0.3.0");
    await fact(page, "What runs", "In slot B", "no whole firmware");
    await fact(page, "What runs", "Newest trial", "–");
    await shot(page, "firmware-nothing");
    const file = files["0.3.1"];
    const foreign = resealed(file, (bytes, at) => bytes.set(Buffer.from("other-board\0\0\0\0\0"), at + 80));
    const damaged = file.slice();
    damaged[5000] ^= 1;
    for (const [bytes, why] of [
        [Buffer.from("[controller]\n"), "This is no update file"],
        [file.slice(0, -1), "it was cut short or changed"],
        [damaged, "The update file is damaged at byte 208."],
        [foreign, "This is a nucleo-h743zi; the firmware is for the board other-board."],
        [lengthened(signed(folder, "9.9.9", 654_336)), "The firmware has 654337 bytes; a slot has room for 654336."],
    ]) {
        await choose(page, bytes);
        await page.getByText(why).waitFor();
        assert.equal(await page.getByRole("button", { name: "Send it to the board" }).count(), 0);
    }
    await shot(page, "firmware-refused-here");
    assert.deepEqual(board.changes, []);
    assert.deepEqual(page.errors, []);
});

test("sent with a lost connection, tried, and kept, by keyboard", async () => {
    const page = await open({ loseAt: 150_000, pieceMs: 40 });
    await choose(page, files["0.3.1"]);
    const update = card(page, "Update");
    await update.getByText("0.3.0 → 0.3.1 (newer)").waitFor();
    await fact(page, "Update", "It goes into", "slot B");
    await fact(page, "Update", "Length", `${HEADER + LENGTH} bytes`);
    assert.deepEqual(board.changes, []);
    await shot(page, "firmware-chosen");
    // The button stays where it is, whatever is said above it.
    const places = new Set();
    const place = async () => places.add((await update.locator("footer button").boundingBox()).y);
    await place();
    const press = async (name) => {
        await page.getByRole("button", { name, exact: true }).focus();
        await page.keyboard.press("Enter");
    };
    for (const step of ["erasing", "sending", "lost", "restart"]) board.hold(step);
    await press("Send it to the board");
    await page.getByText("The slot is being erased …").waitFor();
    board.goOn("erasing");
    await page.getByText(/^\d+ of 300193 bytes \(\d+ %\)$/).waitFor();
    await place();
    await shot(page, "firmware-sending");
    board.goOn("sending");
    await update.getByText("There is no connection.").waitFor();
    await place();
    await shot(page, "firmware-lost");
    board.goOn("lost");
    await update.getByText("There is no connection.").waitFor({ state: "detached" });
    await page.getByText("0.3.1 is whole in slot B.").waitFor();
    // It went on where the board was.
    assert.equal(board.bytesTaken, LENGTH);
    await page.getByText("What is shown is old.").waitFor({ state: "detached" });
    await place();
    assert.equal(places.size, 1, `${[...places]}`);
    await shot(page, "update");
    await press("Try it …");
    const dialog = page.getByRole("dialog");
    await dialog.getByText("The cell is put into its safe state").waitFor();
    await dialog.getByText("(force, panel)").waitFor();
    await shot(page, "firmware-try");
    assert.ok(!board.changes.includes("POST update/try"));
    await press("Run it on trial");
    await page.getByText("The board restarts with another firmware.").waitFor();
    board.goOn("restart");
    await page.getByText(/Firmware 0\.3\.1 is on trial: \d+ s left\./).waitFor();
    assert.equal(board.confirm_s, 300);
    await page.getByText("as many working ports as before").waitFor();
    const left = async () => Number(/(\d+) s left/.exec(await page.locator(".banner.trial").innerText())[1]);
    const first = await left();
    await until("the countdown", async () => (await left()) < first);
    await page.getByText("What is shown is old.").waitFor({ state: "detached" });
    await shot(page, "firmware-trial");
    // It is above all pages.
    await page.getByRole("link", { name: "Overview" }).click();
    await press("Keep it");
    await page.getByText("Firmware 0.3.1 runs and is confirmed.").waitFor();
    await page.getByRole("button", { name: "Good" }).click();
    await page.getByRole("link", { name: "Firmware" }).click();
    await fact(page, "What runs", "Firmware", "0.3.1");
    await fact(page, "What runs", "It is in", "slot B");
    await fact(page, "What runs", "Newest trial", "slot B: it was confirmed");
    // The page is the older firmware's until it is loaded again.
    await page.getByText("This page came from firmware 0.3.0.").waitFor();
    await shot(page, "firmware-kept");
    await page.getByRole("button", { name: "Load it again" }).click();
    await card(page, "What runs").getByText("slot B", { exact: true }).waitFor();
    await page.getByText("This page came from").waitFor({ state: "detached" });
    assert.deepEqual(page.errors, []);
});

test("taken back by a person, by the time, or because it does not start", async () => {
    const page = await open();
    await send(page);
    await tryIt(page);
    const takeBack = page.getByRole("button", { name: "Take it back" });
    await takeBack.waitFor();
    board.hold("restart");
    await takeBack.click();
    await page.getByText("The board restarts with another firmware.").waitFor();
    board.goOn("restart");
    await page.getByText("Firmware 0.3.1 was taken back: somebody took it back").waitFor();
    await shot(page, "firmware-taken-back");
    await fact(page, "What runs", "Firmware", "0.3.0");
    board.trialMs = 2500;
    board.hold("trial");
    // It has to be named again after the restart, and nothing of it is sent again.
    const before = board.bytesTaken;
    await send(page);
    await tryIt(page);
    await page.getByText(/is on trial: \d s left/).waitFor();
    board.goOn("trial");
    await page.getByText("Firmware 0.3.1 was taken back: it was not confirmed in time").waitFor();
    board.failsToStart = true;
    await send(page);
    assert.equal(board.bytesTaken, before);
    await tryIt(page);
    await page.getByText("Firmware 0.3.1 was taken back: it did not start").waitFor();
    await fact(page, "What runs", "Newest trial", "slot B: it did not start");
    assert.deepEqual(page.errors, []);
});

test("what the board refuses is told in its words", async () => {
    const refuses = "a configuration of this board has version 3; the firmware reads 1 to 2";
    const page = await open({ refuses });
    await choose(page, files["0.3.1"]);
    const start = page.getByRole("button", { name: "Send it to the board" });
    await start.click();
    await page.getByText(refuses).waitFor();
    await shot(page, "firmware-refused");
    board.refuses = null;
    // What was changed with a right CRC is found by the board.
    const changed = resealed(files["0.3.1"], (bytes, at) => bytes.fill(7, at + 96, at + 160));
    await choose(page, changed);
    // The page reads the file first.
    await page.getByText(refuses).waitFor({ state: "detached" });
    await start.click();
    await page.getByText("The board has not taken 0.3.1: the firmware is another one than that which was signed").waitFor();
    // An older one only if somebody wants it.
    await choose(page, files["0.2.0"]);
    await page.getByText("0.3.0 → 0.2.0 (older)").waitFor();
    assert.ok(await start.isDisabled());
    await page.getByLabel("Take it although it is older").check();
    await start.click();
    await page.getByText("0.2.0 is whole in slot B.").waitFor();
    board.foreign = true;
    await page.getByRole("button", { name: "Try it …" }).click();
    const dialog = page.getByRole("dialog");
    await dialog.getByText("It is older than 0.3.0, which runs.").waitFor();
    await dialog.getByRole("button", { name: "Run it on trial" }).click();
    await dialog.getByText("the firmware was not signed with the key of this board").waitFor();
    await shot(page, "firmware-foreign");
    assert.deepEqual(page.errors, []);
});

test("a page that is loaded again goes on with the same file, and stops when it is told to", async () => {
    const page = await open();
    await choose(page, files["0.3.1"]);
    board.hold("sending");
    await page.getByRole("button", { name: "Send it to the board" }).click();
    await until("a third of it", () => board.bytesTaken > LENGTH / 3);
    await page.getByRole("button", { name: "Stop" }).click();
    await page.getByText(/^\d+ % of 0\.3\.1 were sent\./).waitFor();
    board.goOn("sending");
    await page.reload();
    await page.getByText(/^\d+ % of 0\.3\.1 were sent\. The same file goes on there\.$/).waitFor();
    await shot(page, "firmware-begun");
    const before = board.bytesTaken;
    await send(page);
    assert.ok(before < LENGTH);
    assert.equal(board.bytesTaken, LENGTH);
    assert.deepEqual(page.errors, []);
});

test("a board that takes no updates says why, and nothing can be chosen", async () => {
    const page = await open({ cannot: "QEMU runs the program that it is given: there are no slots" });
    await page.getByText("This board takes no update: QEMU runs the program that it is given: there are no slots.").waitFor();
    assert.equal(await page.getByRole("button", { name: "Choose a file …" }).count(), 0);
    await shot(page, "firmware-cannot");
    await page.getByRole("button", { name: "中文" }).click();
    await page.getByText("此板不接受更新：QEMU 运行所给的程序，没有槽。").waitFor();
});

for (const [name, options] of Object.entries({
    "in light": {},
    "in the dark, in Chinese": { colorScheme: "dark", locale: "zh-CN" },
    "on a phone": { viewport: { width: 390, height: 844 } },
})) {
    test(`an update can be read and used by everybody ${name}`, async () => {
        const isChinese = options.locale === "zh-CN";
        const say = (english, chinese) => (isChinese ? chinese : english);
        const page = await open({}, { bypassCSP: true, ...options });
        await page.getByRole("heading", { name: say("Update", "更新"), exact: true }).waitFor();
        await page.addScriptTag({ path: axe });
        const look = async (step) => {
            const found = await page.evaluate(async () => {
                const { violations } = await window.axe.run();
                return violations.filter(({ impact }) => impact === "serious" || impact === "critical").map(({ id, nodes }) => `${id}: ${nodes.map(({ html }) => html.slice(0, 120)).join(" | ")}`);
            });
            assert.deepEqual(found, [], step);
            const wide = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
            assert.ok(wide <= 0, `${step} is ${wide} pixels too wide`);
            await page.screenshot({ path: `${PICTURES}/firmware-${step}-${name.replaceAll(/\W+/g, "-")}.png`, fullPage: true });
        };
        await look("first");
        await choose(page, files["0.3.1"], say("Choose a file …", "选择文件…"));
        board.hold("sending");
        await page.getByRole("button", { name: say("Send it to the board", "发送到板") }).click();
        await page.getByText(say(/bytes \(3\d %\)$/, /字节（3\d %）$/)).waitFor();
        await look("sending");
        board.goOn("sending");
        await page.getByRole("button", { name: say("Try it …", "试运行…") }).click();
        await page.getByRole("dialog").waitFor();
        await look("dialog");
        await page.getByRole("button", { name: say("Run it on trial", "开始试运行") }).click();
        await page.getByRole("button", { name: say("Keep it", "保留") }).waitFor();
        await look("trial");
        await page.getByRole("button", { name: say("Take it back", "撤回") }).click();
        await page.getByText(say("Firmware 0.3.1 was taken back", "固件 0.3.1 已撤回")).waitFor();
        await look("back");
    });
}
