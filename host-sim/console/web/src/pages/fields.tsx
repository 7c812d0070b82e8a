// A part of a recipe in the form: what stands around its fields, its bytes, and its fields.
import { useState } from "preact/hooks";
import { checked } from "../draft";
import { type Piece, SIZES, parsedBytes, pieces, timeOnLine } from "../frame";
import { t } from "../i18n";
import { Sign } from "../parts";
import { type Field, type Table, isTable } from "../toml";
import { SOURCES, ranges, variables } from "../variables";
import { Choice, Text, Typed, changed, numeric } from "./controller";

/** What the form has no field for. */
export function Others({ table, known }: { table: Table; known: string[] }) {
    const others = Object.keys(table).filter((key) => !known.includes(key));
    if (others.length === 0) return null;
    return <p class="note">{t("Also set, and edited as a text: {keys}", { keys: others.join(", ") })}</p>;
}

interface PartProps {
    side: "input" | "output";
    part: Table;
    /** Its place as `check` names it. */
    place: string;
    isRealtime: boolean;
    isCan: boolean;
    port: Table | undefined;
    set: (newer: Table | null) => void;
}

export function Part({ side, part, place, isRealtime, isCan, port, set }: PartProps) {
    const fields = (part["fields"] as Field[] | undefined) ?? [];
    const [selected, setSelected] = useState<number | null>(null);
    const setFields = (newer: Field[]) => set({ ...part, fields: newer });
    const add = () => {
        const names = new Set(fields.map((field) => (typeof field === "string" ? field : field["name"])));
        let n = fields.length + 1;
        while (names.has(`value${n}`)) n++;
        const all = variables(side === "input");
        const newer: Field = isRealtime
            ? (all.find(({ name }) => !names.has(name))?.name ?? "")
            : { name: `value${n}`, type: "byte", ...(side === "output" ? { value: 0 } : {}) };
        setFields([...fields, newer]);
    };
    const bytes = (key: "head" | "tail", written: string) => {
        const parsed = parsedBytes(written);
        if (parsed) set(changed(part, key, parsed.length > 0 ? parsed : ""));
    };
    const shownBytes = (key: "head" | "tail") =>
        Array.isArray(part[key]) ? (part[key] as number[]).map((byte) => byte.toString(16).toUpperCase().padStart(2, "0")).join(" ") : "";
    const mistake = checked.value && !checked.value.ok ? checked.value : null;
    const at = mistake?.key?.startsWith(`${place}.`) ? mistake : null;
    return (
        <div class="frame">
            <div class="form">
                {isCan ? (
                    <Text
                        label={t("Identifier")}
                        value={part["id"] === undefined ? "" : `0x${Number(part["id"]).toString(16).toUpperCase()}`}
                        set={(value) => set(changed(changed(part, "id", numeric(value)), "extended", Number(value) > 0x7ff || ""))}
                    />
                ) : (
                    <>
                        <Text label={t("Head (hexadecimal bytes)")} value={shownBytes("head")} set={(value) => bytes("head", value)} />
                        <Text label={t("Tail (hexadecimal bytes)")} value={shownBytes("tail")} set={(value) => bytes("tail", value)} />
                    </>
                )}
            </div>
            <Others table={part} known={["id", "extended", "head", "tail", "fields", "send", "on_stale"]} />
            <Drawn part={part} port={port} isCan={isCan} selected={selected} select={setSelected} />
            <ol class="fields">
                {fields.map((field, nth) => (
                    <FieldRow
                        key={nth}
                        field={field}
                        side={side}
                        isRealtime={isRealtime}
                        isSelected={selected === nth}
                        select={() => setSelected(nth)}
                        mistake={at?.key?.includes(`.fields[${nth + 1}]`) ? (at.error ?? "") : ""}
                        set={(newer) => {
                            const all = [...fields];
                            if (newer === null) all.splice(nth, 1);
                            else all[nth] = newer;
                            setFields(all);
                        }}
                        move={(by) => {
                            const to = nth + by;
                            if (to < 0 || to >= fields.length) return;
                            const all = [...fields];
                            all.splice(to, 0, all.splice(nth, 1)[0]!);
                            setFields(all);
                            setSelected(to);
                        }}
                    />
                ))}
            </ol>
            {at && !at.key?.includes(".fields[") && (
                <p class="wrong" role="alert">
                    {at.error}
                </p>
            )}
            <div class="tools">
                <button onClick={add}>{t("Add a field")}</button>
                <button class="danger" onClick={() => set(null)}>
                    {isCan ? t("Remove this frame") : side === "input" ? t("Remove the input") : t("Remove the output")}
                </button>
            </div>
        </div>
    );
}

/** The frame, byte by byte. */
function Drawn({ part, port, isCan, selected, select }: { part: Table; port: Table | undefined; isCan: boolean; selected: number | null; select: (nth: number) => void }) {
    const drawn = pieces(part);
    if (!drawn) return <p class="note">{t("The bytes of this frame are drawn by “host-sim check”.")}</p>;
    const count = drawn.reduce((sum, piece) => sum + piece.bytes, 0);
    const time = port && !isCan ? timeOnLine(count, port) : null;
    return (
        <figure class="drawn">
            <div class="bytes" role="group" aria-label={drawn.map((piece) => `${piece.label} ${piece.bytes}`).join(", ")}>
                {drawn.map((piece, at) => (
                    <Bytes key={at} piece={piece} isSelected={piece.field !== undefined && piece.field === selected} select={select} />
                ))}
            </div>
            <figcaption>
                {t("{count} bytes", { count })}
                {time !== null && ` · ${t("{time} ms on the line", { time: time.toFixed(2) })}`}
                {isCan && count > 8 && <Sign tone="bad">{t("A CAN frame has at most 8 bytes.")}</Sign>}
            </figcaption>
        </figure>
    );
}

