// The firmware of a board: what it says of it, a file on its way to it, and a trial (docs/api.md section 9).
import { signal } from "@preact/signals";
import { Refused, askJson, post } from "./api";
import { HEADER, type Link, type Slot } from "./update";

/** The document `update`. */
export interface Firmware {
    board: string;
    version: string;
    slot?: Slot;
    cannot?: string;
    trial?: { left_s: number; waits_for: string };
    other?: { version: string; sha512: string };
    incoming?: { state: string; version: string; sha512: string; length: number; received: number; why?: string };
    last?: { slot: Slot; ended: string };
}

export const firmware = signal<Firmware | null>(null);
/** Why the board does not say it. */
export const untold = signal("");
/** What ran when this page came from the board. */
export const cameFrom = signal("");
/** The step of this page that sends a firmware; `lost` while the board is not reached. */
export const sending = signal<null | "goes" | "lost">(null);
/** The board was asked to restart with another firmware; `late` if it is not back after a minute. */
export const restart = signal<null | "soon" | "late">(null);
/** How a trial has ended that this page has begun or seen. */
export const ended = signal<{ version: string; how: string } | null>(null);

/** Bytes of an image that are sent at once: as many as a board takes. */
const PIECE = 16 << 10;
/** Time that a piece may take before its connection counts as lost. */
const PIECE_MS = 8000;
/** Time that a board may take to start again: three starts that the watchdog ends, and the one before. */
const RESTARTING_MS = 60_000;
/** Time between two looks, and two attempts. */
const AGAIN_MS = 300;
const LOST_MS = 1000;
/** So often a board may say that it does something else, without taking a byte meanwhile. */
const MOST_REFUSED = 5;

const wait = (ms: number) => new Promise((resolve) => setTimeout(resolve, ms));

/** A trial that was asked for, or is seen. */
let trial: { version: string; isSeen: boolean; lastBefore: string } | null = null;
let restartSince = 0;
let isTakenBack = false;
let isToStop = false;

function take(newest: Firmware) {
    firmware.value = newest;
    untold.value = "";
    cameFrom.value ||= newest.version;
    const last = JSON.stringify(newest.last ?? null);
    if (newest.trial) {
        trial = { version: newest.version, isSeen: true, lastBefore: last };
        ended.value = null;
        if (!isTakenBack) restart.value = null;
    } else if (trial && (trial.isSeen || last !== trial.lastBefore || restart.value === "late")) {
        ended.value = { version: trial.version, how: newest.last?.ended ?? "failed" };
        trial = null;
        restart.value = null;
    }
}

/** Asks what the board says. */
export async function lookAtFirmware() {
    try {
        if (!sending.value) take(await askJson<Firmware>("update"));
    } catch (error) {
        if (error instanceof Refused) untold.value = error.message;
    }
    if (restart.value && performance.now() - restartSince > RESTARTING_MS) restart.value = "late";
}

function expectRestart() {
    restart.value = "soon";
    restartSince = performance.now();
}

/** Sends a firmware into the free slot, or what is missing of it, until the board has computed its hash. What runs is not
 * touched. A lost connection is tried again until somebody stops it. Throws why the board does not take it. */
export async function send(link: Link, downgrade: boolean) {
    sending.value = "goes";
    ended.value = null;
    isToStop = false;
    // Where the next piece begins; `null` while the board has something else to do.
    let next: number | null = 0;
    let [refused, most] = [0, 0];
    try {
        while (!isToStop) {
            try {
                take(next === null ? await askJson<Firmware>("update") : await put(link, next, downgrade));
                sending.value = "goes";
            } catch (error) {
                // Something else is being done, or the answer to a piece was lost: the header is answered with what is there.
                const isPassing = error instanceof Refused && (error.status === 409 || error.status === 503);
                if (error instanceof Refused && !(isPassing && ++refused < MOST_REFUSED)) throw error;
                if (!isPassing) sending.value = "lost";
                next = 0;
                await wait(LOST_MS);
                continue;
            }
            const { incoming } = firmware.value!;
            if (incoming?.state === "ready") return;
            if (incoming?.state === "failed") throw new Error(incoming.why);
            // Without one the board was restarted.
            next = !incoming ? 0 : incoming.state === "receiving" ? incoming.received : null;
            if (incoming && incoming.received > most) [refused, most] = [0, incoming.received];
            if (incoming?.state !== "receiving") await wait(AGAIN_MS);
        }
    } finally {
        sending.value = null;
    }
}

function put(link: Link, offset: number, downgrade: boolean): Promise<Firmware> {
    const end = offset < HEADER ? HEADER : offset + PIECE;
    return askJson<Firmware>(`update?offset=${offset}${downgrade ? "&downgrade=yes" : ""}`, {
        method: "PUT",
        body: link.bytes.slice(offset, end),
        type: "application/octet-stream",
        signal: AbortSignal.timeout(PIECE_MS),
    });
}

/** Sends no further piece. Sending the same file again goes on there. */
export function stop() {
    isToStop = true;
}

/** Runs what was received on trial. */
export async function tryIt(version: string, confirm_s: number, downgrade: boolean) {
    ended.value = null;
    const lastBefore = JSON.stringify(firmware.value?.last ?? null);
    const newest = await post<Firmware>(`update/try${downgrade ? "?downgrade=yes" : ""}`, { confirm_s });
    isTakenBack = false;
    trial = { version, isSeen: false, lastBefore };
    expectRestart();
    take(newest);
}

/** Keeps the firmware that is on trial. */
export async function keep() {
    take(await post<Firmware>("update/confirm", {}));
}

/** Ends the trial: the board restarts with the firmware before. */
export async function takeBack() {
    const newest = await post<Firmware>("update/back", {});
    isTakenBack = true;
    expectRestart();
    take(newest);
}
