// What a configuration image is made of, for the page: read from the files that proto-core's tests hold to its code,
// so that the page has no table of its own. The virtual module `image-types` offers it to the sources.
import { readFileSync, readdirSync } from "node:fs";
import { fileURLToPath } from "node:url";

const CORE = fileURLToPath(new URL("../../../proto-core", import.meta.url));

/** The newest version of images that has golden files. */
function newest() {
    const versions = readdirSync(`${CORE}/tests/golden`).flatMap((name) => /^v(\d+)$/.exec(name)?.[1] ?? []);
    return Math.max(...versions.map(Number));
}

/**
 * The types, as `serde_reflection` prints them, as short as the page wants them: a name of a type, `{ s: [name, type]
 * pairs }` for a struct, `{ e: [name, type or null] pairs }` for an enum, `{ o: type }`, `{ q: type }` for a sequence,
 * `{ a: [length, type] }`.
 */
function typesOf(text) {
    const words = text.match(/"[^"]*"|\w+|[{}[\]():,]/g);
    let at = 0;
    const take = (...wanted) => {
        for (const word of wanted) if (words[at++] !== word) throw new Error(`types.txt: ${word} expected near ${words.slice(at - 8, at + 4).join(" ")}`);
    };
    const named = () => {
        take("Named", "{", "name", ":");
        const name = JSON.parse(words[at++]);
        take(",", "value", ":");
        const type = one();
        take(",", "}");
        return [name, type];
    };
    const within = () => {
        take("(");
        const type = one();
        take(",", ")");
        return type;
    };
    function one() {
        const kind = words[at++];
        switch (kind) {
            case "Unit":
                return null;
            case "NewType":
            case "NewTypeStruct":
                return within();
            case "Option":
                return { o: within() };
            case "Seq":
                return { q: within() };
            case "TypeName": {
                take("(");
                const name = JSON.parse(words[at++]);
                take(",", ")");
                return name;
            }
            case "TupleArray": {
                take("{", "content", ":");
                const content = one();
                take(",", "size", ":");
                const size = Number(words[at++]);
                take(",", "}");
                return { a: [size, content] };
            }
            case "Struct": {
                take("(", "[");
                const fields = [];
                while (words[at] !== "]") {
                    fields.push(named());
                    take(",");
                }
                take("]", ",", ")");
                return { s: fields };
            }
            case "Enum": {
                take("(", "{");
                const variants = [];
                while (words[at] !== "}") {
                    take(String(variants.length), ":");
                    variants.push(named());
                    take(",");
                }
                take("}", ",", ")");
                return { e: variants };
            }
            default:
                return kind;
        }
    }
    const found = {};
    while (at < words.length) {
        const name = words[at++];
        take(":");
        found[name] = one();
    }
    return found;
}

/** The rows of the state packet: name, and whether one item of several has to be named. */
function rowsOf(text) {
    const rows = [...text.matchAll(/^\| \d+ \| `(\w+)` \| \w+ x (\d+) \|/gm)];
    return rows.map(([, name, count]) => (Number(count) > 1 ? `${name}[]` : name));
}

/** Version, types, names of variables in their order, rows of the state packet. */
export function imageTypes() {
    const version = newest();
    const text = readFileSync(`${CORE}/tests/golden/v${version}/types.txt`, "utf8");
    const start = text.indexOf("variable 0:");
    return {
        version,
        types: typesOf(text.slice(0, start)),
        variables: [...text.slice(start).matchAll(/^variable \d+: (\S+)$/gm)].map(([, name]) => name),
        rows: rowsOf(readFileSync(`${CORE}/docs/wire/state.md`, "utf8")),
    };
}

/** For esbuild. */
export const plugin = {
    name: "image-types",
    setup(build) {
        build.onResolve({ filter: /^image-types$/ }, ({ path }) => ({ path, namespace: "image-types" }));
        build.onLoad({ filter: /.*/, namespace: "image-types" }, () => {
            const { version, types, rows } = imageTypes();
            const contents = [`export const VERSION = ${version};`, `export const TYPES = ${JSON.stringify(types)};`, `export const ROWS = ${JSON.stringify(rows)};`];
            return { contents: contents.join("\n"), loader: "js" };
        });
    },
};
