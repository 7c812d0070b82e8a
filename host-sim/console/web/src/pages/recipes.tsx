// The recipe manager: ports, recipes, fields; the frame as it is edited.
import { useState } from "preact/hooks";
import { base, checked, draft, edit, file, imported, text } from "../draft";
import { pieces, timeOnLine } from "../frame";
import { t } from "../i18n";
import { Card, Dialog, Sign, choose, said, save } from "../parts";
import { isBoard } from "../state";
import { templateOf, withTemplate } from "../template";
import { type Field, type Table, isTable, linesOf, replaced } from "../toml";
import { ranges } from "../variables";
import { Mistake, Unshown } from "./configurations";
import { Choice, Controller, Text, changed, chosen, list, named, numeric, put, wrong } from "./controller";
import { Others, Part } from "./fields";

export function Recipes() {
    // What is typed now would be based on nothing.
    if (!base.value && draft.value === null) return <p class="empty">{t("Waiting for the gateway …")}</p>;
    if (imported.value || (draft.value === null && base.value?.wrong))
        return (
            <Card title={t("Recipes")}>
                <Unshown />
            </Card>
        );
    if (file.value.error !== undefined)
        return (
            <Card title={t("Recipes")}>
                <p class="wrong" role="alert">
                    {t("The file cannot be read: {error}", { error: file.value.error })}
                </p>
                <a href="#configurations">{t("Edit it as a text")}</a>
            </Card>
        );
    const { kind, nth } = chosen.value;
    const table = kind === "controller" ? undefined : list(kind)[nth];
    const mistake = checked.value && !checked.value.ok ? checked.value : null;
    return (
        <div class="manager">
            <nav class="side" aria-label={t("Ports and recipes")}>
                <section>
                    <h2>{t("Robot")}</h2>
                    <button class="entry" aria-current={kind === "controller"} onClick={() => (chosen.value = { kind: "controller", nth: 0 })}>
                        {t("Controller")}
                        <small>{String(file.value.file?.controller?.["address"] ?? "–")}</small>
                    </button>
                </section>
                <List kind="port" title={t("Ports")} />
                <List kind="recipe" title={t("Recipes")} />
                <Imported />
            </nav>
            <div class="editor">
                {wrong.value && (
                    <p class="wrong" role="alert">
                        {wrong.value}
                    </p>
                )}
                <Mistake mistake={mistake} />
                {draft.value !== null && checked.value?.ok && (
                    <p>
                        <Sign tone="good">{isBoard.value ? t("No mistake was found here. The board looks at the whole when it is applied.") : t("This file can run.")}</Sign>
                    </p>
                )}
                {checked.value?.ok &&
                    checked.value.warnings?.map((warning) => (
                        <p key={warning}>
                            <Sign tone="warn">{warning}</Sign>
                        </p>
                    ))}
                {kind === "controller" ? (
                    <Controller />
                ) : !table ? (
                    <p class="empty">{t("Choose a port or a recipe, or add one.")}</p>
                ) : kind === "port" ? (
                    <Port key={`p${nth}`} nth={nth} port={table} />
                ) : (
                    <Recipe key={`r${nth}`} nth={nth} recipe={table} />
                )}
            </div>
        </div>
    );
}

