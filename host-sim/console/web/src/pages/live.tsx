// Values and frames by name, as they come; latencies.
import { useEffect, useState } from "preact/hooks";
import { t } from "../i18n";
import { Card, age, microseconds, number, save } from "../parts";
import { Plot } from "../plot";
import { ask } from "../api";
import { Action } from "../parts";
import {
    type Frame,
    type Histogram,
    type Value,
    frames,
    framesAreWatched,
    framesLost,
    info,
    isAlive,
    status,
    values,
} from "../state";

const MOST_PLOTTED = 6;
/** Newest frames that are shown. Their rows stay, only what stands in them changes. */
const MOST_ROWS = 30;

export function Live() {
    return (
        <>
            <Values />
            <Frames />
            <Latencies />
        </>
    );
}

function Values() {
    const [filter, setFilter] = useState("");
    const [plotted, setPlotted] = useState<string[]>([]);
    const [held, setHeld] = useState<Record<string, Value> | null>(null);
    const all = Object.entries(held ?? values.value);
    const shown = all.filter(([name, { owner }]) => `${name} ${owner ?? ""}`.toLowerCase().includes(filter.toLowerCase()));
    const toggle = (name: string) =>
        setPlotted(plotted.includes(name) ? plotted.filter((other) => other !== name) : [...plotted, name].slice(-MOST_PLOTTED));
    return (
        <Card
            title={t("Values")}
            aside={
                <div class="tools">
                    <input
                        type="search"
                        value={filter}
                        placeholder={t("Filter by name or port")}
                        aria-label={t("Filter by name or port")}
                        onInput={(event) => setFilter(event.currentTarget.value)}
                    />
                    <button aria-pressed={held !== null} onClick={() => setHeld(held ? null : values.value)}>
                        {held ? t("Go on") : t("Pause")}
                    </button>
                </div>
            }
        >
            {plotted.length > 0 && <Plot names={plotted} />}
            {shown.length === 0 ? (
                <p class="empty">{all.length === 0 ? t("No value is known yet.") : t("No name fits.")}</p>
            ) : (
                <div class="scroll" tabIndex={0}>
                    <table class="values">
                        <thead>
                            <tr>
                                <th>{t("Plot")}</th>
                                <th>{t("Variable")}</th>
                                <th class="n">{t("Value")}</th>
                                <th class="n">{t("Age")}</th>
                                <th>{t("Written by")}</th>
                            </tr>
                        </thead>
                        <tbody>
                            {shown.map(([name, value]) => (
                                <tr key={name} class={isAlive.value || held ? "" : "old"}>
                                    <td>
                                        <input
                                            type="checkbox"
                                            aria-label={t("Plot {name}", { name })}
                                            checked={plotted.includes(name)}
                                            onChange={() => toggle(name)}
                                        />
                                    </td>
                                    <td>{name}</td>
                                    <td class="n">{isAlive.value || held ? number(value.value) : "–"}</td>
                                    <td class="n">{isAlive.value || held ? age(value.age_ms) : "–"}</td>
                                    <td>{value.owner ?? t("controller")}</td>
                                </tr>
                            ))}
                        </tbody>
                    </table>
                </div>
            )}
        </Card>
    );
}

