// Texts in English and Chinese. The English text is the key, so a missing one is shown in English; a test finds it.
import { signal } from "@preact/signals";
import { en } from "./en";
import { zh } from "./zh";

export type Language = "en" | "zh";
const KEPT_AS = "recipe-gateway-language";

function chosen(): Language {
    try {
        const kept = localStorage.getItem(KEPT_AS);
        if (kept === "en" || kept === "zh") return kept;
    } catch {
        // The browser's own then.
    }
    return navigator.languages?.[0]?.toLowerCase().startsWith("zh") ? "zh" : "en";
}

export const language = signal<Language>(chosen());

export function speak(newer: Language) {
    language.value = newer;
    try {
        localStorage.setItem(KEPT_AS, newer);
    } catch {
        // Only for this visit then.
    }
}

/** A text in the chosen language; `{name}` is replaced. */
export function t(text: string, parts: Record<string, string | number> = {}): string {
    const found = (language.value === "zh" ? zh[text] : undefined) ?? en[text] ?? text;
    return found.replace(/\{(\w+)\}/g, (whole, name: string) => String(parts[name] ?? whole));
}