function List({ kind, title }: { kind: "recipe" | "port"; title: string }) {
    const add = () => {
        const names = new Set(list(kind).map(named));
        const free = (stem: string) => {
            for (let n = 1; ; n++) if (!names.has(`${stem}-${n}`)) return `${stem}-${n}`;
        };
        const newer: Table =
            kind === "recipe"
                ? {
                      name: free("recipe"),
                      kind: "stream",
                      mode: "user",
                      input: { head: [255, 255], tail: [238, 238], fields: [{ name: "value1", type: "byte" }] },
                  }
                : { name: free("rs485"), bus: "rs485", recipe: named(list("recipe")[0]) };
        const nth = list(kind).length;
        put(kind, nth, newer);
        chosen.value = { kind, nth };
    };
    return (
        <section>
            <h2>{title}</h2>
            <ul>
                {list(kind).map((table, nth) => (
                    <li key={nth}>
                        <button
                            class="entry"
                            aria-current={chosen.value.kind === kind && chosen.value.nth === nth}
                            onClick={() => (chosen.value = { kind, nth })}
                        >
                            {named(table)}
                            <small>
                                {kind === "port"
                                    ? `${String(table["bus"])} · ${String(table["recipe"] ?? "–")}`
                                    : `${String(table["kind"])} · ${String(table["mode"] ?? "")}`}
                            </small>
                        </button>
                    </li>
                ))}
            </ul>
            <button onClick={add}>{kind === "recipe" ? t("Add a recipe") : t("Add a port")}</button>
        </section>
    );
}

/** Recipes and ports of another file. */
function Imported() {
    const [pasted, setPasted] = useState<string | null>(null);
    const [problem, setProblem] = useState("");
    const take = () => {
        try {
            const newer = withTemplate(text.value, pasted ?? "");
            if (newer === text.value) throw new Error(t("There is no recipe or port in it that is not here already."));
            edit(newer);
            chosen.value = { kind: "recipe", nth: list("recipe").length - 1 };
            setPasted(null);
            setProblem("");
        } catch (error) {
            setProblem(said(error).split("\n")[0]!);
        }
    };
    return (
        <section>
            <button onClick={() => setPasted("")}>{t("Import a device …")}</button>
            {pasted !== null && (
                <Dialog title={t("Import a device")} close={() => setPasted(null)}>
                    <p>{t("Paste recipes and ports, or choose a file: as they were exported here, or as “host-sim new --device” writes them.")}</p>
                    <textarea class="toml" rows={14} value={pasted} onInput={(event) => setPasted(event.currentTarget.value)} />
                    {problem && (
                        <p class="wrong" role="alert">
                            {problem}
                        </p>
                    )}
                    <footer>
                        <button class="main" onClick={take}>
                            {t("Import")}
                        </button>
                        <button onClick={() => choose(".toml,text/plain", (bytes) => setPasted(new TextDecoder().decode(bytes)))}>{t("Choose a file …")}</button>
                    </footer>
                </Dialog>
            )}
        </section>
    );
}

/** Keys that belong to one kind of line. */
const LINE_KEYS = ["bus", "baud", "parity", "stop_bits", "idle_gap_ms", "turnaround_us", "echo", "bitrate", "listen", "to"];
const PORT_KEYS = ["name", "bus", "recipe", "baud", "parity", "stop_bits", "bitrate", "listen", "cycle_ms", "timeout_ms", "on_timeout"];

