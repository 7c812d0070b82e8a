// Update files for the tests, made by `host-sim ctl sign` of small programs, and a board that takes them.
import { execFileSync } from "node:child_process";
import { createHash } from "node:crypto";
import { readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { PROGRAM } from "./cell.mjs";

export const BOARD = "nucleo-h743zi";
export const HEADER = 192;
const SLOTS = { A: 0x0802_0000, B: 0x0810_0000 };

/** A program of so many bytes that is linked for a slot, as an ELF file. */
function elf(slot, length) {
    const start = SLOTS[slot] + 1024;
    const image = Buffer.from(Array.from({ length }, (_, at) => (at * 7 + slot.charCodeAt(0)) & 255));
    image.writeUInt32LE(0x2002_0000, 0);
    image.writeUInt32LE(start + 9, 4);
    const head = Buffer.alloc(84);
    head.write("\x7fELF\x01\x01\x01", "latin1");
    head.writeUInt16LE(2, 16);
    head.writeUInt16LE(40, 18);
    head.writeUInt32LE(1, 20);
    head.writeUInt32LE(52, 28);
    head.writeUInt16LE(52, 40);
    head.writeUInt16LE(32, 42);
    head.writeUInt16LE(1, 44);
    [1, 84, start, start, length, length, 5, 4].forEach((word, nth) => head.writeUInt32LE(word, 52 + 4 * nth));
    return Buffer.concat([head, image]);
}

/** An update file of this version, with images of so many bytes. */
export function signed(folder, version, length = 50_001) {
    const at = (name) => join(folder, name);
    const key = at("firmware.key");
    try {
        readFileSync(key);
    } catch {
        execFileSync(PROGRAM, ["ctl", "keygen", "--signing", key], { stdio: "pipe" });
    }
    for (const slot of ["A", "B"]) writeFileSync(at(`${slot}.elf`), elf(slot, length));
    const files = ["--slot-a", at("A.elf"), "--slot-b", at("B.elf"), "-o", at(`${version}.rgu`)];
    execFileSync(PROGRAM, ["ctl", "sign", "--signing-key", key, "--board", BOARD, "--version", version, ...files], { stdio: "pipe" });
    return new Uint8Array(readFileSync(at(`${version}.rgu`)));
}

const crc32 = (bytes) => {
    let crc = ~0;
    for (const byte of bytes) {
        crc ^= byte;
        for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
    }
    return ~crc >>> 0;
};

/** A file whose headers were changed, and have their CRC again. Its signatures are wrong now. */
export function resealed(file, change) {
    const copy = file.slice();
    const view = new DataView(copy.buffer);
    for (let at = 16; at < copy.length; at += HEADER + Math.ceil(view.getUint32(at + 76, true) / 32) * 32) {
        change(copy, at);
        view.setUint32(at + 188, crc32(copy.subarray(at + 64, at + 188)), true);
    }
    return copy;
}

/** A file with one byte more in each image. */
export function lengthened(file) {
    const parts = [Buffer.from(file.subarray(0, 16))];
    const view = new DataView(file.buffer, file.byteOffset);
    for (let at = 16; at < file.length; ) {
        const length = view.getUint32(at + 76, true);
        const image = Buffer.concat([file.subarray(at + HEADER, at + HEADER + length), Buffer.alloc(1)]);
        const header = Buffer.from(file.subarray(at, at + HEADER));
        header.writeUInt32LE(image.length, 76);
        header.writeUInt32LE(crc32(image), 184);
        parts.push(header, image, Buffer.alloc(-image.length & 31, 255));
        at += HEADER + Math.ceil(length / 32) * 32;
    }
    const longer = Buffer.concat(parts);
    longer.writeUInt32LE(longer.length, 12);
    return resealed(new Uint8Array(longer), () => {});
}

const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const newerThan = (a, b) => a.split(".").map(Number).reduce((found, part, nth) => found || part - Number(b.split(".")[nth]), 0);

/** What `docs/api.md` says of a board with slots, as a server: what it takes and when it restarts, without a cell. */
export class Board {
    version = "0.3.0";
    sha512 = "00112233445566ff";
    slot = "A";
    other = null;
    incoming = null;
    last = null;
    trial = null;
    /** Requests that change something, by method and path. */
    changes = [];
    /** Bytes of images that came in pieces. */
    bytesTaken = 0;
    /** Nobody is answered. */
    isAway = false;
    /** Why a header is refused with 422. */
    refuses = null;
    /** So many bytes are taken, and then the connection is lost. */
    loseAt = Infinity;
    /** The firmware that is tried does not start. */
    failsToStart = false;
    /** What it waits for. */
    waitsFor = "ports";
    /** Time of a step in milliseconds: erasing, checking, starting. */
    step = 300;
    cannot = undefined;
    /** Steps that a test holds until it has seen what is shown meanwhile. */
    held = {};

    constructor(key) {
        this.key = key;
        this.began = Date.now();
        this.server = createServer((asked, answer) => this.answer(asked, answer).catch(() => answer.destroy()));
    }

    async listen() {
        await new Promise((done) => this.server.listen(0, "127.0.0.1", done));
        this.address = () => `http://127.0.0.1:${this.server.address().port}`;
        return this;
    }

    end() {
        this.server.closeAllConnections();
        this.server.close();
    }

    /** From now on `name` lasts until `goOn(name)`: "erasing", "sending" (at a third), "lost", "restart" or "trial". */
    hold(name) {
        let goOn;
        const until = new Promise((done) => (goOn = done));
        this.held[name] = { until, goOn };
    }

    goOn(name) {
        this.held[name].goOn();
        delete this.held[name];
    }

    /** The step `name`: so many milliseconds, and longer if it is held. */
    async lasts(name, ms = this.step) {
        await wait(ms);
        await this.held[name]?.until;
    }

    document() {
        const { board = BOARD, version, slot, cannot } = this;
        if (cannot) return { board: "mps2-an500", version, cannot };
        const left_s = this.trial ? Math.max(0, (this.trial.until - Date.now()) / 1000) : 0;
        return {
            ...{ board, version, slot, good: this.trial ? (slot === "A" ? "B" : "A") : slot },
            ...(this.trial && { trial: { left_s, waits_for: this.waitsFor } }),
            ...(this.other && { other: this.other }),
            ...(this.incoming && { incoming: { ...this.incoming, image: undefined } }),
            ...(this.last && { last: this.last }),
        };
    }

    /** Runs what is in the other slot, or this again. */
    async restart(change) {
        await wait(50);
        this.isAway = true;
        await wait(this.step);
        this.incoming = null;
        change();
        this.began = Date.now();
        await this.lasts("restart");
        this.isAway = false;
    }

    swap() {
        const { version, sha512 } = this;
        Object.assign(this, this.other);
        this.other = { version, sha512 };
        this.slot = this.slot === "A" ? "B" : "A";
    }

    endTrial(how) {
        const { slot } = this;
        clearTimeout(this.timer);
        void this.restart(() => {
            this.last = { slot, ended: how };
            this.trial = null;
            this.swap();
        });
    }

    async answer(asked, answer) {
        const url = new URL(asked.url, "http://board");
        const json = (status, value) => answer.writeHead(status, { "Content-Type": "application/json" }).end(JSON.stringify(value));
        if (this.isAway) return asked.socket.destroy();
        if (url.pathname === "/") {
            answer.setHeader("Content-Security-Policy", readFileSync("../dist/policy.txt", "utf8").trim());
            return answer.setHeader("Content-Type", "text/html; charset=utf-8").end(readFileSync("../dist/index.html"));
        }
        if (asked.headers.authorization !== `Bearer ${this.key}`) return json(401, { error: "the key is needed" });
        const name = `${asked.method} ${url.pathname.slice("/api/v1/".length)}`;
        const parts = [];
        for await (const part of asked) parts.push(part);
        const body = Buffer.concat(parts);
        if (asked.method !== "GET") this.changes.push(name);
        const uptime = (Date.now() - this.began) / 1000;
        switch (name) {
            case "GET info":
                return json(200, { role: "board", name: "rgw-3a10c4", version: this.version, uptime_s: uptime, can_be_changed: true, claimed: true });
            case "GET stream":
                return this.stream(answer);
            case "GET revisions":
                return json(200, { kept: [], base: "0-00000000" });
            case "GET config":
                return json(404, { error: "no configuration was stored" });
            case "GET update":
                return json(200, this.document());
            case "PUT update":
                return this.piece(url.searchParams, body, json, asked.socket);
            case "POST update/try":
                return this.tryIt(JSON.parse(body).confirm_s, json);
            case "POST update/confirm":
                if (!this.trial) return json(409, { error: "no firmware is on trial" });
                clearTimeout(this.timer);
                this.last = { slot: this.slot, ended: "confirmed" };
                this.trial = null;
                return json(200, this.document());
            case "POST update/back":
                json(202, this.document());
                return this.endTrial("taken_back");
            default:
                return json(404, { error: "there is no such path" });
        }
    }

    piece(query, body, json, socket) {
        const offset = Number(query.get("offset"));
        const done = () => json(200, this.document());
        if (offset > 0) {
            const { incoming } = this;
            if (incoming?.state !== "receiving") return json(409, { error: "the slot is being erased or checked; `update` says when that is done" });
            if (offset !== incoming.received) return json(409, { error: `the next piece begins at ${incoming.received}` });
            if (incoming.received > this.loseAt) {
                // It was taken, and its answer never came.
                [this.loseAt, this.isAway] = [Infinity, true];
                void this.lasts("lost").then(() => (this.isAway = false));
                this.store(body);
                return socket.destroy();
            }
            this.store(body);
            const isFar = incoming.received > incoming.length / 3;
            return void this.lasts(isFar ? "sending" : "", this.pieceMs ?? 0).then(done);
        }
        const version = [160, 162, 164].map((at) => body.readUInt16LE(at)).join(".");
        const older = `the firmware ${version} is older than the one that runs, ${this.version}; a downgrade has to be asked for`;
        if (this.trial) return json(409, { error: "a firmware is on trial; confirm it or take it back first" });
        if (body.length !== HEADER) return json(422, { error: "offset 0 is the header alone, 192 bytes" });
        if (this.refuses) return json(422, { error: this.refuses });
        if (newerThan(version, this.version) < 0 && query.get("downgrade") !== "yes") return json(422, { error: older });
        const [sha512, length] = [body.toString("hex", 96, 104), HEADER + body.readUInt32LE(76)];
        if (this.incoming?.sha512 === sha512 && this.incoming.state !== "failed") return done();
        if (this.other?.sha512 === sha512) {
            this.incoming = { state: "ready", version, sha512, length, received: length };
            return done();
        }
        const incoming = { state: "erasing", version, sha512, length, received: HEADER, image: [] };
        this.incoming = incoming;
        this.other = null;
        void this.lasts("erasing").then(() => (incoming.state = "receiving"));
        return done();
    }

    store(body) {
        const { incoming } = this;
        incoming.image.push(body);
        incoming.received += body.length;
        this.bytesTaken += body.length;
        if (incoming.received < incoming.length) return;
        incoming.state = "checking";
        const digest = createHash("sha512").update(Buffer.concat(incoming.image)).digest("hex");
        setTimeout(() => {
            const isWhole = digest.startsWith(incoming.sha512);
            incoming.state = isWhole ? "ready" : "failed";
            if (isWhole) this.other = { version: incoming.version, sha512: incoming.sha512 };
            else incoming.why = "the firmware is another one than that which was signed";
        }, this.step);
    }

    tryIt(confirm_s, json) {
        if (this.foreign) return json(422, { error: "the firmware was not signed with the key of this board" });
        if (!this.other) return json(409, { error: "no firmware was received and checked" });
        this.confirm_s = confirm_s;
        json(202, this.document());
        return void this.restart(() => {
            if (this.failsToStart) return (this.last = { slot: this.slot === "A" ? "B" : "A", ended: "failed" });
            const ms = this.trialMs ?? confirm_s * 1000;
            this.swap();
            this.trial = { until: Date.now() + ms };
            this.timer = setTimeout(() => void this.lasts("trial", 0).then(() => this.endTrial("not_confirmed")), ms);
        });
    }

    stream(answer) {
        answer.writeHead(200, { "Content-Type": "text/event-stream" });
        const tell = () => {
            // A board that restarts closes no connection.
            if (this.isAway) return;
            const port = { bus: "rs485", recipe: 0, state: "working", age_ms: 12, overdue: 0, reply: "pending", counters: { frames_in: 100 } };
            const status = { time_us: Date.now() * 1000, health: "running", ports: { force: port, panel: port }, links: { state: { kind: "state", state: "up", counters: {}, history: {} } } };
            answer.write(`event: status\ndata: ${JSON.stringify(status)}\n\nevent: values\ndata: {"values":{}}\n\n`);
        };
        tell();
        const timer = setInterval(tell, 250);
        answer.on("close", () => clearInterval(timer));
    }
}
