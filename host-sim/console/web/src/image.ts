// The configuration image of a board: docs/configuration.md section 6. The types in it are those of proto-core's
// golden files (types.mjs), so this writes what `host-sim image` writes, byte for byte; tests compare the two.
import { TYPES, VERSION } from "image-types";

export type Type = string | null | { s: [string, Type][] } | { e: [string, Type][] } | { o: Type } | { q: Type } | { a: [number, Type] };

/** A struct: its fields. An enum: the variant's name, or `{ name: content }`. An option: `null` or the content. */
export type Value = unknown;
export type Struct = Record<string, Value>;

const MAGIC = 0x49434752;
const HEADER = 16;
export const MAX_IMAGE = 16 * 1024;
const WIDE = /^[UI](16|32|64)$/;

const table = Uint32Array.from({ length: 256 }, (_, byte) => {
    let crc = byte;
    for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
    return crc;
});

/** CRC-32 as in zip and Ethernet. */
export function crc32(bytes: Uint8Array): number {
    return ~bytes.reduce((crc, byte) => table[(crc ^ byte) & 255]! ^ (crc >>> 8), ~0) >>> 0;
}

class Writer {
    readonly bytes: number[] = [];
    varint(value: number) {
        // Larger numbers than shifts can take: "never" has 52 bits.
        for (; value > 127; value = Math.floor(value / 128)) this.bytes.push((value % 128) | 128);
        this.bytes.push(value);
    }
    put(type: Type, value: Value) {
        if (type === null) return;
        if (typeof type === "string") this.named(type, value);
        else if ("s" in type) for (const [name, of] of type.s) this.put(of, (value as Struct)[name]);
        else if ("e" in type) {
            const [name, content] = typeof value === "string" ? [value, null] : Object.entries(value as Struct)[0]!;
            const variant = type.e.findIndex(([own]) => own === name);
            if (variant < 0) throw new Error(`no variant ${name}`);
            this.varint(variant);
            this.put(type.e[variant]![1], content);
        } else if ("o" in type) {
            this.bytes.push(value === null ? 0 : 1);
            if (value !== null) this.put(type.o, value);
        } else if ("q" in type) {
            this.varint((value as Value[]).length);
            for (const one of value as Value[]) this.put(type.q, one);
        } else for (const one of value as Value[]) this.put(type.a[1], one);
    }
    private named(type: string, value: Value) {
        const known = TYPES[type];
        if (known !== undefined) this.put(known, value);
        else if (type === "Str") {
            const text = new TextEncoder().encode(value as string);
            this.varint(text.length);
            this.bytes.push(...text);
        } else if (type === "F32" || type === "F64") {
            const view = new DataView(new ArrayBuffer(8));
            if (type === "F32") view.setFloat32(0, value as number, true);
            else view.setFloat64(0, value as number, true);
            this.bytes.push(...new Uint8Array(view.buffer, 0, type === "F32" ? 4 : 8));
        } else if (WIDE.test(type)) {
            const number = value as number;
            if (!Number.isSafeInteger(number)) throw new Error(`${number} is too large`);
            this.varint(type[0] === "U" ? number : number < 0 ? -2 * number - 1 : 2 * number);
        } else this.bytes.push(Number(value) & 255);
    }
}

class Reader {
    at = 0;
    constructor(readonly bytes: Uint8Array) {}
    byte(): number {
        const byte = this.bytes[this.at++];
        if (byte === undefined) throw new Error("it ends early");
        return byte;
    }
    varint(): number {
        let value = 0;
        for (let factor = 1; ; factor *= 128) {
            const byte = this.byte();
            value += (byte & 127) * factor;
            if (!Number.isSafeInteger(value)) throw new Error("a number is too large");
            if (byte < 128) return value;
        }
    }
    take(type: Type): Value {
        if (type === null) return null;
        if (typeof type === "string") return this.named(type);
        if ("s" in type) return Object.fromEntries(type.s.map(([name, of]) => [name, this.take(of)]));
        if ("e" in type) {
            const variant = type.e[this.varint()];
            if (!variant) throw new Error("unknown variant");
            const [name, of] = variant;
            return of === null ? name : { [name]: this.take(of) };
        }
        if ("o" in type) return this.byte() ? this.take(type.o) : null;
        const [length, of] = "q" in type ? [this.varint(), type.q] : type.a;
        // Each item has a byte at least, but for nothing.
        if (length > this.bytes.length) throw new Error("it ends early");
        return Array.from({ length }, () => this.take(of));
    }
    private named(type: string): Value {
        const known = TYPES[type];
        if (known !== undefined) return this.take(known);
        if (type === "Str" || type === "F32" || type === "F64") {
            const bytes = Uint8Array.from({ length: type === "Str" ? this.varint() : type === "F32" ? 4 : 8 }, () => this.byte());
            if (type === "Str") return new TextDecoder().decode(bytes);
            const view = new DataView(bytes.buffer);
            return type === "F32" ? view.getFloat32(0, true) : view.getFloat64(0, true);
        }
        if (WIDE.test(type)) {
            const number = this.varint();
            return type[0] === "U" ? number : number % 2 ? -(number + 1) / 2 : number / 2;
        }
        const byte = this.byte();
        return type === "Bool" ? byte !== 0 : type === "I8" ? (byte << 24) >> 24 : byte;
    }
}

/** Writes the image of a configuration. */
export function encode(config: Struct): Uint8Array<ArrayBuffer> {
    const writer = new Writer();
    writer.put("GatewayConfig", config);
    const image = new Uint8Array(HEADER + writer.bytes.length);
    if (image.length > MAX_IMAGE) throw new Error(`the image has ${image.length} bytes; allowed: ${MAX_IMAGE}`);
    const head = new DataView(image.buffer);
    head.setUint32(0, MAGIC, true);
    head.setUint32(4, VERSION, true);
    head.setUint32(8, writer.bytes.length, true);
    image.set(writer.bytes, HEADER);
    head.setUint32(12, crcOf(image), true);
    return image;
}

/** Over version, length and content. */
function crcOf(image: Uint8Array): number {
    return crc32(Uint8Array.from([...image.subarray(4, 12), ...image.subarray(HEADER)]));
}

/** What the head of an image says; throws what is wrong with it. */
export function headOf(bytes: Uint8Array): { version: number; length: number; crc: number } {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    if (bytes.length < HEADER || view.getUint32(0, true) !== MAGIC) throw new Error("this is no configuration image: it does not begin with RGCI");
    const [version, payload, crc] = [4, 8, 12].map((at) => view.getUint32(at, true)) as [number, number, number];
    const length = HEADER + payload;
    if (length > MAX_IMAGE || length > bytes.length) throw new Error(`the image is cut: ${bytes.length} bytes of ${length}`);
    if (crcOf(bytes.subarray(0, length)) !== crc) throw new Error("the image is damaged");
    return { version, length, crc };
}

/** Reads an image. Throws what is wrong with it, or that its version is another one than this page's. */
export function decode(bytes: Uint8Array): Struct {
    const { version, length } = headOf(bytes);
    if (version !== VERSION) throw new Error(`the image has version ${version}, this page knows version ${VERSION}`);
    const reader = new Reader(bytes.subarray(HEADER, length));
    const config = reader.take("GatewayConfig") as Struct;
    if (reader.at !== length - HEADER) throw new Error("there is more in the image than this page knows");
    return config;
}