function Port({ nth, port }: { nth: number; port: Table }) {
    const set = (key: string, value: unknown) => put("port", nth, changed(port, key, value));
    const recipe = list("recipe").find((recipe) => recipe["name"] === port["recipe"]);
    const bus = String(port["bus"]);
    const isSerial = bus !== "modbus-tcp" && (bus.startsWith("rs485") || bus.startsWith("modbus"));
    const isField = !String(bus).endsWith("listen");
    const setBus = (value: string) => {
        const kept = Object.fromEntries(Object.entries(port).filter(([key]) => !LINE_KEYS.includes(key)));
        put("port", nth, { ...kept, bus: value, ...(value.endsWith("listen") ? { listen: "0.0.0.0:50000" } : {}) });
    };
    const exported = () => {
        try {
            save(`${named(port)}.toml`, templateOf(text.value, nth));
        } catch (error) {
            wrong.value = said(error);
        }
    };
    const written = inputsOf(recipe);
    const safe = isTable(port["on_timeout"]) ? port["on_timeout"] : {};
    return (
        <Card
            title={t("Port {name}", { name: named(port) })}
            aside={
                <div class="tools">
                    <button onClick={exported}>{t("Export as a template")}</button>
                    <button class="danger" onClick={() => put("port", nth, null)}>
                        {t("Remove")}
                    </button>
                </div>
            }
        >
            <div class="form">
                <Text label={t("Name")} value={port["name"]} set={(value) => set("name", value)} />
                <Choice label={t("Bus")} value={port["bus"]} options={["rs485", "can", "tcp-listen", "udp-listen"]} set={setBus} />
                <Choice label={t("Recipe")} value={port["recipe"]} options={list("recipe").map(named)} set={(value) => set("recipe", value)} />
                {isSerial && <Text label={t("Bits a second")} value={port["baud"]} placeholder="115200" set={(value) => set("baud", numeric(value))} />}
                {bus === "can" && <Text label={t("Bits a second")} value={port["bitrate"]} placeholder="500000" set={(value) => set("bitrate", numeric(value))} />}
                {!isField && <Text label={t("The controller connects to")} value={port["listen"]} placeholder="0.0.0.0:50000" set={(value) => set("listen", value)} />}
                {isSerial && (
                    <Choice label={t("Parity")} value={port["parity"] ?? "none"} options={["none", "even", "odd"]} set={(value) => set("parity", value === "none" ? "" : value)} />
                )}
                {isSerial && (
                    <Choice label={t("Stop bits")} value={String(port["stop_bits"] ?? 1)} options={["1", "2"]} set={(value) => set("stop_bits", value === "1" ? "" : 2)} />
                )}
                <Text label={t("Send every (ms)")} value={port["cycle_ms"]} placeholder="4" set={(value) => set("cycle_ms", numeric(value))} />
                <Text label={t("Silent after (ms)")} value={port["timeout_ms"]} placeholder="100" set={(value) => set("timeout_ms", numeric(value))} />
            </div>
            <Others table={port} known={PORT_KEYS} />
            {written.length > 0 && isField && (
                <>
                    <h3>{t("Safe values")}</h3>
                    <p class="note">{t("They are written when the device is silent. Without one the last value stays.")}</p>
                    <div class="form">
                        {written.map((name) => (
                            <Text
                                key={name}
                                label={name}
                                value={safe[name]}
                                placeholder={t("stays")}
                                set={(value) => {
                                    const newer = changed(safe, name, numeric(value));
                                    set("on_timeout", Object.keys(newer).length > 0 ? newer : "");
                                }}
                            />
                        ))}
                    </div>
                </>
            )}
            {recipe && <Budget recipe={recipe} port={port} />}
        </Card>
    );
}

function partsOf(recipe: Table | undefined, side: "input" | "output"): { part: Table; path: string; frame: number | null }[] {
    const part = recipe?.[side];
    if (!isTable(part)) return [];
    if (Array.isArray(part["frame"]))
        return (part["frame"] as Table[]).map((frame, nth) => ({ part: frame, path: `${side}.frame[${nth + 1}]`, frame: nth }));
    return [{ part, path: side, frame: null }];
}

/** The variables that a recipe's input writes. */
function inputsOf(recipe: Table | undefined): string[] {
    const found = partsOf(recipe, "input").flatMap(({ part }) =>
        ((part["fields"] as Field[]) ?? []).flatMap((field) => {
            if (typeof field !== "string") return typeof field["to"] === "string" ? [field["to"]] : [];
            const match = /^(\w+)\[(\d+)(?:\.\.(\d+))?\]$/.exec(field);
            if (!match) return [];
            const [first, last] = [Number(match[2]), Number(match[3] ?? match[2])];
            return Array.from({ length: Math.max(0, Math.min(64, last - first + 1)) }, (_, nth) => `${match[1]}[${first + nth}]`);
        }),
    );
    return [...new Set(found)];
}

