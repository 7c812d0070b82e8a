// Requests to the API: docs/api.md. The key is sent only to the machine's own loopback address; over a network
// requests are signed with it.
import { hmac } from "@noble/hashes/hmac.js";
import { sha256 } from "@noble/hashes/sha2.js";
import { bytesToHex, hexToBytes, utf8ToBytes } from "@noble/hashes/utils.js";
import { signal } from "@preact/signals";

const BASE = "/api/v1/";
const KEPT_AS = "recipe-gateway-key";
const IS_LOCAL = /^(localhost|127\.\d+\.\d+\.\d+|\[::1\])$/.test(location.hostname);

/** The key: 32 hexadecimal digits, or empty. It is kept for this tab only, and sent nowhere but as said above. */
export const key = signal(read());
/** A request was refused because there was no key, or a wrong one. */
export const keyIsAskedFor = signal<null | "needed" | "wrong">(null);

function read(): string {
    try {
        return sessionStorage.getItem(KEPT_AS) ?? "";
    } catch {
        return "";
    }
}

/** Takes a key for the requests that follow. */
export function useKey(text: string) {
    key.value = text;
    keyIsAskedFor.value = null;
    try {
        if (text) sessionStorage.setItem(KEPT_AS, text);
        else sessionStorage.removeItem(KEPT_AS);
    } catch {
        // Without storage the key is asked for again after a reload.
    }
}

/** An answer that is no success. */
export class Refused extends Error {
    constructor(
        readonly status: number,
        readonly answer: Record<string, unknown>,
    ) {
        super(typeof answer["error"] === "string" ? answer["error"] : `HTTP ${status}`);
    }
}

let nonce = "";

async function authorization(method: string, path: string, body: string | Uint8Array): Promise<Record<string, string>> {
    if (!key.value) return {};
    if (IS_LOCAL) return { Authorization: `Bearer ${key.value}` };
    if (!nonce) {
        const answer = await fetch(`${BASE}nonce`, { cache: "no-store", signal: AbortSignal.timeout(5_000) });
        nonce = ((await answer.json()) as { nonce: string }).nonce;
    }
    const used = nonce;
    nonce = "";
    const digest = bytesToHex(sha256(typeof body === "string" ? utf8ToBytes(body) : body));
    const text = `${used}\n${method}\n${path}\n${digest}\n`;
    const mac = bytesToHex(hmac(sha256, hexToBytes(key.value), utf8ToBytes(text)));
    return { Authorization: `RGW-HMAC-SHA256 nonce=${used}, body=${digest}, mac=${mac}` };
}

/** What goes beside the path. */
export interface Options {
    method?: "GET" | "POST" | "PUT";
    body?: string | Uint8Array<ArrayBuffer>;
    type?: "application/json" | "application/toml" | "application/octet-stream";
    ifMatch?: string;
    signal?: AbortSignal;
}

/** Asks, and returns the answer if it is a success. */
export async function ask(name: string, options: Options = {}): Promise<Response> {
    const { method = "GET", body = "", type, ifMatch, signal } = options;
    // A nonce can be too old: once more with a new one.
    for (let again = !IS_LOCAL && !!key.value; ; again = false) {
        const headers = await authorization(method, BASE + name, body);
        if (type) headers["Content-Type"] = type;
        if (ifMatch) headers["If-Match"] = ifMatch;
        const init: RequestInit = { method, headers, cache: "no-store" };
        if (body.length > 0) init.body = body;
        // A board that restarts closes no connection: nothing would ever come.
        init.signal = signal ?? AbortSignal.timeout(method === "GET" ? 5_000 : 20_000);
        const answer = await fetch(BASE + name, init);
        nonce = answer.headers.get("Next-Nonce") ?? nonce;
        if (answer.ok) return answer;
        const text = await answer.text();
        if (answer.status === 401) {
            if (again) continue;
            keyIsAskedFor.value = key.value ? "wrong" : "needed";
        }
        throw new Refused(answer.status, parsed(text));
    }
}

function parsed(text: string): Record<string, unknown> {
    try {
        const value: unknown = JSON.parse(text);
        return typeof value === "object" && value !== null ? (value as Record<string, unknown>) : {};
    } catch {
        return { error: text.slice(0, 200) };
    }
}

/** Asks for a JSON document. */
export async function askJson<T>(name: string, options?: Options): Promise<T> {
    return (await (await ask(name, options)).json()) as T;
}

/** Sends a JSON object. */
export function post<T>(name: string, body: object): Promise<T> {
    return askJson<T>(name, { method: "POST", body: JSON.stringify(body), type: "application/json" });
}

/** Server-sent events until the stream ends. `EventSource` cannot be signed, so this is `fetch`. */
export async function follow(name: string, take: (event: string, data: unknown) => void, end: AbortSignal) {
    const answer = await ask(name, { signal: end });
    const reader = answer.body!.pipeThrough(new TextDecoderStream()).getReader();
    let rest = "";
    for (;;) {
        const { value, done } = await reader.read();
        if (done) return;
        rest += value;
        const events = rest.split("\n\n");
        rest = events.pop()!;
        for (const event of events) {
            const name = /^event: (.*)$/m.exec(event)?.[1];
            const data = /^data: (.*)$/m.exec(event)?.[1];
            take(name ?? "", data === undefined ? undefined : JSON.parse(data));
        }
    }
}
