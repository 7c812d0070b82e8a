// A gateway file as the configuration of an image: what `host-sim image` does, for boards, which have no reader of
// files. It knows what the controller's own recipes have and all that ports have; frames that only devices have,
// exchanges and Modbus are refused here. Whether everything fits together the board decides.
import { ROWS as STATE } from "image-types";
import { SIZES } from "./frame";
import { type Struct, type Value, decode } from "./image";
import { type File, type Table, isTable } from "./toml";
import { variables } from "./variables";

/** What is wrong, with its key as `host-sim check` names it. */
export class Mistake extends Error {
    constructor(
        readonly key: string,
        message: string,
    ) {
        super(message);
    }
}

/** All variables; the place of each is its number in images. */
export const NAMES = [...variables(true), ...variables(false)].map(({ name }) => name);
export const NEVER_US = 100 * 365 * 86_400 * 1e6;
export const PARITIES = ["None", "Even", "Odd"];
export const LINKS: Record<string, string> = { command: "Command", urgent: "Urgent", state: "State", modbus: "Modbus", udp2011: "RecipeUdp" };
export const PORT_VALUES: Record<string, string> = { alive: "Alive", frames: "Frames", age_ms: "Age", rejected: "Rejected", ignored: "Ignored" };

/** Part of a list. */
export interface Span {
    start: number;
    len: number;
}

export const isSpan = (value: object) => "len" in value && typeof (value as Struct)["start"] === "number";

/** A name as an enum has it. */
export const capital = (word: string) => word[0]!.toUpperCase() + word.slice(1);

/** A table that is read key by key; what nobody asked for is refused. */
class Keys {
    private asked = new Set<string>();
    constructor(
        readonly table: Table,
        readonly path: string,
    ) {}
    fail(key: string, message: string): never {
        throw new Mistake(this.path ? `${this.path}.${key}` : key, message);
    }
    has(key: string) {
        return this.table[key] !== undefined;
    }
    get(key: string): unknown {
        this.asked.add(key);
        return this.table[key];
    }
    text(key: string, fallback?: string): string {
        const value = this.get(key) ?? fallback;
        return typeof value === "string" ? value : this.fail(key, value === undefined ? "is missing" : "must be a text");
    }
    flag(key: string): boolean {
        const value = this.get(key) ?? false;
        return typeof value === "boolean" ? value : this.fail(key, "must be true or false");
    }
    word(key: string, allowed: string[], fallback?: string): string {
        const word = this.text(key, fallback);
        return allowed.includes(word) ? word : this.fail(key, `"${word}" is unknown; allowed: ${allowed.join(", ")}`);
    }
    number(key: string, low: number, high: number, fallback?: number): number {
        const value = this.get(key) ?? fallback;
        if (typeof value !== "number" || Number.isNaN(value)) return this.fail(key, value === undefined ? "is missing" : "must be a number");
        return value >= low && value <= high ? value : this.fail(key, `${value} is out of range; allowed: ${low}..=${high}`);
    }
    whole(key: string, low: number, high: number, fallback?: number): number {
        const value = this.number(key, low, high, fallback);
        return Number.isInteger(value) ? value : this.fail(key, `${value} is no whole number`);
    }
    /** Microseconds of a time in ms. */
    time(key: string, low: number, high: number, fallback?: number): number {
        const us = Math.round(this.number(key, low, high, fallback) * 1000);
        return us > 0 || low === 0 ? us : this.fail(key, "must be above 0");
    }
    list(key: string): unknown[] {
        const value = this.get(key) ?? [];
        return Array.isArray(value) ? value : this.fail(key, "must be a list");
    }
    bytes(key: string): number[] {
        const list = this.list(key);
        const isRight = list.length <= 8 && list.every((byte) => Number.isInteger(byte) && (byte as number) >= 0 && (byte as number) < 256);
        return isRight ? (list as number[]) : this.fail(key, "at most 8 bytes are allowed");
    }
    tables(key: string): Keys[] {
        return this.list(key).map((one, nth) => {
            const name = isTable(one) && this.path === "" && typeof one["name"] === "string" ? `.${one["name"]}` : `[${nth + 1}]`;
            return new Keys(isTable(one) ? one : this.fail(`${key}[${nth + 1}]`, "must be a table"), `${this.path && `${this.path}.`}${key}${name}`);
        });
    }
    below(key: string): Keys {
        const value = this.get(key) ?? {};
        return new Keys(isTable(value) ? value : this.fail(key, "must be a table"), this.path ? `${this.path}.${key}` : key);
    }
    variable(key: string, text: string): number {
        const pendant = /^__(\w+)_(\d+)$/.exec(text);
        const found = NAMES.indexOf(pendant ? `${pendant[1]}[${pendant[2]}]` : text);
        return found >= 0 ? found : this.fail(key, `"${text}" is no variable of the robot`);
    }
    /** A variable and a bit of it, of `BitInputReg[3].4`. */
    bit(key: string, text: string): Struct | null {
        const match = /^(.*\])\.(\d+)$/.exec(text);
        if (!match) return null;
        const bit = Number(match[2]);
        return bit < 8 ? { var: this.variable(key, match[1]!), bit } : this.fail(key, `"${text}": a byte has bits 0 to 7`);
    }
    end() {
        for (const key of Object.keys(this.table)) if (!this.asked.has(key)) this.fail(key, "a board's page cannot write this; make the image with host-sim image");
    }
}