/** How full a port's line is. */
function Budget({ recipe, port }: { recipe: Table; port: Table }) {
    if (port["bus"] !== "rs485") return null;
    const output = partsOf(recipe, "output")[0];
    const drawn = output ? pieces(output.part) : null;
    if (!drawn) return null;
    const bytes = drawn.reduce((sum, piece) => sum + piece.bytes, 0);
    const time = timeOnLine(bytes, port);
    const cycle = Number(port["cycle_ms"] ?? 4);
    const share = time / cycle;
    return (
        <div class="budget">
            <span>
                {t("Sending takes {time} ms of each {cycle} ms: {share} %", {
                    time: time.toFixed(2),
                    cycle,
                    share: Math.round(share * 100),
                })}
            </span>
            <meter min={0} max={1} low={0.6} high={0.9} optimum={0} value={Math.min(1, share)} />
            {share > 1 && <Sign tone="bad">{t("That does not fit.")}</Sign>}
        </div>
    );
}

function Recipe({ nth, recipe }: { nth: number; recipe: Table }) {
    const set = (newer: Table) => put("recipe", nth, newer);
    const isCan = recipe["kind"] === "can";
    const users = list("port").filter((port) => port["recipe"] === recipe["name"]);
    const knows = recipe["kind"] === "stream" || isCan;
    const copy = () => {
        put("recipe", list("recipe").length, { ...structuredClone(recipe), name: `${named(recipe)}-copy` });
        chosen.value = { kind: "recipe", nth: list("recipe").length - 1 };
    };
    const exported = () => {
        const place = linesOf(text.value, "recipe", nth);
        if (place) save(`${named(recipe)}.toml`, text.value.split("\n").slice(place[0], place[1] + 1).join("\n") + "\n");
    };
    const addPart = (side: "input" | "output") => set({ ...recipe, [side]: newPart(recipe, side, null) });
    // Parts of another kind have other tables; fields stay if they can.
    const convert = (newer: Table) => {
        for (const side of ["input", "output"] as const)
            if (recipe[side] !== undefined) {
                const fields = partsOf(recipe, side).flatMap(({ part }) => (part["fields"] as Field[] | undefined) ?? []);
                newer[side] = newPart(newer, side, newer["mode"] === recipe["mode"] && fields.length > 0 ? fields : null);
            }
        set(newer);
    };
    const setPart = (side: "input" | "output", frame: number | null, newer: Table | null) => {
        const part = recipe[side] as Table;
        if (frame === null) return set(changed(recipe, side, newer ?? undefined));
        const all = [...(part["frame"] as Table[])];
        if (newer) all[frame] = newer;
        else all.splice(frame, 1);
        set(changed(recipe, side, all.length > 0 ? { ...part, frame: all } : undefined));
    };
    return (
        <Card
            title={t("Recipe {name}", { name: named(recipe) })}
            aside={
                <div class="tools">
                    <button onClick={copy}>{t("Copy")}</button>
                    <button onClick={exported}>{t("Export")}</button>
                    <button class="danger" onClick={() => put("recipe", nth, null)}>
                        {t("Remove")}
                    </button>
                </div>
            }
        >
            <div class="form">
                <Text label={t("Name")} value={recipe["name"]} set={(value) => renameRecipe(nth, recipe, value)} />
                <Choice label={t("Kind")} value={recipe["kind"]} options={["stream", "can"]} set={(value) => convert(changed(recipe, "kind", value))} />
                <Choice label={t("Fields are")} value={recipe["mode"]} options={["user", "realtime"]} set={(value) => convert(changed(recipe, "mode", value))} />
            </div>
            {users.length === 0 && <p class="note">{t("No port uses this recipe. A port takes it under “Recipe”.")}</p>}
            {!knows && <p class="note">{recipe["kind"] === "image" ? t("This recipe has what only host-sim can write. It stays as it is.") : t("This kind of recipe is edited as a text.")}</p>}
            {knows && <Others table={recipe} known={["name", "kind", "mode", "input", "output"]} />}
            {knows &&
                (["input", "output"] as const).map((side) => {
                    const parts = partsOf(recipe, side);
                    return (
                        <section key={side} class="part">
                            <h3>{side === "input" ? t("Input: from the device to the robot") : t("Output: from the robot to the device")}</h3>
                            {side === "output" && isTable(recipe["output"]) && <Sending output={recipe["output"]} isRealtime={recipe["mode"] === "realtime"} set={(output) => set({ ...recipe, output })} />}
                            {parts.map(({ part, path, frame }) => (
                                <Part
                                    key={path}
                                    side={side}
                                    part={part}
                                    place={`recipe.${named(recipe)}.${path}`}
                                    isRealtime={recipe["mode"] === "realtime"}
                                    isCan={isCan}
                                    port={users[0]}
                                    set={(newer) => setPart(side, frame, newer)}
                                />
                            ))}
                            {parts.length === 0 && <button onClick={() => addPart(side)}>{side === "input" ? t("Add an input") : t("Add an output")}</button>}
                            {isCan && parts.length > 0 && (
                                <button
                                    onClick={() => {
                                        const part = recipe[side] as Table;
                                        const all = part["frame"] as Table[];
                                        const id = Math.max(...all.map((one) => Number(one["id"] ?? 0))) + 1;
                                        const frame = { ...(newPart(recipe, side, null)["frame"] as Table[])[0], id };
                                        set({ ...recipe, [side]: { ...part, frame: [...all, frame] } });
                                    }}
                                >
                                    {t("Add a CAN frame")}
                                </button>
                            )}
                        </section>
                    );
                })}
        </Card>
    );
}

