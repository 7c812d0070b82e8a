// Small parts of all pages.
import type { ComponentChildren, JSX } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { Refused } from "./api";
import { t } from "./i18n";

export type Tone = "good" | "warn" | "bad" | "idle";

const SHAPES: Record<Tone, JSX.Element> = {
    good: <circle cx="8" cy="8" r="6.5" />,
    warn: <path d="M8 1.2 15.2 14.4H.8Z" />,
    bad: <path d="M1.6 1.6h12.8v12.8H1.6Z" />,
    idle: <path d="M8 1.5a6.5 6.5 0 1 0 0 13 6.5 6.5 0 0 0 0-13Zm0 2.6a3.9 3.9 0 1 1 0 7.8 3.9 3.9 0 0 1 0-7.8Z" />,
};

/** A sign with its word: the shape says the same as the colour. */
export function Sign({ tone, children }: { tone: Tone; children: ComponentChildren }) {
    return (
        <span class={`sign ${tone}`}>
            <svg viewBox="0 0 16 16" aria-hidden="true">
                {SHAPES[tone]}
            </svg>
            {children}
        </span>
    );
}

export function Card({ title, children, aside }: { title: ComponentChildren; children: ComponentChildren; aside?: ComponentChildren }) {
    return (
        <section class="card">
            <header>
                <h2>{title}</h2>
                {aside}
            </header>
            {children}
        </section>
    );
}

/** A time in words that do not jump: at most three digits. */
export function age(ms: number | undefined): string {
    if (ms === undefined) return "–";
    if (ms < 1000) return `${Math.round(ms)} ms`;
    if (ms < 100_000) return `${(ms / 1000).toFixed(ms < 10_000 ? 1 : 0)} s`;
    if (ms < 3_600_000) return `${Math.floor(ms / 60_000)} min`;
    return `${Math.floor(ms / 3_600_000)} h`;
}

export function microseconds(us: number): string {
    return us < 1000 ? `${us} µs` : us < 1_000_000 ? `${(us / 1000).toFixed(us < 10_000 ? 1 : 0)} ms` : `${(us / 1e6).toFixed(1)} s`;
}

export function number(value: number): string {
    if (Number.isInteger(value)) return String(value);
    const size = Math.abs(value);
    return size >= 1e6 || size < 1e-3 ? value.toExponential(3) : value.toFixed(size >= 1000 ? 1 : size >= 10 ? 2 : 3);
}

/** Something that is done with a press; it cannot be pressed twice, and says what went wrong. */
export function Action({
    label,
    act,
    tone = "plain",
    disabled = false,
}: {
    label: string;
    act: () => Promise<unknown> | void;
    tone?: "plain" | "main" | "danger";
    disabled?: boolean;
}) {
    const [busy, setBusy] = useState(false);
    const [wrong, setWrong] = useState("");
    const press = async () => {
        setBusy(true);
        setWrong("");
        try {
            await act();
        } catch (error) {
            setWrong(said(error));
        } finally {
            setBusy(false);
        }
    };
    return (
        <>
            <button class={tone} disabled={disabled || busy} aria-busy={busy} onClick={() => void press()}>
                {label}
            </button>
            {wrong && (
                <p class="wrong" role="alert">
                    {wrong}
                </p>
            )}
        </>
    );
}

/** What an error says to a person. */
export function said(error: unknown): string {
    if (error instanceof Refused) {
        const { key, line } = error.answer as { key?: string; line?: number };
        const place = key ? `${key}${line ? ` (${t("line {line}", { line })})` : ""}: ` : "";
        return place + error.message;
    }
    if (error instanceof TypeError) return t("There is no connection.");
    return error instanceof Error ? error.message : String(error);
}

/** A dialog over the page; the browser keeps the focus in it, and Escape closes it. */
export function Dialog({ title, close, children }: { title: string; close: () => void; children: ComponentChildren }) {
    const dialog = useRef<HTMLDialogElement>(null);
    useEffect(() => dialog.current?.showModal(), []);
    return (
        <dialog ref={dialog} onClose={close} aria-label={title}>
            <header>
                <h2>{title}</h2>
                <button class="quiet" onClick={close} aria-label={t("Close")}>
                    ✕
                </button>
            </header>
            {children}
        </dialog>
    );
}

/** Lets the person choose a file. */
export function choose(accept: string, take: (bytes: Uint8Array<ArrayBuffer>) => void) {
    const input = document.createElement("input");
    input.type = "file";
    input.accept = accept;
    input.onchange = async () => {
        const chosen = input.files?.[0];
        if (chosen) take(new Uint8Array(await chosen.arrayBuffer()));
    };
    input.click();
}

/** Gives a text to the person as a file. */
export function save(name: string, text: string | Blob) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(text instanceof Blob ? text : new Blob([text], { type: "text/plain" }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