/** Lists of an image that recipes and ports have parts of. */
class Pools {
    fields: Value[] = [];
    commands: Value[] = [];
    exchanges: Value[] = [];
    frames: Value[] = [];
    safe_values: Value[] = [];
    constructor(readonly ports: string[]) {}
}

const single = (value: number) => {
    const rounded = Math.fround(value);
    return Number.isFinite(rounded) ? rounded : NaN;
};

function scaled(field: Keys): { scale: number; offset: number } {
    const one = (key: string, fallback: number) => {
        const value = single(field.number(key, -Infinity, Infinity, fallback));
        return Number.isNaN(value) ? field.fail(key, "out of range for a float") : value;
    };
    return { scale: one("scale", 1), offset: one("offset", 0) };
}

const integer = (text: string) => (/^[+-]?\d+$/.test(text) ? Number(text) : /^0x[0-9a-f]+$/i.test(text) ? parseInt(text.slice(2), 16) : NaN);

function commands(field: Keys, pools: Pools): Value {
    const start = pools.commands.length;
    const table = field.below("commands");
    for (const key of Object.keys(table.table)) {
        const [first, last = first] = key.split("..").map(integer) as [number, number?];
        if (!Number.isSafeInteger(first) || !Number.isSafeInteger(last)) table.fail(key, "the keys of commands are values of the field, such as 1, or ranges, such as \"1..100\"");
        const text = table.text(key);
        if (text === "") table.fail(key, "the command is empty");
        if (new TextEncoder().encode(text).length > 96) table.fail(key, "at most 96 bytes are allowed");
        pools.commands.push({ first, last, text });
    }
    if (pools.commands.length === start) field.fail("commands", "there are none");
    const when = field.word("when", ["change", "frame"], "change");
    const isKept = field.word("base", ["reset", "keep"], "reset") === "keep";
    if (isKept && when === "frame") field.fail("base", "allowed only with when = \"change\"");
    if (field.has("idle")) {
        const idle = field.whole("idle", -(2 ** 31), 2 ** 32 - 1);
        pools.commands.push({ first: idle, last: idle, text: "" });
    }
    return { Commands: { table: { start, len: pools.commands.length - start }, when: isKept ? "Kept" : capital(when) } };
}

function input(field: Keys, pools: Pools): Value {
    if (field.has("commands")) return field.has("to") ? field.fail("to", "beside commands only host-sim image writes it") : commands(field, pools);
    if (!field.has("to")) return "Unused";
    const name = field.text("to");
    const bit = field.bit("to", name);
    return bit ? { Bit: bit } : { Variable: { var: field.variable("to", name), ...scaled(field) } };
}

/** `joint_torque[3]` as the packet's row and item. */
function stateValue(field: Keys, name: string): Struct {
    if (name === "speed") return { row: 255, item: 0 };
    const match = /^(\w+)(?:\[(\d+)\])?$/.exec(name === "mode" ? "operation_mode" : name);
    const row = STATE.indexOf(match ? match[1]! + (match[2] ? "[]" : "") : "");
    const item = Number(match?.[2] ?? 1) - 1;
    return row >= 0 && item >= 0 && item < 64 ? { row, item } : field.fail("from", `"controller.${name}" is not in the state packet`);
}

