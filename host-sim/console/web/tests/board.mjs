// The page of a board: it is claimed, changed and watched in a browser. The board is the firmware in QEMU:
// FIRMWARE_ELF=... node --test tests/board.mjs
// or the NUCLEO's, unchanged, on its modelled chip (docs/chip.md section 5):
// BOARD=nucleo FIRMWARE_ELF=... CHIP_UNICORN=... node --test tests/board.mjs
import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { copyFileSync, mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createServer, request } from "node:http";
import { connect } from "node:net";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { after, before, test } from "node:test";
import { chromium } from "playwright-core";
import { newPage, PROGRAM, until } from "./cell.mjs";

const ROOT = resolve("../../..");
const ELF = resolve(ROOT, process.env.FIRMWARE_ELF ?? "target/thumb/thumbv7em-none-eabihf/firmware/firmware");
const IS_NUCLEO = process.env.BOARD === "nucleo";
/** What the board is called: in QEMU by its Ethernet address, the NUCLEO by its chip's number, which its log says. */
let name = "rgw-123456";
/** Why it takes no update as it is started here. */
const NO_UPDATE = IS_NUCLEO
    ? "this firmware was linked for the beginning of the flash, where the loader would be"
    : "QEMU runs the program that it is given: there are no slots";
const PICTURES = `../../../target/console${IS_NUCLEO ? "/nucleo" : ""}`;
mkdirSync(PICTURES, { recursive: true });

const folder = mkdtempSync(join(tmpdir(), "rgw-board-"));
const FILE = `[controller]
address = "10.0.2.2"

[[recipe]]
name = "panel"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [
    { name = "button", type = "byte", to = "WordInputReg[1]" },
    { name = "knob", type = "byte", to = "WordInputReg[2]" },
]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = [{ name = "lamp", type = "byte", value = 7 }]

[[port]]
name = "panel"
bus = "rs485"
recipe = "panel"
cycle_ms = 20
timeout_ms = 500
`;

/** The image that host-sim makes of a text. */
function made(text) {
    writeFileSync(join(folder, "cell.toml"), text);
    execFileSync(PROGRAM, ["image", "cell.toml", "-o", "cell.img", "--force"], { cwd: folder });
    return readFileSync(join(folder, "cell.img"));
}

let machine;
let log = "";
let address;
let proxy;
let browser;
let line;

/** A port that is free now. */
const freePort = () =>
    new Promise((done) => {
        const server = createServer().listen(0, "127.0.0.1", () => {
            const { port } = server.address();
            server.close(() => done(port));
        });
    });

/** Asks the board itself. */
const ask = (port, path) =>
    new Promise((done) => {
        const sent = request({ host: "127.0.0.1", port, path, headers: { Host: name } }, (answer) => {
            answer.resume();
            done(answer.statusCode);
        });
        sent.on("error", () => done(0));
        sent.end();
    });

/** Starts the board, with its first configuration. */
function start(port) {
    const image = join(folder, "first.img");
    const forward = `hostfwd=tcp:127.0.0.1:${port}-:80`;
    if (IS_NUCLEO) {
        const args = [ELF, image, "--realtime", "--rs485", join(folder, "line"), "--network", forward];
        machine = spawn(join(ROOT, "target/debug/chip-model"), [...args, "--control", join(folder, "control")]);
    } else {
        const files = ["first.img", "none", "store", "button"].map((file) => `arg=${file === "none" ? file : join(folder, file)}`).join(",");
        const args = `-M mps2-an500 -display none -monitor none -nic user,${forward} -serial unix:${folder}/line,server=on,wait=off -serial null -serial null -serial stdio`;
        machine = spawn("qemu-system-arm", [...args.split(" "), "-semihosting-config", `enable=on,target=native,arg=firmware,${files}`, "-kernel", ELF]);
    }
    for (const output of [machine.stdout, machine.stderr]) output.on("data", (text) => (log += text));
}

