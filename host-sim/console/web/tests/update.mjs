// Update files as the page reads them, beside what `host-sim ctl` says of them: node --test tests/update.mjs
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, test } from "node:test";
import { PROGRAM } from "./cell.mjs";
import { BOARD, HEADER, lengthened, signed } from "./firmware.mjs";
import { load } from "./load.mjs";

const { ROOM, compared, fitting, linksOf } = await load("update.ts");
const { crc32 } = await load("image.ts");
const folder = mkdtempSync(join(tmpdir(), "rgw-update-"));
after(() => rmSync(folder, { recursive: true }));

const LENGTH = 5001;
const file = signed(folder, "0.4.1", LENGTH);
const SECOND = 16 + HEADER + Math.ceil(LENGTH / 32) * 32;

/** The file with a change; `seal` gives the headers their CRC again. */
function changed(change, seal = false) {
    const copy = file.slice();
    const other = change(copy) ?? copy;
    if (seal)
        for (const at of [16, SECOND]) new DataView(other.buffer).setUint32(at + 188, crc32(other.subarray(at + 64, at + 188)), true);
    return other;
}

test("what ctl has signed is read as ctl inspects it", () => {
    const links = linksOf(file);
    const { links: rows, ...all } = JSON.parse(execFileSync(PROGRAM, ["ctl", "inspect", join(folder, "0.4.1.rgu"), "--json"], { encoding: "utf8" }));
    for (const [nth, link] of links.entries()) {
        assert.deepEqual([link.version, link.board, link.reads], [all.version, all.board, all.reads]);
        assert.equal(link.slot, rows[nth].slot);
        assert.equal(link.bytes.length, HEADER + rows[nth].length);
        assert.ok(rows[nth].sha512.startsWith(link.sha512) && link.sha512.length === 16);
    }
    assert.deepEqual(links[0].bytes, file.slice(16, 16 + HEADER + LENGTH));
    assert.deepEqual(links[1].bytes, file.slice(SECOND, SECOND + HEADER + LENGTH));
});

test("the free slot's firmware is picked, and refused for another board, without a link, or too long", () => {
    const links = linksOf(file);
    assert.equal(fitting(links, BOARD, "A").slot, "B");
    assert.equal(fitting(links, BOARD, "B").slot, "A");
    assert.throws(() => fitting(links, "mps2-an500", "A"), /this is a mps2-an500; the firmware is for the board nucleo-h743zi/i);
    assert.throws(() => fitting(links.slice(0, 1), BOARD, "A"), /Slot B is free/);
    const long = { ...links[1], bytes: new Uint8Array(HEADER + ROOM[BOARD] + 1) };
    assert.throws(() => fitting([links[0], long], BOARD, "A"), /has 654337 bytes; a slot has room for 654336/);
    assert.equal(linksOf(lengthened(file))[1].bytes.length, HEADER + LENGTH + 1);
    const longest = { ...links[1], bytes: new Uint8Array(HEADER + ROOM[BOARD]) };
    assert.equal(fitting([links[0], longest], BOARD, "A"), longest);
});

test("the room of each board is that of its slots", () => {
    const layout = readFileSync("../../../firmware/update/src/layout.rs", "utf8");
    const rooms = [...layout.matchAll(/Layout = Layout \{\s*board: "(.*)",\s*sector: (0x[\dA-F_]+),[\s\S]*?slot_sectors: (\d+)/g)].map(([, board, sector, count]) => [board, Number(sector.replaceAll("_", "")) * Number(count) - 1024]);
    assert.ok(rooms.length > 0);
    assert.deepEqual(ROOM, Object.fromEntries(rooms));
});

test("what is damaged, cut or something else is refused", () => {
    const refused = (bytes, why) => assert.throws(() => linksOf(bytes), why);
    refused(new Uint8Array(0), /no update file/);
    refused(file.slice(0, 15), /no update file/);
    refused(new TextEncoder().encode("[controller]\naddress = 1\n"), /no update file/);
    refused(changed((copy) => void (copy[4] = 2)), /version 2; this page reads 1/);
    for (const length of [16, 100, 300, SECOND, file.length - 1]) refused(file.slice(0, length), /cut short or changed/);
    refused(changed((copy) => Uint8Array.from([...copy, 0])), /cut short or changed/);
    // Also if the head says that it is so long.
    const resized = (length) => {
        const copy = new Uint8Array(length);
        copy.set(file.subarray(0, length));
        new DataView(copy.buffer).setUint32(12, length, true);
        return copy;
    };
    for (const length of [16, 100, 300, SECOND, SECOND + HEADER, file.length - 1, file.length + 32]) refused(resized(length), /damaged at byte/);
    for (const count of [0, 1, 3]) refused(changed((copy) => void (copy[8] = count)), /damaged at byte/);
    // A header that is right in itself, and wrong here.
    refused(changed((copy) => void (copy[16 + 68] = 2), true), /damaged at byte 84/);
    refused(changed((copy) => void (copy[16 + 72] = 2), true), /damaged/);
    refused(changed((copy) => void (copy[16 + 72] = 1), true), /damaged/);
    refused(changed((copy) => copy.fill(0, 16 + 76, 16 + 80), true), /damaged/);
    refused(changed((copy) => copy.fill(255, 16 + 76, 16 + 80), true), /damaged/);
    refused(changed((copy) => void (copy[SECOND + 80] = 0x6d), true), /damaged/);
    refused(changed((copy) => void (copy[SECOND + 160] = 9), true), /damaged/);
});

test("every changed byte is found, but for those of a signature", () => {
    for (let at = 0; at < file.length; at += at < 300 ? 1 : 13) {
        const isSignature = [16, SECOND].some((start) => at >= start && at < start + 64);
        const bytes = changed((copy) => void (copy[at] ^= 0x10));
        if (isSignature) linksOf(bytes);
        else assert.throws(() => linksOf(bytes), `byte ${at}`);
    }
});

test("versions are compared by their numbers", () => {
    assert.ok(compared("0.10.0", "0.9.9") > 0);
    assert.ok(compared("0.3.0", "1.0.0") < 0);
    assert.equal(compared("0.3.1", "0.3.1"), 0);
    assert.ok(compared("0.3.2", "0.3.1") > 0);
});