function Bytes({ piece, isSelected, select }: { piece: Piece; isSelected: boolean; select: (nth: number) => void }) {
    return (
        <button
            type="button"
            class={`piece ${piece.kind}`}
            aria-pressed={isSelected}
            onClick={() => piece.field !== undefined && select(piece.field)}
            style={{ flexGrow: String(piece.bytes) }}
            title={`${piece.label}: ${piece.bytes}`}
        >
            <span>{piece.label}</span>
            <code>{piece.hex ?? "·· ".repeat(Math.min(piece.bytes, 8)).trim() + (piece.bytes > 8 ? " …" : "")}</code>
        </button>
    );
}

interface FieldProps {
    field: Field;
    side: "input" | "output";
    isRealtime: boolean;
    isSelected: boolean;
    select: () => void;
    mistake: string;
    set: (newer: Field | null) => void;
    move: (by: number) => void;
}

function FieldRow({ field, side, isRealtime, isSelected, select, mistake, set, move }: FieldProps) {
    const known = variables(side === "input");
    const [filter, setFilter] = useState("");
    const id = `known-${side}-${isRealtime ? "r" : "u"}`;
    const offered = isRealtime ? [...ranges(side === "input"), ...known] : side === "input" ? known : [...known, ...SOURCES, ...variables(true)];
    const key = side === "input" ? "to" : "from";
    const target = typeof field === "string" ? field : String(field[key] ?? "");
    const about = offered.find(({ name }) => name === (filter || target))?.about;
    const types = Object.keys(SIZES);
    return (
        <li class={`${isSelected ? "selected" : ""} ${mistake ? "mistaken" : ""}`} onFocusIn={select}>
            <datalist id={id}>
                {offered.map(({ name, about }) => (
                    <option key={name} value={name}>
                        {about}
                    </option>
                ))}
            </datalist>
            <div class="form">
                {typeof field !== "string" && (
                    <>
                        <Text label={t("Name")} value={field["name"]} set={(value) => set(changed(field, "name", value))} />
                        <Choice label={t("Type")} value={field["type"]} options={types} set={(value) => set(changed(field, "type", value))} />
                    </>
                )}
                {typeof field !== "string" && isTable(field["commands"]) ? <Commands field={field} set={set} /> : null}
                <label class="wide">
                    {side === "input" ? t("To the variable") : t("From")}
                    <Typed
                        list={id}
                        value={target}
                        typing={setFilter}
                        set={(text) => {
                            const value = text.trim();
                            if (typeof field === "string") set(value);
                            else set(changed(value ? changed(field, "value", undefined) : field, key, value));
                        }}
                    />
                    {about && <small>{about}</small>}
                </label>
                {typeof field !== "string" && side === "output" && (
                    <Text short label={t("or the constant")} value={field["value"]} set={(value) => set(changed(value ? changed(field, "from", undefined) : field, "value", numeric(value)))} />
                )}
                {typeof field !== "string" && target && (
                    <>
                        <Text short label={t("times")} value={field["scale"]} placeholder="1" set={(value) => set(changed(field, "scale", numeric(value)))} />
                        <Text short label={t("plus")} value={field["offset"]} placeholder="0" set={(value) => set(changed(field, "offset", numeric(value)))} />
                    </>
                )}
                <div class="tools">
                    <button aria-label={t("Up")} onClick={() => move(-1)}>
                        ↑
                    </button>
                    <button aria-label={t("Down")} onClick={() => move(1)}>
                        ↓
                    </button>
                    <button class="danger" aria-label={t("Remove the field")} onClick={() => set(null)}>
                        ✕
                    </button>
                </div>
            </div>
            {typeof field !== "string" && <Others table={field} known={FIELD_KEYS} />}
            {typeof field !== "string" && side === "input" && !target && !isTable(field["commands"]) && (
                <button class="quiet" onClick={() => set({ ...field, commands: { 1: "stop" } })}>
                    {t("It picks commands …")}
                </button>
            )}
            {mistake && (
                <p class="wrong" role="alert">
                    {mistake}
                </p>
            )}
        </li>
    );
}

const FIELD_KEYS = ["name", "type", "to", "from", "value", "scale", "offset", "commands", "when"];

/** Values and the commands that they pick, one a line. */
function Commands({ field, set }: { field: Table; set: (newer: Table) => void }) {
    const table = field["commands"] as Table;
    const shown = Object.entries(table).map(([value, command]) => `${value} = ${String(command)}`).join("\n");
    return (
        <>
            <label class="wide">
                {t("Value = command, one a line")}
                <textarea
                    rows={Math.max(2, Object.keys(table).length)}
                    spellcheck={false}
                    value={shown}
                    onChange={(event) => {
                        const lines = event.currentTarget.value.split("\n").map((line) => /^\s*([^=\s]+)\s*=\s*(.*?)\s*$/.exec(line)).filter((line) => line !== null);
                        set(changed(field, "commands", lines.length > 0 ? Object.fromEntries(lines.map(([, value, command]) => [value, command])) : ""));
                    }}
                />
            </label>
            <Choice
                label={t("Acts")}
                value={String(field["when"] ?? "change")}
                options={["change", "frame"]}
                words={{ change: t("when it changes"), frame: t("with every frame") }}
                set={(value) => set(changed(field, "when", value === "change" ? "" : value))}
            />
        </>
    );
}