function output(field: Keys, pools: Pools): Value {
    if (field.has("from") === field.has("value")) return field.fail("from", "a field takes from or value");
    if (field.has("value")) return { Constant: field.number("value", -Infinity, Infinity) };
    const from = field.text("from");
    if (from === "counter" || from === "reply") return capital(from);
    const [kind, ...rest] = from.split(".");
    const what = rest.pop() ?? "";
    const other = rest.join(".");
    if (kind === "controller") return { State: { value: stateValue(field, from.slice(kind.length + 1)), ...scaled(field) } };
    if (kind === "port") {
        const value = PORT_VALUES[what] ?? field.fail("from", `"${what}" is not known of a port`);
        const port = other === "" ? null : pools.ports.indexOf(other);
        return port !== null && port < 0 ? field.fail("from", `there is no port "${other}"`) : { Port: { port, value, ...scaled(field) } };
    }
    if (kind === "link") {
        const listening = pools.ports.indexOf(other);
        if (what !== "up" || (!LINKS[other] && listening < 0)) field.fail("from", `there is no link "${other}"`);
        return { Link: { link: LINKS[other] ?? { Listening: listening }, ...scaled(field) } };
    }
    const bit = field.bit("from", from);
    return bit ? { Bit: bit } : { Variable: { var: field.variable("from", from), ...scaled(field) } };
}

/** The fields of a part or of a frame. */
function fields(part: Keys, side: "input" | "output", isRealtime: boolean, pools: Pools): Struct {
    const start = pools.fields.length;
    for (const [nth, one] of part.list("fields").entries()) {
        const place = `fields[${nth + 1}]`;
        if (isRealtime) {
            const match = typeof one === "string" ? /^(\w+)\[(\d+)\.\.(\d+)\]$/.exec(one) : null;
            if (!match) {
                pools.fields.push({ System: part.variable(place, String(one)) });
                continue;
            }
            const [first, last] = [match[2], match[3]].map((index) => part.variable(place, `${match[1]}[${index}]`)) as [number, number];
            if (last < first) part.fail(place, "the range is backwards");
            for (let at = first; at <= last; at++) pools.fields.push({ System: at });
            continue;
        }
        if (!isTable(one)) part.fail(place, "must be a table with name and type");
        const field = new Keys(one as Table, `${part.path}.${place}`);
        field.text("name");
        const ty = capital(field.word("type", Object.keys(SIZES)));
        pools.fields.push(side === "input" ? { UserInput: { ty, to: input(field, pools) } } : { UserOutput: { ty, from: output(field, pools) } });
        field.end();
    }
    const len = pools.fields.length - start;
    if (len < 1 || len > 128) part.fail("fields", `${len} fields; allowed: 1..=128`);
    return { start, len };
}

/** Everything in a recipe that is counted from the beginning of a list, moved. */
export function moved(value: Value, by: Record<"fields" | "commands" | "exchanges" | "frames", number>, port: (nth: number) => number, key = ""): Value {
    if (Array.isArray(value)) return value.map((one) => moved(one, by, port, key));
    if (typeof value === "number") return ["request", "reply", "pending", "refusal"].includes(key) ? value + by.frames : ["port", "Listening"].includes(key) ? port(value) : value;
    if (typeof value !== "object" || value === null) return value;
    const { start, len } = value as unknown as Span;
    // An empty list is at 0, nowhere, or where one would begin; that of exchanges always is.
    if (isSpan(value)) return { start: len + start === 0 && key !== "exchanges" ? 0 : start + by[key === "table" ? "commands" : key === "exchanges" ? "exchanges" : "fields"], len };
    return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, moved(one, by, port, name)]));
}

/** A recipe that is kept as an image, since there is no way to write it as a text here. */
function kept(keys: Keys, pools: Pools): Value {
    const name = keys.text("name");
    let config: Struct;
    try {
        config = decode(Uint8Array.from(atob(keys.text("image")), (char) => char.charCodeAt(0)));
    } catch (error) {
        return keys.fail("image", String(error));
    }
    const ports = keys.list("ports");
    keys.end();
    const port = (nth: number) => {
        const place = pools.ports.indexOf(String(ports[nth]));
        return place >= 0 ? place : keys.fail("ports", `there is no port "${ports[nth]}"`);
    };
    const by = { fields: pools.fields.length, commands: pools.commands.length, exchanges: pools.exchanges.length, frames: pools.frames.length };
    const put = moved({ ...config, ports: [] }, by, port) as Record<keyof typeof by | "recipes", Value[]>;
    for (const list of ["fields", "commands", "exchanges", "frames"] as const) pools[list].push(...put[list]);
    return { ...(put.recipes[0] as Struct), name };
}