/** Presses the button, until `seen`. */
async function press(seen) {
    if (IS_NUCLEO) {
        const control = connect(join(folder, "control"));
        control.end("press 200\n");
        await seen();
    } else {
        writeFileSync(join(folder, "button"), "");
        await seen();
        rmSync(join(folder, "button"));
    }
}

before(async () => {
    writeFileSync(join(folder, "first.img"), made(FILE));
    const port = await freePort();
    start(port);
    await until("its name", () => log.match(/name (rgw-[0-9a-f]+)/), 30_000);
    name = log.match(/name (rgw-[0-9a-f]+)/)[1];
    await until("the board answers", async () => (await ask(port, "/api/v1/nonce")) === 200, 30_000);
    // Firmware without the page: the page is served beside it.
    if ((await ask(port, "/")) !== 200) {
        proxy = createServer((asked, answer) => {
            if (asked.url === "/") {
                answer.setHeader("Content-Security-Policy", readFileSync("../dist/policy.txt", "utf8").trim());
                answer.setHeader("Content-Type", "text/html; charset=utf-8");
                return answer.end(readFileSync("../dist/index.html"));
            }
            const forward = request({ host: "127.0.0.1", port, path: asked.url, method: asked.method, headers: asked.headers }, (found) => {
                answer.writeHead(found.statusCode, found.headers);
                found.pipe(answer);
                found.on("error", () => answer.destroy());
            });
            forward.on("error", () => answer.destroy());
            answer.on("close", () => forward.destroy());
            asked.pipe(forward);
        }).listen(0, "127.0.0.1");
        await new Promise((done) => proxy.once("listening", done));
    }
    address = `http://${name}:${proxy?.address().port ?? port}`;
    browser = await chromium.launch({
        executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
        args: ["--no-sandbox", `--host-resolver-rules=MAP ${name} 127.0.0.1`],
    });
});
after(async () => {
    if (process.env.DOCS === "write" && !IS_NUCLEO) copyFileSync(`${PICTURES}/claim.png`, "../../../docs/pictures/claim.png");
    await browser?.close();
    line?.destroy();
    proxy?.close();
    proxy?.closeAllConnections();
    machine?.kill("SIGKILL");
    rmSync(folder, { recursive: true, force: true });
});

const card = (page, title) => page.locator("section.card").filter({ has: page.getByRole("heading", { name: title, exact: true }) });

