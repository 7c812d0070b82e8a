// The configuration that runs, the one that a person is working on, and the way from one to the other.
import { computed, signal } from "@preact/signals";
import { Refused, ask, askJson, key, post } from "./api";
import { Mistake, compile } from "./compile";
import { decompile } from "./decompile";
import { lookAtFirmware } from "./firmware";
import { encode, headOf } from "./image";
import { info, isBoard, isController, isUnclaimed } from "./state";
import { type File, read } from "./toml";

export interface Kept {
    revision: number;
    etag: string;
    stored_at?: number;
    from?: string;
}
export interface Revisions {
    kept: Kept[];
    live?: number;
    running?: number;
    previous?: number;
    waiting?: number;
    base?: string;
    trial?: { revision: number; left_s: number };
    last?: { revision: number; ended: string };
    failure?: string;
}
/** What `POST check` says. */
export interface Checked {
    ok: boolean;
    error?: string;
    key?: string;
    line?: number;
    column?: number;
    warnings?: string[];
}

export const revisions = signal<Revisions | null>(null);
/** The text of the revision that a change would be based on, and that revision's tag. A board keeps images; the text is
 * what makes the same image, or there is none and `wrong` says why. */
export const base = signal<{ text: string; etag: string; wrong?: string } | null>(null);
/** An image that a person has imported and that cannot be shown as a text. */
export const imported = signal<Uint8Array<ArrayBuffer> | null>(null);
/** There is something that does not run yet. */
export const isChanged = computed(() => draft.value !== null || imported.value !== null);
/** What the person has made of it; `null`: nothing was changed. */
export const draft = signal<string | null>(null);
export const checked = signal<Checked | null>(null);

/** The text that is edited. */
export const text = computed(() => draft.value ?? base.value?.text ?? "");
/** It as an object, or why it is none. */
export const file = computed<{ file: File; error?: undefined } | { file?: undefined; error: string }>(() => {
    try {
        return { file: read(text.value) };
    } catch (error) {
        return { error: error instanceof Error ? error.message.split("\n")[0]! : String(error) };
    }
});
/** Somebody else has stored another revision since this draft was begun. */
export const isOutrun = computed(
    () => isChanged.value && !revisions.value?.trial && !!revisions.value?.base && !!base.value && revisions.value.base !== base.value.etag,
);

/** Looks at what is kept; without a draft, at its newest text too. */
export async function look() {
    const newest = await askJson<Revisions>("revisions");
    revisions.value = newest;
    if (!isChanged.value) await load(newest);
}

/** What is on trial, or else what a change has to be based on. */
async function load(from: Revisions) {
    const kept = from.kept.find(({ etag, revision }) => (from.trial ? revision === from.trial.revision : etag === from.base));
    if (kept && kept.etag === base.value?.etag) return;
    const etag = kept?.etag ?? from.base ?? "";
    if (base.value && base.value.etag === etag) return;
    let found: { text: string; wrong?: string };
    try {
        found = await textOf(await ask(kept ? `config?revision=${kept.revision}` : "config"));
    } catch (error) {
        // A board that was given its configuration by a probe cannot show it.
        if (!isBoard.value || !(error instanceof Refused) || error.status !== 404) throw error;
        found = { text: "", wrong: error.message };
    }
    if (!isChanged.value && base.value?.etag !== etag) {
        base.value = { ...found, etag };
        checked.value = null;
    }
}

/** The text of a revision that was asked for. */
export async function textOf(answer: Response): Promise<{ text: string; wrong?: string }> {
    if (!isBoard.value) return { text: await answer.text() };
    try {
        return { text: decompile(new Uint8Array(await answer.arrayBuffer())) };
    } catch (error) {
        return { text: "", wrong: error instanceof Error ? error.message : String(error) };
    }
}

/** The image of a text, as `host-sim image` makes it. A host makes it of everything, the page of what it knows. */
export async function imageOf(text: string): Promise<Uint8Array<ArrayBuffer>> {
    if (isBoard.value) return encode(compile(read(text)));
    const answer = await ask("check?image=1", { method: "POST", body: text, type: "application/toml" });
    return new Uint8Array(await answer.arrayBuffer());
}

