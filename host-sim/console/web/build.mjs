// Builds ../dist/index.html: one file with everything in it, no requests to anywhere else.
import { readFileSync, writeFileSync, mkdirSync } from "node:fs";
import { createHash } from "node:crypto";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";
import { plugin } from "./types.mjs";

const LIMIT = 64 * 1024;

const result = await build({
    entryPoints: ["src/main.tsx"],
    bundle: true,
    minify: true,
    write: false,
    outdir: "out",
    target: "es2022",
    format: "iife",
    jsx: "automatic",
    jsxImportSource: "preact",
    legalComments: "none",
    charset: "utf8",
    logLevel: "warning",
    metafile: true,
    plugins: [plugin],
});
const text = (end) => result.outputFiles.find((file) => file.path.endsWith(end)).text.trim();
// A browser ends a script at `</script`, wherever it stands.
const script = text(".js").replaceAll("</script", "<\\/script");
const style = text(".css");
const page = readFileSync("src/page.html", "utf8")
    .replace("/* style */", () => style)
    .replace("/* script */", () => script);
// The page is not served with another script or style than these.
const hash = (text) => `'sha256-${createHash("sha256").update(text).digest("base64")}'`;
const policy = [
    "default-src 'none'",
    `script-src ${hash(script)}`,
    `style-src ${hash(style)}`,
    "img-src data:",
    "connect-src 'self'",
    "base-uri 'none'",
    "form-action 'none'",
    "frame-ancestors 'none'",
].join("; ");

mkdirSync("../dist", { recursive: true });
writeFileSync("../dist/index.html", page);
writeFileSync("../dist/policy.txt", policy + "\n");
const packed = gzipSync(page, { level: 9 }).length;
console.log(`dist/index.html: ${page.length} characters, ${packed} bytes with gzip; ${LIMIT} are allowed`);
if (process.argv.includes("--parts")) {
    const inputs = Object.entries(Object.values(result.metafile.outputs)[0].inputs);
    for (const [name, { bytesInOutput }] of inputs.sort((a, b) => b[1].bytesInOutput - a[1].bytesInOutput)) {
        console.log(String(bytesInOutput).padStart(8), name);
    }
}
if (packed > LIMIT) {
    console.error("the page is too large");
    process.exit(1);
}