function recipe(keys: Keys, pools: Pools): Value {
    const name = keys.text("name");
    const kind = keys.word("kind", ["stream", "can", "image"]);
    if (kind === "image") return kept(keys, pools);
    const isCan = kind === "can";
    const mode = keys.word("mode", ["realtime", "user"]);
    let on_stale = "Hold";
    let send: Value = "Period";
    if (!keys.has("input") && !keys.has("output")) keys.fail("input", "a recipe needs an input or an output");
    const part = (side: "input" | "output"): Value => {
        if (!keys.has(side)) return isCan ? [] : null;
        const own = keys.below(side);
        if (side === "output") {
            on_stale = capital(own.word("on_stale", ["hold", "stop"], "hold"));
            const text = own.text("send", "period");
            const bit = text.startsWith("rising:") && own.bit("send", text.slice(7));
            send = bit ? { Rising: bit } : capital(own.word("send", ["period", "change", "frame"], "period"));
        }
        let made: Value;
        if (isCan)
            made = own.tables("frame").map((frame) => {
                const isLong = frame.flag("extended");
                const id = { [isLong ? "Extended" : "Standard"]: frame.whole("id", 0, isLong ? 0x1fffffff : 0x7ff) };
                const framed = { id, fields: fields(frame, side, mode === "realtime", pools) };
                frame.end();
                return framed;
            });
        else made = { head: own.bytes("head"), tail: own.bytes("tail"), fields: fields(own, side, mode === "realtime", pools), framing: "Fields", escape: null };
        own.end();
        return made;
    };
    const parts = { input: part("input"), output: part("output") };
    keys.end();
    return { name, mode: capital(mode), parts: { [isCan ? "Can" : "Stream"]: parts }, on_stale, send, exchanges: { start: pools.exchanges.length, len: 0 } };
}

export const ECHOES: Record<string, unknown> = { No: false, Yes: true, Auto: "auto" };

function echo(keys: Keys): Value {
    const value = keys.get("echo") ?? "auto";
    return Object.keys(ECHOES).find((name) => ECHOES[name] === value) ?? keys.fail("echo", 'must be true, false or "auto"');
}

function bus(keys: Keys): Value {
    const kind = keys.word("bus", ["rs485", "can", "tcp-listen", "udp-listen", "modbus-tcp"]);
    if (kind === "modbus-tcp") {
        // An IPv6 address is in brackets.
        const to = /^(?:\[(.+)]|([^:]+))(?::(\d+))?$/.exec(keys.text("to")) ?? keys.fail("to", "allowed: HOST or HOST:PORT");
        return { ModbusTcp: { host: to[1] ?? to[2], port: Number(to[3] ?? 502) } };
    }
    if (kind === "can") return { Can: { bitrate: keys.whole("bitrate", 10_000, 1_000_000, 500_000) } };
    if (kind !== "rs485") return { [kind === "tcp-listen" ? "TcpListen" : "UdpListen"]: { listen: keys.text("listen") } };
    return {
        Rs485: {
            baud: keys.whole("baud", 1200, 4_000_000, 115_200),
            parity: capital(keys.word("parity", ["none", "even", "odd"], "none")),
            stop_bits: keys.whole("stop_bits", 1, 2, 1),
            idle_gap: keys.time("idle_gap_ms", 1e-3, 1000, 50),
            turnaround: Math.round(keys.number("turnaround_us", 0, 1_000_000, 100)),
            echo: echo(keys),
        },
    };
}

function safeValues(keys: Keys, pools: Pools): Value {
    const start = pools.safe_values.length;
    const given = keys.get("on_timeout");
    if (given === undefined || given === "hold") return { start, len: 0 };
    const table = keys.below("on_timeout");
    for (const name of Object.keys(table.table)) {
        const bit = table.bit(name, name);
        const value = table.get(name);
        if (bit) {
            const mask = 1 << (bit["bit"] as number);
            if (![0, 1, false, true].includes(value as number)) table.fail(name, "a bit is 0 or 1");
            pools.safe_values.push({ var: bit["var"], value: { Byte: value ? mask : 0 }, mask });
            continue;
        }
        const place = table.variable(name, name);
        const type = /^Float|^Force/.test(name) ? "Float" : name.startsWith("Word") ? "Word" : "Byte";
        const number = type === "Float" ? single(table.number(name, -Infinity, Infinity)) : table.whole(name, 0, type === "Word" ? 65535 : 255);
        pools.safe_values.push({ var: place, value: { [type]: number }, mask: 255 });
    }
    return { start, len: pools.safe_values.length - start };
}

