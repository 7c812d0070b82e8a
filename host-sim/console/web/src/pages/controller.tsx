// The form's parts, and what a file says of the controller and of the board's own address.
import { signal } from "@preact/signals";
import { useState } from "preact/hooks";
import { edit, file, text } from "../draft";
import { t } from "../i18n";
import { Card, said } from "../parts";
import { isBoard } from "../state";
import { type Kind, type Table, isTable, replaced } from "../toml";

export const chosen = signal<{ kind: "recipe" | "port" | "controller"; nth: number }>({ kind: "recipe", nth: 0 });
export const wrong = signal("");

export function list(kind: "recipe" | "port"): Table[] {
    return file.value.file?.[kind] ?? [];
}

/** Puts an edited table in its place in the text. */
export function put(kind: Kind, nth: number, table: Table | null) {
    try {
        edit(replaced(text.value, kind, nth, table));
        wrong.value = "";
    } catch (error) {
        wrong.value = said(error);
    }
}

export const named = (table: Table | undefined) => String(table?.["name"] ?? "?");

/** An input that is taken when it is left or Enter is pressed, so that half a name is no mistake. */
export function Typed({ value, set, list, placeholder, typing }: { value: string; set: (text: string) => void; list?: string; placeholder?: string; typing?: (text: string) => void }) {
    const [typed, setTyped] = useState<string | null>(null);
    return (
        <input
            type="text"
            {...(list ? { list } : {})}
            value={typed ?? value}
            placeholder={placeholder ?? ""}
            autocomplete="off"
            onInput={(event) => {
                setTyped(event.currentTarget.value);
                typing?.(event.currentTarget.value);
            }}
            onChange={(event) => {
                const text = event.currentTarget.value;
                setTyped(null);
                typing?.("");
                if (text !== value) set(text);
            }}
        />
    );
}

export function Text({ label, value, set, placeholder, short = false }: { label: string; value: unknown; set: (text: string) => void; placeholder?: string; short?: boolean }) {
    return (
        <label class={short ? "short" : ""}>
            {label}
            <Typed value={value === undefined ? "" : String(value)} placeholder={placeholder ?? ""} set={set} />
        </label>
    );
}

export function Choice({ label, value, options, words, set }: { label: string; value: unknown; options: string[]; words?: Record<string, string>; set: (text: string) => void }) {
    const known = typeof value === "string" && !options.includes(value) ? [value, ...options] : options;
    return (
        <label>
            {label}
            <select value={String(value ?? "")} onChange={(event) => set(event.currentTarget.value)}>
                {known.map((option) => (
                    <option key={option} value={option}>
                        {words?.[option] ?? option}
                    </option>
                ))}
            </select>
        </label>
    );
}

/** A table with one key changed; an empty text takes the key away. */
export function changed(table: Table, key: string, value: unknown): Table {
    const newer = { ...table };
    if (value === "" || value === undefined) delete newer[key];
    else newer[key] = value;
    return newer;
}

export const numeric = (text: string): unknown => (text.trim() === "" ? "" : Number.isNaN(Number(text)) ? text : Number(text));

const SERVERS = { command: 2000, state: 2001, modbus: 502, udp2011: 2011 };

/** Where the robot is, and how the gateway talks to it. */
export function Controller() {
    const controller = file.value.file?.controller ?? {};
    const network = file.value.file?.network;
    const set = (newer: Table) => put("controller", 0, newer);
    const servers = isTable(controller["ports"]) ? controller["ports"] : {};
    const link = isTable(controller["recipe_link"]) ? controller["recipe_link"] : {};
    const realtime = list("recipe").filter((recipe) => recipe["kind"] === "stream" && recipe["mode"] === "realtime").map(named);
    const none = t("none");
    const below = (key: string, table: Table, inner: string, value: unknown) => {
        const newer = changed(table, inner, value);
        set(changed(controller, key, Object.keys(newer).length > 0 ? newer : ""));
    };
    const setNetwork = (key: string, value: string) => {
        const newer = changed(network ?? {}, key, value);
        put("network", 0, newer["address"] === undefined ? null : newer);
    };
    return (
        <Card title={t("Controller")}>
            <div class="form">
                <Text label={t("Address")} value={controller["address"]} set={(value) => set({ address: value, ...changed(controller, "address", value) })} />
                <Choice label={t("Dialect")} value={controller["dialect"] ?? "v2.3"} options={["v2.3", "v2.6"]} set={(value) => set(changed(controller, "dialect", value === "v2.3" ? "" : value))} />
            </div>
            <h3>{t("Recipe link")}</h3>
            <p class="note">{t("The controller's UDP server of recipes, set on its pendant to the same recipe, takes and sends values every 4 ms. Forces need it or a port that listens.")}</p>
            <div class="form">
                <Choice
                    label={t("Recipe")}
                    value={link["recipe"] ?? none}
                    options={[none, ...realtime]}
                    set={(value) => set(changed(controller, "recipe_link", value === none ? "" : { ...link, recipe: value }))}
                />
                {link["recipe"] !== undefined && <Text short label="UDP" value={link["udp"]} placeholder={String(servers["udp2011"] ?? 2011)} set={(value) => below("recipe_link", link, "udp", numeric(value))} />}
            </div>
            <h3>{t("Its servers")}</h3>
            <div class="form">
                {Object.entries(SERVERS).map(([key, usual]) => (
                    <Text short key={key} label={key} value={servers[key]} placeholder={String(usual)} set={(value) => below("ports", servers, key, numeric(value))} />
                ))}
            </div>
            {(isBoard.value || network) && (
                <>
                    <h3>{t("The board's own address")}</h3>
                    <div class="form">
                        <Text label={t("Address/prefix")} value={network?.["address"]} placeholder="DHCP" set={(value) => setNetwork("address", value)} />
                        <Text label={t("Router")} value={network?.["router"]} placeholder={none} set={(value) => setNetwork("router", value)} />
                        <Text label={t("Name server")} value={network?.["dns"]} placeholder={none} set={(value) => setNetwork("dns", value)} />
                    </div>
                </>
            )}
        </Card>
    );
}
