// A configuration file as text, and its recipes and ports as objects that can be edited.
//
// The text is what counts. An edit replaces the lines of one `[[recipe]]` or `[[port]]` and leaves all others as
// they are, with their comments; what was replaced is read again and compared with what was meant.
import { parse } from "smol-toml";

export type Table = { [key: string]: unknown };

/** A field of a recipe: the name of a variable of the robot, or a table. */
export type Field = string | Table;

export interface File {
    recipe?: Table[];
    port?: Table[];
    controller?: Table;
    network?: Table;
    [key: string]: unknown;
}

/** Reads a text. Throws what is wrong with it. */
export function read(text: string): File {
    return parse(text) as File;
}

/** What a file is edited by: lists of tables, and tables that are there once. */
export type Kind = "recipe" | "port" | "controller" | "network";
const isList = (kind: Kind) => kind === "recipe" || kind === "port";

/** The first and last line of the nth `[[kind]]`, with its sub-tables, from 0; or of `[kind]`. */
export function linesOf(text: string, kind: Kind, nth: number): [number, number] | null {
    const lines = text.split("\n");
    let seen = -1;
    let first = -1;
    let last = lines.length - 1;
    for (let at = 0; at < lines.length; at++) {
        const header = /^\s*\[+\s*([A-Za-z0-9_-]+)(.*)$/.exec(lines[at]!);
        if (!header) continue;
        const begins = new RegExp(isList(kind) ? `^\\s*\\[\\[\\s*${kind}\\s*\\]\\]` : `^\\s*\\[\\s*${kind}\\s*\\]`).test(lines[at]!);
        if (begins) seen++;
        if (first < 0) {
            if (begins && seen === nth) first = at;
        } else if (begins || header[1] !== kind) {
            last = at - 1;
            break;
        }
    }
    if (first < 0) return null;
    // Blank lines and comments in front of the next table are about that one.
    while (last > first && /^\s*(#.*)?$/.test(lines[last]!)) last--;
    return [first, last];
}

/** The text with the nth table of a kind replaced, removed (`null`), or one more at the end (`nth` = the number there is). */
export function replaced(text: string, kind: Kind, nth: number, table: Table | null): string {
    const lines = text.replace(/\s*$/, "").split("\n");
    const place = linesOf(text, kind, nth);
    const before = place ? lines.slice(place[0], place[1] + 1).join("\n") : "";
    let written = table ? writtenTable(kind, table, before, isList(kind)).split("\n") : [];
    if (place) {
        const [first, last] = place;
        if (table) written = kept(before.split("\n"), written);
        lines.splice(first, last - first + 1, ...written);
        if (!table && first > 0 && lines[first - 1]?.trim() === "") lines.splice(first - 1, 1);
    } else {
        // Recipes stand before ports, as in all examples.
        const first = (kind: Kind) => linesOf(text, kind, 0)?.[0] ?? Infinity;
        const behind = { controller: Math.min(first("network"), first("recipe"), first("port")), network: Math.min(first("recipe"), first("port")), recipe: first("port"), port: Infinity };
        let at = Math.min(behind[kind], lines.length);
        // Comments right above a table are about that one.
        while (at < lines.length && at > 0 && lines[at - 1]!.startsWith("#")) at--;
        const blank = at > 0 && lines[at - 1]?.trim() !== "" ? [""] : [];
        lines.splice(at, 0, ...blank, ...written, ...(at < lines.length ? [""] : []));
    }
    const newer = lines.join("\n").replace(/^\n+/, "") + "\n";
    const wanted = read(text);
    if (isList(kind)) {
        const list = [...((wanted[kind] as Table[] | undefined) ?? [])];
        if (table) list[nth] = table;
        else list.splice(nth, 1);
        if (list.length > 0) wanted[kind] = list;
        else delete wanted[kind];
    } else if (table) wanted[kind] = table;
    else delete wanted[kind];
    if (!same(read(newer), wanted)) throw new Error("this text can only be edited as a text");
    return newer;
}

/** Whether two values are the same, whatever the order of keys. */
export function same(a: unknown, b: unknown): boolean {
    if (Array.isArray(a) && Array.isArray(b)) return a.length === b.length && a.every((item, at) => same(item, b[at]));
    if (isTable(a) && isTable(b)) {
        const keys = Object.keys(a);
        return keys.length === Object.keys(b).length && keys.every((key) => key in b && same(a[key], b[key]));
    }
    return a === b || String(a) === String(b);
}

export function isTable(value: unknown): value is Table {
    return typeof value === "object" && value !== null && !Array.isArray(value) && !(value instanceof Date);
}

const bare = (key: string) => (/^[A-Za-z0-9_-]+$/.test(key) ? key : quoted(key));

function quoted(text: string): string {
    return JSON.stringify(text).replaceAll("\u007f", "\\u007f");
}

function value(of: unknown, key: string): string {
    if (typeof of === "string") return quoted(of);
    if (typeof of === "number") return Number.isInteger(of) ? idLike(key, of) : String(of);
    if (Array.isArray(of)) return `[${of.map((item) => value(item, key)).join(", ")}]`;
    if (isTable(of)) {
        const items = Object.entries(of).map(([key, item]) => `${bare(key)} = ${value(item, key)}`);
        return items.length > 0 ? `{ ${items.join(", ")} }` : "{}";
    }
    return String(of);
}

/** Ids, heads and tails are read as hexadecimal numbers. */
function idLike(key: string, number: number): string {
    const hexadecimal = key === "id" || key === "head" || key === "tail" || key === "equals";
    return hexadecimal && number >= 0 ? `0x${number.toString(16).toUpperCase().padStart(2, "0")}` : String(number);
}

/** A table as a text; tables in it have a header if they had one `before`, or else if they are long. */
function writtenTable(path: string, table: Table, before: string, isList = true): string {
    const own: string[] = [];
    const below: string[] = [];
    own.push(isList ? `[[${path}]]` : `[${path}]`);
    for (const [key, item] of Object.entries(table)) {
        const name = `${path}.${bare(key)}`;
        const isLists = Array.isArray(item) && item.length > 0 && item.every(isTable) && key !== "fields";
        const isInline = new RegExp(`^\\s*${key}\\s*=`, "m").test(before);
        const isLong = key === "input" || key === "output" || (isTable(item) && Object.keys(item).length > 2);
        if (isTable(item) && (before.includes(`[${name}]`) || (isLong && !isInline))) below.push(writtenTable(name, item, before, false));
        else if (isLists && !isInline) for (const one of item) below.push(writtenTable(name, one as Table, before));
        else if (key === "fields" && Array.isArray(item) && item.some(isTable))
            own.push(`fields = [\n${item.map((one) => `    ${value(one, "")},`).join("\n")}\n]`);
        else own.push(`${bare(key)} = ${value(item, key)}`);
    }
    // A table that only has tables in it needs no header.
    if (!isList && own.length === 1 && below.length > 0) own.pop();
    return [...own, ...below].join("\n");
}

/** The newer lines, but those that say the same as older ones as those have it, with their comments. */
function kept(older: string[], newer: string[]): string[] {
    const old = statements(older);
    let from = 0;
    return statements(newer).flatMap((statement) => {
        const wanted = meaning(statement);
        const at = old.findIndex((one, place) => place >= from && meaning(one) === wanted);
        if (at >= 0) {
            from = at + 1;
            return old[at]!;
        }
        if (statement.length === 1) return statement;
        // A list of which some items have changed: the others stay as they are.
        const key = statement[0];
        const list = old.findIndex((one, place) => place >= from && one.length > 1 && one.some((line) => line.trim() === key));
        if (list < 0) return statement;
        from = list + 1;
        return items(old[list]!, statement);
    });
}

function items(older: string[], newer: string[]): string[] {
    const meanings = older.map((line) => meaning([line]));
    let from = 0;
    return newer.flatMap((line) => {
        const wanted = meaning([line]);
        const at = meanings.findIndex((one, place) => place >= from && one === wanted);
        if (at < 0) return [line];
        let first = at;
        while (first > from && /^\s*(#.*)?$/.test(older[first - 1]!)) first--;
        from = at + 1;
        return older.slice(first, at + 1);
    });
}

/** The lines of each header, and of each key with its value; with the comments in front of them. */
function statements(lines: string[]): string[][] {
    const found: string[][] = [];
    let one: string[] = [];
    for (const line of lines) {
        one.push(line);
        if (/^\s*(#.*)?$/.test(line) || meaning(one) === null) continue;
        found.push(one);
        one = [];
    }
    return one.length > 0 ? [...found, one] : found;
}

/** What a statement or an item of a list says, however it is written; `null` if it is not whole. */
function meaning(lines: string[]): string | null {
    const text = lines.join("\n");
    for (const whole of [text, `item = [${text}\n]`]) {
        try {
            return JSON.stringify(parse(whole), (_, item: unknown) => (typeof item === "bigint" ? String(item) : item));
        } catch {
            // Not so then.
        }
    }
    return null;
}