/** A part as a new one begins, with these fields or a first one. */
function newPart(recipe: Table, side: "input" | "output", fields: Field[] | null): Table {
    const isInput = side === "input";
    const first: Field = recipe["mode"] === "realtime" ? ranges(isInput)[0]!.name : { name: "value1", type: "byte", ...(isInput ? {} : { value: 0 }) };
    const all = fields ?? [first];
    return recipe["kind"] === "can" ? { frame: [{ id: isInput ? 1 : 2, fields: all }] } : { head: [255, 255], tail: isInput ? [238, 238] : [254, 254], fields: all };
}

/** When an output is sent. */
function Sending({ output, isRealtime, set }: { output: Table; isRealtime: boolean; set: (newer: Table) => void }) {
    const send = String(output["send"] ?? "period");
    const [kind, bit] = send.startsWith("rising") ? ["rising", send.slice(7)] : [send, ""];
    const put = (key: string, value: string, usual: string) => set(changed(output, key, value === usual ? "" : value));
    return (
        <div class="form">
            {!isRealtime && (
                <Choice
                    label={t("Send")}
                    value={kind}
                    options={["period", "change", "frame", "rising"]}
                    words={{ period: t("each cycle"), change: t("when a value changes"), frame: t("for each frame received"), rising: t("when a bit goes on") }}
                    set={(value) => put("send", value === "rising" ? "rising:BitOutputReg[3].0" : value, "period")}
                />
            )}
            {kind === "rising" && <Text label={t("Bit")} value={bit} set={(value) => put("send", `rising:${value}`, "")} />}
            <Choice
                label={t("If a value is old")}
                value={String(output["on_stale"] ?? "hold")}
                options={["hold", "stop"]}
                words={{ hold: t("send it all the same"), stop: t("send nothing") }}
                set={(value) => put("on_stale", value, "hold")}
            />
        </div>
    );
}

/** A new name goes to the ports that use the old one as well. */
function renameRecipe(nth: number, recipe: Table, name: string) {
    try {
        let newer = replaced(text.value, "recipe", nth, { ...recipe, name });
        for (const [at, port] of list("port").entries())
            if (port["recipe"] === recipe["name"]) newer = replaced(newer, "port", at, { ...port, recipe: name });
        const controller = file.value.file?.controller;
        const link = controller?.["recipe_link"];
        if (controller && isTable(link) && link["recipe"] === recipe["name"])
            newer = replaced(newer, "controller", 0, { ...controller, recipe_link: { ...link, recipe: name } });
        edit(newer);
        wrong.value = "";
    } catch (error) {
        wrong.value = said(error);
    }
}