/** Takes a file that a person has chosen: a text, or an image. Throws what is wrong with it. */
export function take(bytes: Uint8Array<ArrayBuffer>) {
    if (bytes[0] !== 0x52 || bytes[1] !== 0x47 || bytes[2] !== 0x43 || bytes[3] !== 0x49) return edit(new TextDecoder("utf-8", { fatal: true }).decode(bytes));
    const whole = bytes.slice(0, headOf(bytes).length);
    try {
        edit(decompile(whole));
        imported.value = null;
    } catch (error) {
        // Only a board takes it as it is.
        if (!isBoard.value) throw error;
        imported.value = whole;
        draft.value = null;
    }
}

/** Takes an edited text, and has it checked by the gateway's own code. */
export function edit(newer: string) {
    draft.value = newer === base.value?.text ? null : newer;
    unchecked = newer;
    if (isBoard.value) checked.value = checkedHere(newer);
    else if (!isChecking) void check();
}

/** The newest text that nobody has been asked about yet. */
let unchecked: string | null = null;
let isChecking = false;

/** Asks what is wrong with the newest text. Not with each letter: one question at a time. */
async function check() {
    isChecking = true;
    while (unchecked !== null) {
        const of = unchecked;
        unchecked = null;
        let found: Checked;
        try {
            found = await askJson<Checked>("check", { method: "POST", body: of, type: "application/toml" });
        } catch (error) {
            found = { ok: false, error: error instanceof Error ? error.message : String(error) };
            if (error instanceof Refused && error.status === 503) {
                unchecked ??= of;
                await new Promise((resolve) => setTimeout(resolve, 300));
            }
        }
        if (unchecked === null) checked.value = found;
    }
    isChecking = false;
}

/** What is wrong with a text for a board. The rest the board finds out when it applies it. */
function checkedHere(of: string): Checked {
    try {
        encode(compile(read(of)));
        return { ok: true };
    } catch (error) {
        const message = (error instanceof Error ? error.message : String(error)).split("\n")[0]!;
        return { ok: false, error: message, ...(error instanceof Mistake ? { key: error.key } : {}) };
    }
}

/** Leaves the draft, and takes what is newest. */
export async function discard() {
    draft.value = null;
    imported.value = null;
    checked.value = null;
    base.value = null;
    const newest = await askJson<Revisions>("revisions");
    revisions.value = newest;
    await load(newest);
}

/** Stores the draft and runs it on trial. */
export async function apply(confirm_s: number) {
    if (isChanged.value && base.value) {
        const text = draft.value ?? "";
        const image = isBoard.value ? (imported.value ?? (await imageOf(text))) : null;
        const stored = await ask("config", {
            method: "PUT",
            body: image ?? text,
            type: image ? "application/octet-stream" : "application/toml",
            ifMatch: base.value.etag,
        });
        const newest = (await stored.json()) as Revisions;
        const etag = stored.headers.get("ETag") ?? newest.base ?? "";
        base.value = imported.value ? null : { text, etag };
        draft.value = null;
        imported.value = null;
        revisions.value = newest;
    }
    revisions.value = await post<Revisions>("apply", { confirm_s });
}

/** Runs a revision that is kept on trial. */
export async function applyKept(revision: number, confirm_s: number) {
    revisions.value = await post<Revisions>("apply", { confirm_s, revision });
}

export async function confirm() {
    revisions.value = await post<Revisions>("confirm", {});
}

export async function rollBack() {
    revisions.value = await post<Revisions>("rollback", {});
}

/** Looks again and again while the page is shown, if this is a gateway with configurations. */
export function watchRevisions() {
    let refused: string | null = null;
    const again = async () => {
        const isHere = info.value && !isController.value && !isUnclaimed.value;
        try {
            if (!document.hidden && isHere && refused !== key.value) {
                await look();
                // One after the other: a board has four connections for all.
                if (isBoard.value) await lookAtFirmware();
            }
        } catch (error) {
            // Until another key is given.
            if (error instanceof Refused && error.status === 401) refused = key.value;
        }
        setTimeout(() => void again(), info.value ? 1000 : 100);
    };
    void again();
}
