// Update files: one firmware, linked for each slot of a board (docs/update.md section 3). What is looked at here is
// looked at by the board once more; it alone checks hash and signature.
import { t } from "./i18n";
import { crc32 } from "./image";

export type Slot = "A" | "B";

/** The firmware for one slot. */
export interface Link {
    slot: Slot;
    board: string;
    version: string;
    /** The oldest and the newest version of the configuration image that it reads. */
    reads: [number, number];
    /** The first 16 digits of the image's SHA-512, as a board tells it. */
    sha512: string;
    /** What is sent: the header, and then the image. */
    bytes: Uint8Array<ArrayBuffer>;
}

export const HEADER = 192;
const FILE_HEAD = 16;
/** The filler behind an image is up to a multiple of this. */
const WORD = 32;
/** Longest image of each board in bytes: a slot without its first KiB. */
export const ROOM: Record<string, number> = { "mps2-an500": 5 * 0x20000 - 1024, "nucleo-h743zi": 5 * 0x20000 - 1024 };

/** The other slot. */
export const otherThan = (slot: Slot): Slot => (slot === "A" ? "B" : "A");

/** Reads a file. Throws what is wrong with it. */
export function linksOf(file: Uint8Array<ArrayBuffer>): Link[] {
    const view = new DataView(file.buffer, file.byteOffset, file.length);
    const number = (at: number) => view.getUint32(at, true);
    const begins = (at: number, name: string) => [...name].every((letter, nth) => file[at + nth] === letter.charCodeAt(0));
    if (file.length < FILE_HEAD || !begins(0, "RGUP")) throw new Error(t("This is no update file: it does not begin with RGUP."));
    const [version, count, said] = [number(4), number(8), number(12)];
    if (version !== 1) throw new Error(t("The update file has version {found}; this page reads {own}.", { found: version, own: 1 }));
    if (said !== file.length)
        throw new Error(t("The update file has {found} bytes and says that it has {said}: it was cut short or changed.", { found: file.length, said }));
    const links: Link[] = [];
    let at = FILE_HEAD;
    let first = "";
    const must = (holds: boolean, place: number) => {
        if (!holds) throw new Error(t("The update file is damaged at byte {at}.", { at: place }));
    };
    must(count === 1 || count === 2, 8);
    while (links.length < count) {
        must(at + HEADER <= file.length && begins(at + 64, "RGFW"), at + 64);
        must(crc32(file.subarray(at + 64, at + 188)) === number(at + 188), at + 188);
        must(number(at + 68) === 1 && number(at + 72) < 2, at + 68);
        const slot = number(at + 72) ? "B" : "A";
        const [image, length] = [at + HEADER, number(at + 76)];
        const end = image + length;
        const next = image + Math.ceil(length / WORD) * WORD;
        must(length > 0 && next <= file.length, at + 76);
        must(crc32(file.subarray(image, end)) === number(at + 184), image);
        must(file.subarray(end, next).every((byte) => byte === 0xff), end);
        // All are of one firmware: board, version, configurations and store are the same.
        const parts = `${file.subarray(at + 80, at + 96)} ${file.subarray(at + 160, at + 184)}`;
        must((first ||= parts) === parts && !links.some((link) => link.slot === slot), at + 72);
        links.push({
            slot,
            board: new TextDecoder().decode(file.subarray(at + 80, at + 96)).replace(/\0+$/, ""),
            version: [160, 162, 164].map((place) => view.getUint16(at + place, true)).join("."),
            reads: [number(at + 168), number(at + 172)],
            sha512: Array.from(file.subarray(at + 96, at + 104), (byte) => byte.toString(16).padStart(2, "0")).join(""),
            bytes: file.slice(at, end),
        });
        at = next;
    }
    must(at === file.length, at);
    return links;
}

/** What a board takes of a file: the firmware for its free slot. Throws why it takes none. */
export function fitting(links: Link[], board: string, running: Slot): Link {
    const named = links[0]!.board;
    if (named !== board) throw new Error(t("This is a {board}; the firmware is for the board {named}.", { board, named }));
    const free = otherThan(running);
    const link = links.find(({ slot }) => slot === free);
    if (!link) throw new Error(t("Slot {free} is free, and the file has no firmware linked for it.", { free }));
    const [length, room] = [link.bytes.length - HEADER, ROOM[board] ?? Infinity];
    if (length > room) throw new Error(t("The firmware has {length} bytes; a slot has room for {room}.", { length, room }));
    return link;
}

/** Which of two versions is newer: above 0 if the first one is. */
export function compared(first: string, second: string): number {
    const [a, b] = [first, second].map((version) => version.split(".").map(Number)) as [number[], number[]];
    return [0, 1, 2].reduce((found, nth) => found || a[nth]! - b[nth]!, 0);
}
