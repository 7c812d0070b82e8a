// A device as a template: a whole gateway file with its port and recipes, as `host-sim new --device` writes them.
import { type Table, linesOf, read, replaced, same } from "./toml";

const named = (table: Table) => String(table["name"] ?? "");

/** The lines of a table with the comments right above it. */
function block(text: string, kind: "recipe" | "port", nth: number): string[] {
    const [first, last] = linesOf(text, kind, nth)!;
    const lines = text.split("\n");
    let from = first;
    while (from > 0 && lines[from - 1]!.startsWith("#")) from--;
    return lines.slice(from, last + 1);
}

/** The template of a port: its recipe, and the recipe that its values go up by. */
export function templateOf(text: string, nth: number): string {
    const file = read(text);
    const port = file.port![nth]!;
    const link = file.controller?.["recipe_link"] as Table | undefined;
    const parts = [`# ${named(port)}: ${String(port["bus"])}, recipe ${String(port["recipe"])}\n#\n# Wiring:\n# Source:`];
    parts.push(`[controller]\naddress = "127.0.0.1"${link ? `\nrecipe_link = { recipe = ${JSON.stringify(link["recipe"])} }` : ""}`);
    for (const [at, recipe] of (file.recipe ?? []).entries())
        if (named(recipe) === port["recipe"] || (link && named(recipe) === link["recipe"])) parts.push(block(text, "recipe", at).join("\n"));
    parts.push(block(text, "port", nth).join("\n"));
    return parts.join("\n\n") + "\n";
}

/** A text with the recipes and ports of another one added, with their comments. What is there already stays; another one
 * of the same name gets a new name. */
export function withTemplate(text: string, template: string): string {
    const from = read(template);
    const renamed = new Map<string, string>();
    let newer = text;
    const lists = { recipe: from.recipe ?? [], port: from.port ?? [] };
    const link = from.controller?.["recipe_link"] as Table | undefined;
    // What goes up by a link is the cell's own, if it has one.
    const isOther = (recipe: Table) =>
        !!link && named(recipe) === link["recipe"] && read(text).controller?.["recipe_link"] !== undefined && !lists.port.some((port) => port["recipe"] === link["recipe"]);
    for (const kind of ["recipe", "port"] as const)
        for (const [nth, table] of lists[kind].entries()) {
            if (kind === "recipe" && isOther(table)) continue;
            const own = read(newer)[kind] ?? [];
            const wanted: Table = kind === "port" ? { ...table, recipe: renamed.get(String(table["recipe"])) ?? table["recipe"] } : { ...table };
            const name = named(table);
            if (own.some((one) => same(one, wanted))) continue;
            let free = name;
            for (let n = 2; own.some((one) => named(one) === free); n++) free = `${name}-${n}`;
            if (kind === "recipe") renamed.set(name, free);
            wanted["name"] = free;
            newer = inserted(newer, kind, block(template, kind, nth));
            newer = replaced(newer, kind, own.length, wanted);
        }
    const controller = read(newer).controller;
    if (link && controller && controller["recipe_link"] === undefined) {
        const recipe = renamed.get(String(link["recipe"])) ?? link["recipe"];
        newer = replaced(newer, "controller", 0, { ...controller, recipe_link: { ...link, recipe } });
    }
    return newer;
}

/** Recipes go behind the last recipe, ports to the end. */
function inserted(text: string, kind: "recipe" | "port", lines: string[]): string {
    const all = text.replace(/\s*$/, "").split("\n");
    let at = all.length;
    const ports = kind === "recipe" ? linesOf(text, "port", 0) : null;
    if (ports) for (at = ports[0]; at > 0 && all[at - 1]!.startsWith("#"); ) at--;
    const blank = at > 0 && all[at - 1]!.trim() !== "" ? [""] : [];
    all.splice(at, 0, ...blank, ...lines, ...(at < all.length ? [""] : []));
    return all.join("\n") + "\n";
}
