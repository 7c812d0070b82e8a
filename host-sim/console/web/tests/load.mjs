// Modules of the page, for tests without a browser.
import { build } from "esbuild";
import { plugin } from "../types.mjs";

// The language is the browser's.
globalThis.navigator ??= { languages: ["en"] };

/** A module of the page. */
export async function load(name) {
    const { outputFiles } = await build({ entryPoints: [`src/${name}`], bundle: true, write: false, format: "esm", jsx: "automatic", jsxImportSource: "preact", plugins: [plugin] });
    return import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`);
}
