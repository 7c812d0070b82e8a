// The bytes of a recipe's frame, for drawing: what the controller's own recipes are made of. Frames of devices with
// more in them are drawn by `host-sim check`.
import { type Field, type Table, isTable } from "./toml";

/** A run of bytes with one meaning. */
export interface Piece {
    label: string;
    kind: "head" | "field" | "tail";
    bytes: number;
    /** Which field it is of. */
    field?: number;
    hex?: string;
}

export const SIZES: Record<string, number> = {
    byte: 1,
    char: 1,
    word: 2,
    short: 2,
    dword: 4,
    int: 4,
    float: 4,
    double: 8,
};

/** The groups of the robot's variables and the size of one of each. */
const GROUPS: Record<string, number> = {
    DigitalOutputCommand: 1,
    BitInputReg: 1,
    WordInputReg: 2,
    FloatInputReg: 4,
    ForceEnd: 4,
    ForceBase: 4,
    DigitalSignalStatus: 1,
    RobotState: 4,
    BitOutputReg: 1,
    WordOutputReg: 2,
    FloatOutputReg: 4,
};

/** The bytes of a field; `null` if they are not known here. */
export function sizeOf(field: Field): number | null {
    if (typeof field === "string") {
        const match = /^(\w+)\[(\d+)(?:\.\.(\d+))?\]$/.exec(field);
        const size = match && GROUPS[match[1]!];
        if (!match || !size) return null;
        const first = Number(match[2]);
        const last = Number(match[3] ?? match[2]);
        return last >= first ? (last - first + 1) * size : null;
    }
    const type = field["type"];
    return typeof type === "string" && !("bits" in field) ? (SIZES[type] ?? null) : null;
}

const hex = (byte: unknown) =>
    typeof byte === "number" ? byte.toString(16).toUpperCase().padStart(2, "0") : "??";

/** The pieces of a part of a stream recipe, or of one CAN frame; `null` if there is something in it that is not known here. */
export function pieces(part: Table): Piece[] | null {
    const found: Piece[] = [];
    const marks = (key: "head" | "tail") => {
        const bytes = part[key];
        if (bytes === undefined) return true;
        const list = Array.isArray(bytes) ? bytes : [bytes];
        found.push({ label: key, kind: key, bytes: list.length, hex: list.map(hex).join(" ") });
        return true;
    };
    for (const key of ["checksum", "escape", "framing", "length", "delimiter", "until"]) if (key in part) return null;
    marks("head");
    const fields = Array.isArray(part["fields"]) ? (part["fields"] as Field[]) : [];
    for (const [at, field] of fields.entries()) {
        const bytes = sizeOf(field);
        if (bytes === null) return null;
        const label = typeof field === "string" ? field : String(field["name"] ?? "?");
        found.push({ label, kind: "field", bytes, field: at });
    }
    marks("tail");
    return found;
}

/** Milliseconds on an RS-485 line. */
export function timeOnLine(bytes: number, port: Table): number {
    const baud = Number(port["baud"] ?? 115200);
    const parity = String(port["parity"] ?? "none") === "none" ? 0 : 1;
    const bits = 1 + Number(port["data_bits"] ?? 8) + parity + Number(port["stop_bits"] ?? 1);
    return (bytes * bits * 1000) / baud;
}

/** Bytes of `48 AA`, `0x48, 0xAA` or `72 170`; `null` if it is none of these. */
export function parsedBytes(text: string): number[] | null {
    const words = text.trim().split(/[\s,]+/).filter(Boolean);
    const isHex = words.every((word) => /^(0x)?[0-9a-f]{1,2}$/i.test(word)) && !words.some((word) => /^\d{3}$/.test(word));
    const bytes = words.map((word) => (isHex ? parseInt(word.replace(/^0x/i, ""), 16) : Number(word)));
    return bytes.every((byte) => Number.isInteger(byte) && byte >= 0 && byte <= 255) ? bytes : null;
}

export { isTable };
