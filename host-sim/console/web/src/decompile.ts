// The configuration of an image as a gateway file, which can be edited as any other. An image has no comments and no
// names of fields; they are made up. A recipe that compile.ts could not make again stays as it is, as a text of its
// bytes: `kind = "image"`.
import { ROWS as STATE } from "image-types";
import { type Span, ECHOES, LINKS, NAMES, NEVER_US, PORT_VALUES, compile, isSpan, moved } from "./compile";
import { type Struct, type Value, decode, encode } from "./image";
import { type Table, read, replaced } from "./toml";

interface Lists {
    fields: Struct[];
    commands: Struct[];
    exchanges: Struct[];
    frames: Struct[];
    ports: string[];
}

const lower = (name: Value) => String(name).toLowerCase();
const keyOf = (table: Record<string, string>, value: Value) => Object.keys(table).find((key) => table[key] === value);
const within = (list: Struct[], { start, len }: Span) => list.slice(start, start + len);

/** The fewest digits that a float is read from again. */
function short(float: number): number {
    for (let digits = 1; digits < 9; digits++) {
        const shorter = Number(float.toPrecision(digits));
        if (Math.fround(shorter) === float) return shorter;
    }
    return float;
}

/** Only what is not as usual. */
function unusual(table: Table, usual: Table): Table {
    return Object.fromEntries(Object.entries(table).filter(([key, value]) => value !== undefined && value !== null && value !== usual[key]));
}

const scaled = ({ scale, offset }: Struct): Table => unusual({ scale: short(scale as number), offset: short(offset as number) }, { scale: 1, offset: 0 });
const nameOf = (place: Value) => NAMES[place as number]!;
const bitOf = ({ var: place, bit }: Struct) => `${nameOf(place)}.${bit}`;
const only = (of: Value): [string, Struct] => (typeof of === "string" ? [of, {}] : (Object.entries(of as Struct)[0] as [string, Struct]));

function inputField(to: Value, commands: Struct[]): Table {
    const [kind, what] = only(to);
    switch (kind) {
        case "Unused":
            return {};
        case "Variable":
            return { to: nameOf(what["var"]), ...scaled(what) };
        case "Bit":
            return { to: bitOf(what) };
        case "Commands": {
            const found: Table = {};
            let idle: Table = {};
            for (const { first, last, text } of within(commands, what["table"] as Span))
                if (text === "") idle = { idle: first };
                else found[first === last ? String(first) : `${first}..${last}`] = text;
            const when = what["when"];
            return { commands: found, ...(when === "Frame" ? { when: "frame" } : when === "Kept" ? { base: "keep" } : {}), ...idle };
        }
    }
    throw new Error(kind);
}

function outputField(from: Value, ports: string[]): Table {
    const [kind, what] = only(from);
    const scale = () => scaled(what);
    switch (kind) {
        case "Constant":
            return { value: what };
        case "Counter":
        case "Reply":
            return { from: lower(kind) };
        case "Variable":
            return { from: nameOf(what["var"]), ...scale() };
        case "Bit":
            return { from: bitOf(what) };
        case "State": {
            const { row, item } = what["value"] as { row: number; item: number };
            const name = row === 255 ? "speed" : STATE[row]!.replace("[]", `[${item + 1}]`).replace("operation_mode", "mode");
            return { from: `controller.${name}`, ...scale() };
        }
        case "Port": {
            const port = what["port"] === null ? "" : `${ports[what["port"] as number]}.`;
            return { from: `port.${port}${keyOf(PORT_VALUES, what["value"])}`, ...scale() };
        }
        case "Link": {
            const name = keyOf(LINKS, what["link"]) ?? ports[only(what["link"])[1] as unknown as number];
            return { from: `link.${name}.up`, ...scale() };
        }
    }
    throw new Error(kind);
}

/** `RobotState[8..13]` of variables in a row. */
function ranges(places: number[]): string[] {
    const found: string[] = [];
    const parsed = (name: string) => /^(\w+)\[(\d+)\]$/.exec(name)!;
    for (let at = 0; at < places.length; ) {
        const [, group, first] = parsed(nameOf(places[at])) as unknown as [string, string, string];
        let end = at;
        while (end + 1 < places.length && nameOf(places[end + 1]) === `${group}[${Number(first) + end + 1 - at}]`) end++;
        found.push(end > at ? `${group}[${first}..${Number(first) + end - at}]` : nameOf(places[at]));
        at = end + 1;
    }
    return found;
}