function Frames() {
    const [port, setPort] = useState("");
    const [held, setHeld] = useState<Frame[] | null>(null);
    useEffect(() => {
        framesAreWatched.value = true;
        return () => {
            framesAreWatched.value = false;
            frames.value = [];
        };
    }, []);
    const ports = Object.keys(status.value?.ports ?? {});
    const shown = (held ?? frames.value).filter((frame) => !port || frame.port === port).slice(-MOST_ROWS).reverse();
    const last = shown[0]?.time_us ?? 0;
    const capture = async () => {
        const end = new AbortController();
        const answer = await ask(`capture.pcapng${port ? `?port=${encodeURIComponent(port)}` : ""}`, { signal: end.signal });
        const parts: Uint8Array<ArrayBuffer>[] = [];
        const timer = setTimeout(() => end.abort(), 10_000);
        try {
            const reader = answer.body!.getReader();
            for (;;) {
                const { value, done } = await reader.read();
                if (done) break;
                parts.push(value as Uint8Array<ArrayBuffer>);
            }
        } catch {
            // The time is over.
        } finally {
            clearTimeout(timer);
        }
        save("gateway.pcapng", new Blob(parts));
    };
    return (
        <Card
            title={t("Frames")}
            aside={
                <div class="tools">
                    <select value={port} aria-label={t("Port")} onChange={(event) => setPort(event.currentTarget.value)}>
                        <option value="">{t("All ports")}</option>
                        {ports.map((name) => (
                            <option key={name}>{name}</option>
                        ))}
                    </select>
                    <button aria-pressed={held !== null} onClick={() => setHeld(held ? null : frames.value)}>
                        {held ? t("Go on") : t("Pause")}
                    </button>
                    {info.value?.role === "gateway" && <Action label={t("Capture 10 s for Wireshark")} act={capture} />}
                </div>
            }
        >
            {framesLost.value > 0 && <p class="note">{t("{count} frames were too many to be shown.", { count: framesLost.value })}</p>}
            {shown.length === 0 ? (
                <p class="empty">{t("No frame yet.")}</p>
            ) : (
                <div class="scroll frames" tabIndex={0}>
                    <table>
                        <thead>
                            <tr>
                                <th class="n">{t("Time")}</th>
                                <th>{t("Port")}</th>
                                <th>{t("What")}</th>
                                <th>{t("Content")}</th>
                            </tr>
                        </thead>
                        <tbody>
                            {shown.map((frame, at) => (
                                <tr key={at} class={frame.verdict === "frame" || frame.verdict === "accepted" ? "" : "odd"}>
                                    <td class="n">{frame.time_us === last ? "0" : `−${microseconds(last - frame.time_us)}`}</td>
                                    <td>
                                        {frame.direction === "in" ? "↓" : "↑"} {frame.port}
                                    </td>
                                    <td>{t(frame.verdict)}</td>
                                    <td class="content">
                                        {frame.values ? <Content values={frame.values} /> : <code>{frame.bytes}</code>}
                                    </td>
                                </tr>
                            ))}
                        </tbody>
                    </table>
                </div>
            )}
        </Card>
    );
}

/** Most values of a frame that are shown; the others are in the table above. */
const MOST_VALUES = 6;

function Content({ values }: { values: Record<string, unknown> }) {
    const all = Object.entries(values);
    return (
        <>
            {all.slice(0, MOST_VALUES).map(([name, value]) => (
                <span key={name}>
                    {name} <b>{typeof value === "number" ? number(value) : String(value)}</b>
                </span>
            ))}
            {all.length > MOST_VALUES && <span>{t("and {count} more", { count: all.length - MOST_VALUES })}</span>}
        </>
    );
}

function Latencies() {
    const latency = status.value?.latency;
    if (!latency) return null;
    const shown = Object.entries(latency).filter(([, histogram]) => histogram.count > 0);
    return (
        <Card title={t("How long things take")}>
            {shown.length === 0 && <p class="empty">{t("Nothing was measured yet.")}</p>}
            <div class="histograms">
                {shown.map(([name, histogram]) => (
                    <Bars key={name} name={name} histogram={histogram} />
                ))}
            </div>
        </Card>
    );
}

/** Buckets that double: 1 µs, 2 µs, 4 µs and so on. */
function Bars({ name, histogram }: { name: string; histogram: Histogram }) {
    const first = histogram.buckets.findIndex((count) => count > 0);
    const last = histogram.buckets.findLastIndex((count) => count > 0);
    const most = Math.max(...histogram.buckets);
    return (
        <figure>
            <figcaption>
                {t(`latency ${name}`)}
                <span>
                    p50 {microseconds(histogram.p50_us)} · p99 {microseconds(histogram.p99_us)} · max {microseconds(histogram.max_us)}
                </span>
            </figcaption>
            <svg viewBox={`0 0 ${(last - first + 1) * 10} 40`} preserveAspectRatio="none" aria-hidden="true">
                {histogram.buckets.slice(first, last + 1).map((count, at) => {
                    // By logarithm: the rare ones are what one looks for.
                    const height = count === 0 ? 0 : 3 + (37 * Math.log(count + 1)) / Math.log(most + 1);
                    return <rect key={at} x={at * 10 + 0.5} width="9" y={40 - height} height={height} />;
                })}
            </svg>
            <div class="range">
                <span>{microseconds(2 ** Math.max(0, first - 1))}</span>
                <span>{microseconds(2 ** last)}</span>
            </div>
        </figure>
    );
}