test("a board is claimed, changed, and returns from what cannot run", async () => {
    const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, locale: "en-GB", acceptDownloads: true });
    context.setDefaultTimeout(20_000);
    const page = await newPage(context);
    const errors = [];
    page.on("pageerror", (error) => errors.push(error.message));
    await page.goto(`${address}/`);

    // Claimed with its button.
    await page.getByRole("heading", { name: "This board belongs to nobody yet" }).waitFor();
    const give = page.getByRole("button", { name: "Give it this key" });
    assert.ok(await give.isDisabled());
    const [saved] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save the key as a file" }).click()]);
    assert.equal(saved.suggestedFilename(), `${name}.key`);
    const key = readFileSync(await saved.path(), "utf8").trim();
    await press(() => page.getByText("The button was pressed").waitFor());
    await page.screenshot({ path: `${PICTURES}/claim.png` });
    await give.click();
    await page.getByRole("link", { name: "Overview" }).waitFor();

    // A device is seen.
    line = connect(join(folder, "line"));
    line.on("error", () => {});
    const frames = setInterval(() => line.write(Buffer.from([255, 255, 1, 42, 238, 238])), 50);
    let received = Buffer.alloc(0);
    line.on("data", (data) => (received = Buffer.concat([received, data]).subarray(-500)));
    try {
        await card(page, "panel").getByText("working").waitFor();
        await card(page, "panel").getByText("WordInputReg[2]").waitFor();
        await page.screenshot({ path: `${PICTURES}/board.png` });
        assert.equal(await page.getByRole("link", { name: "Doctor" }).count(), 0);

        // Its configuration is shown as a file, and another one is imported.
        await page.getByRole("link", { name: "Configurations" }).click();
        const importing = async (name, bytes) => {
            const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.getByRole("button", { name: "Import …" }).click()]);
            await chooser.setFiles({ name, mimeType: "application/octet-stream", buffer: bytes });
        };
        const apply = async () => {
            await page.getByRole("button", { name: "Look at them and apply" }).click();
            await page.getByText("The board restarts").waitFor();
            await page.screenshot({ path: `${PICTURES}/board-review.png` });
            await page.getByRole("dialog").getByRole("button", { name: "Apply on trial" }).click();
        };
        const editor = page.getByLabel("The file");
        await until("its text", async () => (await editor.inputValue()).includes("WordInputReg[2]"));
        assert.deepEqual(made(await editor.inputValue()), made(FILE));
        const slower = FILE.replace("cycle_ms = 20", "cycle_ms = 30");
        await importing("cell.img", made(slower));
        await until("its text", async () => (await editor.inputValue()).includes("cycle_ms = 30"));
        assert.deepEqual(made(await editor.inputValue()), made(slower));

        // Edited in the form: the constant that the lamp gets, and a mistake before.
        await page.getByRole("link", { name: "Recipes" }).click();
        await page.getByRole("button", { name: /panel stream/ }).click();
        const output = page.locator("section.part").nth(1);
        const input = page.locator("section.part").nth(0).locator("ol.fields > li").nth(1);
        await input.getByLabel("To the variable").fill("WordInputReg[99]");
        await input.getByLabel("To the variable").press("Tab");
        await input.getByText("is no variable of the robot").waitFor();
        await input.getByLabel("To the variable").fill("WordInputReg[2]");
        await input.getByLabel("To the variable").press("Tab");
        await page.getByText("No mistake was found here.").waitFor();
        await output.locator("ol.fields > li").first().getByLabel("or the constant").fill("99");
        await output.locator("ol.fields > li").first().getByLabel("or the constant").press("Tab");
        await page.screenshot({ path: `${PICTURES}/board-recipes.png` });
        await apply();
        await page.getByText(/Revision \d+ is on trial/).waitFor();
        await until("the lamp", () => received.includes(Buffer.from([255, 255, 99, 254, 254])), 20_000);
        await page.getByRole("button", { name: "Keep it" }).click();
        await page.getByText(/is on trial/).waitFor({ state: "detached" });

        // What the board keeps is what host-sim makes of the text that the page shows.
        await page.getByRole("link", { name: "Configurations" }).click();
        await until("the text", async () => (await editor.inputValue()).includes("value = 99"));
        const text = await editor.inputValue();
        const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Image for a board" }).click()]);
        assert.deepEqual(readFileSync(await download.path()), made(text));

        // Two ports that own one variable: only the board finds out, and returns.
        await page.getByRole("link", { name: "Recipes" }).click();
        await page.getByRole("button", { name: "Add a port" }).click();
        await apply();
        await page.getByText(/Revision \d+ was taken back: it did not start/).waitFor();
        await page.screenshot({ path: `${PICTURES}/board-failed.png` });
        await page.getByRole("button", { name: "Good" }).click();
        await page.getByRole("link", { name: "Overview" }).click();
        await card(page, "panel").getByText("working").waitFor();
        await page.getByRole("link", { name: "Log" }).click();
        await page.getByText("configuration").first().waitFor();
        assert.ok(!(await page.locator("pre.log").innerText()).includes(key));
        await page.getByRole("link", { name: "Firmware" }).click();
        await page.getByText(`This board takes no update: ${NO_UPDATE}.`).waitFor();
        await page.screenshot({ path: `${PICTURES}/board-firmware.png` });
        await page.getByRole("link", { name: "Live" }).click();
        await card(page, "Frames").locator("tbody tr").first().waitFor();
        await page.screenshot({ path: `${PICTURES}/board-live.png` });
        assert.deepEqual(errors, []);
    } catch (error) {
        await page.screenshot({ path: `${PICTURES}/board-wrong.png` });
        console.error(log.slice(-4000));
        throw error;
    } finally {
        clearInterval(frames);
        await context.close();
    }
});