function port(keys: Keys, recipes: string[], pools: Pools): Value {
    const HOUR = 3_600_000;
    const recipe = recipes.indexOf(keys.text("recipe"));
    if (recipe < 0) keys.fail("recipe", `there is no recipe "${keys.text("recipe")}"`);
    const health = keys.below("health");
    const told = (key: string) => (health.has(key) ? health.variable(key, health.text(key)) : null);
    const made = {
        name: keys.text("name"),
        bus: bus(keys),
        recipe,
        cycle: keys.time("cycle_ms", 4, HOUR, 4),
        timeout: keys.get("timeout_ms") === "never" ? NEVER_US : keys.time("timeout_ms", 1e-3, HOUR, 100),
        on_timeout: safeValues(keys, pools),
        stale_after: keys.time("stale_after_ms", 1e-3, HOUR, 500),
        health: { alive: told("alive"), frames: told("frames"), age: told("age_ms"), rejected: told("rejected"), ignored: told("ignored") },
        safe_at_start: keys.flag("safe_at_start"),
        refresh: keys.has("refresh_ms") ? keys.time("refresh_ms", 1e-3, HOUR) : null,
        absent: keys.time("absent_ms", 1e-3, HOUR, 3000),
    };
    health.end();
    keys.end();
    return made;
}

function address(keys: Keys, key: string, text: string): number[] {
    const parts = text.split(".").map((part) => (/^\d{1,3}$/.test(part) ? Number(part) : 256));
    return parts.length === 4 && parts.every((part) => part < 256) ? parts : keys.fail(key, `"${text}" is no IPv4 address`);
}

/** The configuration of a file. Throws a `Mistake`. */
export function compile(file: File): Struct {
    const root = new Keys(file, "");
    const recipeKeys = root.tables("recipe");
    const portKeys = root.tables("port");
    if (recipeKeys.length > 16) root.fail("recipe", "at most 16 recipes are allowed");
    if (portKeys.length > 8) root.fail("port", "at most 8 ports are allowed");
    for (const list of [recipeKeys, portKeys])
        for (const [nth, keys] of list.entries()) {
            const name = keys.text("name");
            if (!/^[^\s"'=\p{Cc}]{1,32}$/u.test(name)) keys.fail("name", "1 to 32 characters without blanks, quotes and = are allowed");
            if (list.findIndex((other) => other.text("name") === name) < nth) keys.fail("name", "there is already one with this name");
        }
    const pools = new Pools(portKeys.map((keys) => keys.text("name")));
    const controller = root.below("controller");
    const servers = controller.below("ports");
    const server = (key: string, usual: number) => servers.whole(key, 1, 65535, usual);
    const udp = server("udp2011", 2011);
    const names = recipeKeys.map((keys) => keys.text("name"));
    let recipe_link: Value = null;
    if (controller.has("recipe_link")) {
        const link = controller.below("recipe_link");
        const place = names.indexOf(link.text("recipe"));
        if (place < 0) link.fail("recipe", "there is no such recipe");
        const udp_port = link.whole("udp", 1, 65535, udp);
        if (servers.has("udp2011") && udp_port !== udp) servers.fail("udp2011", `it is not controller.recipe_link.udp, ${udp_port}`);
        recipe_link = { udp_port, recipe: place };
        link.end();
    }
    const made = {
        controller: {
            address: controller.text("address"),
            dialect: controller.word("dialect", ["v2.3", "v2.6"], "v2.3"),
            command_port: server("command", 2000),
            state_port: server("state", 2001),
            modbus_port: server("modbus", 502),
            recipe_link,
        },
        network: "Dhcp" as Value,
        recipes: recipeKeys.map((keys) => recipe(keys, pools)),
        ports: portKeys.map((keys) => port(keys, names, pools)),
        fields: pools.fields,
        commands: pools.commands,
        safe_values: pools.safe_values,
        exchanges: pools.exchanges,
        frames: pools.frames,
    };
    servers.end();
    controller.end();
    if (root.has("network")) {
        const network = root.below("network");
        const [own = "", prefix] = network.text("address").split("/");
        const optional = (key: string) => (network.has(key) ? address(network, key, network.text(key)) : null);
        if (!/^\d+$/.test(prefix ?? "") || Number(prefix) < 1 || Number(prefix) > 30) network.fail("address", "write it with its prefix length, such as 192.168.12.20/24");
        made.network = { Static: { address: address(network, "address", own), prefix: Number(prefix), router: optional("router"), dns: optional("dns") } };
        network.end();
    }
    root.end();
    return made;
}