function fieldsOf(span: Span, lists: Lists): Value[] {
    const specs = within(lists.fields, span).map(only);
    if (specs.every(([kind]) => kind === "System")) return ranges(specs.map(([, place]) => place as unknown as number));
    return specs.map(([kind, spec], nth) => {
        const own = { name: `value${nth + 1}`, type: lower(spec["ty"]) };
        if (kind === "UserInput") return { ...own, ...inputField(spec["to"], lists.commands) };
        if (kind === "UserOutput") return { ...own, ...outputField(spec["from"], lists.ports) };
        throw new Error(kind);
    });
}

function plainRecipe(recipe: Struct, lists: Lists): Table {
    const [kind, parts] = only(recipe["parts"]);
    const isCan = kind === "Can";
    const [sends, rising] = only(recipe["send"]);
    const sending = unusual({ send: sends === "Rising" ? `rising:${bitOf(rising)}` : lower(sends), on_stale: lower(recipe["on_stale"]) }, { send: "period", on_stale: "hold" });
    if ((recipe["exchanges"] as Span).len > 0) throw new Error("exchanges");
    const part = (side: "input" | "output"): Table => {
        const own = parts[side] as Struct | Struct[] | null;
        if (own === null || (Array.isArray(own) && own.length === 0)) return {};
        const before = side === "output" ? sending : {};
        if (!Array.isArray(own) && (own["framing"] !== "Fields" || own["escape"] !== null)) throw new Error("framing");
        if (!Array.isArray(own)) return { [side]: { head: own["head"], tail: own["tail"], ...before, fields: fieldsOf(own["fields"] as Span, lists) } };
        const frame = own.map(({ id, fields }) => {
            const [length, number] = only(id) as unknown as [string, number];
            return { id: number, ...(length === "Extended" ? { extended: true } : {}), fields: fieldsOf(fields as Span, lists) };
        });
        return { [side]: { ...before, frame } };
    };
    return { name: recipe["name"], kind: isCan ? "can" : "stream", mode: lower(recipe["mode"]), ...part("input"), ...part("output") };
}

/** An image with nothing but one recipe. */
function packed(config: Struct, nth: number, lists: Lists): Table {
    const recipes = config["recipes"] as Struct[];
    const start = { fields: Infinity, commands: Infinity, exchanges: Infinity, frames: Infinity };
    const end = { fields: 0, commands: 0, exchanges: 0, frames: 0 };
    const see = (list: keyof typeof start, { start: first, len }: Span) => {
        if (len === 0) return;
        start[list] = Math.min(start[list], first);
        end[list] = Math.max(end[list], first + len);
    };
    const walk = (value: Value, key: string) => {
        if (Array.isArray(value)) for (const one of value) walk(one, key);
        else if (typeof value === "number" && ["request", "reply", "pending", "refusal"].includes(key)) see("frames", { start: value, len: 1 });
        else if (typeof value === "object" && value !== null) {
            if (isSpan(value)) see(key === "table" ? "commands" : key === "exchanges" ? "exchanges" : "fields", value as unknown as Span);
            else for (const [name, one] of Object.entries(value)) walk(one, name);
        }
    };
    const of = (list: keyof typeof start) => lists[list].slice(Number.isFinite(start[list]) ? start[list] : 0, end[list]);
    walk(recipes[nth], "");
    walk(of("exchanges"), "");
    walk(of("frames"), "");
    walk(of("fields"), "");
    const own = Object.fromEntries((["fields", "commands", "exchanges", "frames"] as const).map((list) => [list, of(list)]));
    const back = (list: keyof typeof start) => (Number.isFinite(start[list]) ? -start[list] : 0);
    const by = { fields: back("fields"), commands: back("commands"), exchanges: back("exchanges"), frames: back("frames") };
    const same = (port: number) => port;
    const recipe = moved(recipes[nth], by, same) as Struct;
    const exchanges = (recipe["exchanges"] as Span).len > 0 ? recipe["exchanges"] : { start: 0, len: 0 };
    const controller = { address: "", dialect: "", command_port: 0, state_port: 0, modbus_port: 0, recipe_link: null };
    const alone = { ...(moved(own, by, same) as Struct), controller, network: "Dhcp", recipes: [{ ...recipe, exchanges }], ports: [], safe_values: [] };
    // Numbers of ports mean these.
    const names = /"(port|Listening)":\d/.test(JSON.stringify(alone)) ? { ports: lists.ports } : {};
    return { name: recipe["name"], kind: "image", ...names, image: btoa(String.fromCharCode(...encode(alone))) };
}

const dotted = (address: Value) => (address as number[] | null)?.join(".");

