// What the page knows: documents of the API, and whether they are still true.
import { computed, effect, signal } from "@preact/signals";
import { Refused, askJson, follow, key } from "./api";

export interface Histogram {
    count: number;
    p50_us: number;
    p99_us: number;
    max_us: number;
    buckets: number[];
}
export interface PortStatus {
    bus: string;
    recipe?: number;
    state: string;
    age_ms?: number;
    overdue: number;
    reply: string;
    counters: Record<string, number>;
    bus_state?: string;
    command?: string;
    last_rejection?: { text: string; age_ms: number; len: number; bytes: string; can_id?: string };
    last_not_given?: { text: string; age_ms: number; value: number };
    last_failed?: { command: string; age_ms: number };
    peers?: Record<string, { presence: string; missed_periods: number; counters?: PeerCounters }>;
}
/** Numbers, and in `events` numbers of what became of events. */
export type PeerCounters = Record<string, number | Record<string, number>>;
export interface LinkStatus {
    kind: string;
    state: string;
    counters: Record<string, number>;
    history: Record<string, number>;
}
export interface State {
    code: number;
    name?: string;
}
export interface Status {
    time_us: number;
    health: string;
    ports: Record<string, PortStatus>;
    links: Record<string, LinkStatus>;
    controller?: { mode?: State; robot?: State; program?: State; safety?: State; age_ms?: number };
    latency?: Record<string, Histogram>;
}
export interface Value {
    value: number;
    age_ms: number;
    owner?: string;
}
export interface Frame {
    time_us: number;
    port: string;
    direction: "in" | "out";
    verdict: string;
    bytes: string;
    values?: Record<string, unknown>;
}
export interface Info {
    role: "gateway" | "controller" | "board";
    version: string;
    name?: string;
    uptime_s: number;
    can_be_changed: boolean;
    revision?: number;
    claimed?: boolean;
    /** Seconds in which a board takes a key. */
    claim_left_s?: number;
    /** The port of the other page of this machine. */
    peer_port?: number;
}

export const info = signal<Info | null>(null);
export const isBoard = computed(() => info.value?.role === "board");
export const isController = computed(() => info.value?.role === "controller");
/** A board that has no key yet. */
export const isUnclaimed = computed(() => isBoard.value && info.value?.claimed === false);
export const status = signal<Status | null>(null);
export const values = signal<Record<string, Value>>({});
/** The newest frames, the newest last. Only kept while somebody looks. */
export const frames = signal<Frame[]>([]);
export const framesLost = signal(0);
export const framesAreWatched = signal(false);

/** Nothing that is shown is older than this, or it is shown as old. */
const OLD_MS = 2000;
/** A stream without an event for so long is opened again. */
const QUIET_MS = 4000;
const MOST_FRAMES = 400;

const heardAt = signal(0);
const now = signal(performance.now());
/** Whether the peer was heard of lately. */
export const isAlive = computed(() => heardAt.value > 0 && now.value - heardAt.value < OLD_MS);
/** Seconds since the peer was heard of; 0 before the first time. */
export const silentFor = computed(() =>
    heardAt.value > 0 ? Math.max(0, Math.round((now.value - heardAt.value) / 1000)) : 0,
);
/** Why there is no stream. */
export const streamError = signal("");

/** Frames a second of each port and direction, over the last second. */
export const rates = signal<Record<string, { in: number; out: number }>>({});
let before: Status | null = null;

function takeStatus(newest: Status) {
    status.value = newest;
    if (!before || newest.time_us < before.time_us) before = newest;
    const passed = (newest.time_us - before.time_us) / 1e6;
    if (passed < 0.95) return;
    const found: Record<string, { in: number; out: number }> = {};
    for (const [name, port] of Object.entries(newest.ports ?? {})) {
        const old = before.ports[name]?.counters;
        if (!old) continue;
        const rate = (key: string) => Math.max(0, ((port.counters[key] ?? 0) - (old[key] ?? 0)) / passed);
        found[name] = { in: rate("frames_in"), out: rate("frames_out") };
    }
    rates.value = found;
    before = newest;
}

let waiting: Frame[] = [];

function take(event: string, data: unknown) {
    heardAt.value = performance.now();
    now.value = heardAt.value;
    if (event === "status") {
        takeStatus(data as Status);
        // Frames come twenty times a second, which is more than anybody reads: they are shown with the state.
        if (waiting.length > 0) frames.value = [...frames.value, ...waiting].slice(-MOST_FRAMES);
        waiting = [];
    } else if (event === "values") values.value = (data as { values: Record<string, Value> }).values;
    else if (event === "frames") {
        const { frames: newer, lost } = data as { frames: Frame[]; lost?: number };
        framesLost.value += lost ?? 0;
        waiting = [...waiting, ...newer].slice(-MOST_FRAMES);
    }
}

/** Keeps a stream open while the page can be seen. */
export function watch() {
    setInterval(() => (now.value = performance.now()), 250);
    let running: AbortController | null = null;
    const isSeen = signal(!document.hidden);
    document.addEventListener("visibilitychange", () => (isSeen.value = !document.hidden));
    effect(() => {
        // Another key or another kind of stream: a new one.
        void key.value;
        const name = framesAreWatched.value ? "stream?frames=1" : "stream";
        running?.abort();
        running = null;
        if (!isSeen.value) return;
        const own = (running = new AbortController());
        void keepOpen(name, own.signal);
    });
}

async function keepOpen(name: string, end: AbortSignal) {
    while (!end.aborted) {
        let wait = 1000;
        // A stream that says nothing is given up and opened again: its server may have restarted.
        const own = new AbortController();
        const signal = AbortSignal.any([end, own.signal]);
        let since = performance.now();
        const timer = setInterval(() => {
            if (performance.now() - Math.max(since, heardAt.peek()) > QUIET_MS) own.abort();
        }, 500);
        try {
            info.value = await askJson<Info>("info", { signal });
            streamError.value = "";
            since = performance.now();
            if (!isUnclaimed.value) await follow(name, take, signal);
        } catch (error) {
            if (end.aborted) return;
            streamError.value = error instanceof Refused ? error.message : "";
            // Without a key there is nothing to be heard until one is given.
            if (error instanceof Refused && error.status === 401) return;
            if (error instanceof Refused && error.status === 429) wait = 10_000;
        } finally {
            clearInterval(timer);
        }
        await new Promise((resolve) => setTimeout(resolve, wait));
    }
}