function portOf(port: Struct, recipes: Struct[], safe: Struct[]): Table {
    const [kind, bus] = only(port["bus"]);
    const [alive, frames, age_ms, rejected, ignored] = ["alive", "frames", "age", "rejected", "ignored"].map((key) => (port["health"] as Struct)[key]);
    const health = unusual({ alive, frames, age_ms, rejected, ignored }, {});
    const ms = (us: Value) => (typeof us === "number" ? us / 1000 : undefined);
    const on_timeout: Table = {};
    for (const { var: place, value, mask } of within(safe, port["on_timeout"] as Span)) {
        const [type, number] = only(value) as unknown as [string, number];
        if (mask === 255) on_timeout[nameOf(place)] = type === "Float" ? short(number) : number;
        else on_timeout[`${nameOf(place)}.${Math.log2(mask as number)}`] = number ? 1 : 0;
    }
    const line: Table =
        kind === "Rs485"
            ? { baud: bus["baud"], parity: lower(bus["parity"]), stop_bits: bus["stop_bits"], idle_gap_ms: ms(bus["idle_gap"]), turnaround_us: bus["turnaround"], echo: ECHOES[String(bus["echo"])] }
            : kind === "ModbusTcp"
              ? { to: `${String(bus["host"]).includes(":") ? `[${bus["host"]}]` : bus["host"]}:${bus["port"]}` }
              : bus;
    return {
        name: port["name"],
        bus: { Rs485: "rs485", Can: "can", TcpListen: "tcp-listen", UdpListen: "udp-listen", ModbusTcp: "modbus-tcp" }[kind],
        recipe: recipes[port["recipe"] as number]!["name"],
        ...unusual(
            {
                ...line,
                cycle_ms: ms(port["cycle"]),
                timeout_ms: port["timeout"] === NEVER_US ? "never" : ms(port["timeout"]),
                stale_after_ms: ms(port["stale_after"]),
                safe_at_start: port["safe_at_start"],
                refresh_ms: ms(port["refresh"]),
                absent_ms: ms(port["absent"]),
            },
            { parity: "none", stop_bits: 1, idle_gap_ms: 50, turnaround_us: 100, echo: "auto", cycle_ms: 4, timeout_ms: 100, stale_after_ms: 500, safe_at_start: false, absent_ms: 3000 },
        ),
        ...(Object.keys(health).length > 0 ? { health: Object.fromEntries(Object.entries(health).map(([key, place]) => [key, nameOf(place)])) } : {}),
        ...(Object.keys(on_timeout).length > 0 ? { on_timeout } : {}),
    };
}

function plain(recipe: Struct, lists: Lists): Table | null {
    try {
        return plainRecipe(recipe, lists);
    } catch {
        return null;
    }
}

/** A whole file. Throws if it would make another image. */
export function decompile(image: Uint8Array): string {
    for (const asBytes of [false, true]) {
        const text = textOf(decode(image), asBytes);
        const again = encode(compile(read(text)));
        if (again.every((byte, at) => byte === image[at])) return text;
    }
    throw new Error("this image cannot be shown as a file");
}

function textOf(config: Struct, asBytes: boolean): string {
    const recipes = config["recipes"] as Struct[];
    const ports = config["ports"] as Struct[];
    const lists = { ...(config as unknown as Lists), ports: ports.map((port) => String(port["name"])) };
    const { address, dialect, command_port, state_port, modbus_port, recipe_link } = config["controller"] as Struct;
    const servers = unusual({ command: command_port, state: state_port, modbus: modbus_port }, { command: 2000, state: 2001, modbus: 502 });
    const link = recipe_link as { udp_port: number; recipe: number } | null;
    let text = `[controller]\naddress = ${JSON.stringify(address)}\n`;
    if (dialect !== "v2.3") text += `dialect = ${JSON.stringify(dialect)}\n`;
    if (Object.keys(servers).length > 0) text += `ports = { ${Object.entries(servers).map(([key, port]) => `${key} = ${port}`).join(", ")} }\n`;
    if (link) text += `recipe_link = { udp = ${link.udp_port}, recipe = ${JSON.stringify(recipes[link.recipe]!["name"])} }\n`;
    if (config["network"] !== "Dhcp") {
        const network = only(config["network"])[1];
        const rest = unusual({ router: dotted(network["router"]), dns: dotted(network["dns"]) }, {});
        text += `\n[network]\naddress = "${dotted(network["address"])}/${network["prefix"]}"\n`;
        for (const [key, value] of Object.entries(rest)) text += `${key} = "${value}"\n`;
    }
    for (const [nth, recipe] of recipes.entries()) text = replaced(text, "recipe", nth, (!asBytes && plain(recipe, lists)) || packed(config, nth, lists));
    for (const [nth, port] of ports.entries()) text = replaced(text, "port", nth, portOf(port, recipes, config["safe_values"] as Struct[]));
    return text;
}
