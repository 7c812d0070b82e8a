// A plot of some values over the last seconds.
//
// Our own and not a library: the usual small one, uPlot 1.6, is 23 KB of the 64 KB that a board has for this page; this
// is 1.6 KB, and draws what is needed here: up to six lines, gaps where a value was unknown, and the value at a finger.
import { useEffect, useRef, useState } from "preact/hooks";
import { number } from "./parts";
import { isAlive, status, values } from "./state";
import { t } from "./i18n";

const COLOURS = ["#0b84a5", "#d2691e", "#4c9a2a", "#9467bd", "#b8860b", "#d1347f"];
const DASHES: number[][] = [[], [9, 4], [2, 3], [10, 3, 2, 3], [5, 5], [1, 4]];
const SECONDS = 30;
const HEIGHT = 260;
const LEFT = 70;
const BOTTOM = 24;

interface Sample {
    at: number;
    of: (number | null)[];
}

/** Round steps, so that at most `most` of them cover a range. */
export function step(range: number, most: number): number {
    const rough = range / most;
    const power = 10 ** Math.floor(Math.log10(rough));
    return power * ([1, 2, 5].find((factor) => factor * power >= rough) ?? 10);
}

export function Plot({ names }: { names: string[] }) {
    const canvas = useRef<HTMLCanvasElement>(null);
    const [pointed, setPointed] = useState<Sample | null>(null);
    useEffect(() => {
        const element = canvas.current!;
        const samples: Sample[] = [];
        let finger: number | null = null;
        const draw = () => {
            const width = element.clientWidth;
            const scale = devicePixelRatio || 1;
            element.width = Math.round(width * scale);
            element.height = Math.round(HEIGHT * scale);
            const to = element.getContext("2d")!;
            to.scale(scale, scale);
            const styles = getComputedStyle(element);
            const ink = styles.getPropertyValue("--soft");
            to.font = `13px ${styles.fontFamily}`;
            const known = samples.flatMap(({ of }) => of.filter((value) => value !== null));
            let [low, high] = known.length > 0 ? [Math.min(...known), Math.max(...known)] : [0, 1];
            const room = (high - low || Math.abs(high) || 1) * 0.08;
            [low, high] = [low - room, high + room];
            const end = samples.at(-1)?.at ?? 0;
            const x = (at: number) => LEFT + ((at - end + SECONDS) / SECONDS) * (width - LEFT - 8);
            const y = (value: number) => 8 + ((high - value) / (high - low)) * (HEIGHT - BOTTOM - 8);
            to.fillStyle = ink;
            to.strokeStyle = styles.getPropertyValue("--rule");
            to.textBaseline = "middle";
            to.textAlign = "right";
            const rows = step(high - low, 6);
            for (let value = Math.ceil(low / rows) * rows; value <= high; value += rows) {
                to.beginPath();
                to.moveTo(LEFT, y(value));
                to.lineTo(width - 8, y(value));
                to.stroke();
                to.fillText(number(Math.abs(value) < rows / 1e6 ? 0 : value), LEFT - 8, y(value));
            }
            to.textAlign = "center";
            for (let back = 0; back <= SECONDS; back += 5) to.fillText(back === 0 ? "0 s" : `−${back}`, x(end - back) - (back === 0 ? 8 : 0), HEIGHT - 10);
            for (const nth of names.keys()) {
                to.strokeStyle = COLOURS[nth % COLOURS.length]!;
                to.setLineDash(DASHES[nth % DASHES.length]!);
                to.lineWidth = 2;
                to.beginPath();
                let isGap = true;
                for (const { at, of } of samples) {
                    const value = of[nth] ?? null;
                    if (value === null) isGap = true;
                    else if (isGap) {
                        to.moveTo(x(at), y(value));
                        isGap = false;
                    } else to.lineTo(x(at), y(value));
                }
                to.stroke();
            }
            to.setLineDash([]);
            if (finger === null) return;
            const at = end - SECONDS + ((finger - LEFT) / (width - LEFT - 8)) * SECONDS;
            const near = samples.reduce<Sample | null>((best, one) => (!best || Math.abs(one.at - at) < Math.abs(best.at - at) ? one : best), null);
            if (near) {
                to.strokeStyle = ink;
                to.lineWidth = 1;
                to.beginPath();
                to.moveTo(x(near.at), 8);
                to.lineTo(x(near.at), HEIGHT - BOTTOM);
                to.stroke();
            }
            setPointed(near);
        };
        const take = () => {
            const now = status.value;
            if (!now) return;
            const at = now.time_us / 1e6;
            const last = samples.at(-1);
            // Another gateway has another clock.
            if (last && at < last.at) samples.length = 0;
            if (last && at === last.at) return;
            samples.push({ at, of: names.map((name) => (isAlive.value ? (values.value[name]?.value ?? null) : null)) });
            while (samples[0]!.at < at - SECONDS) samples.shift();
            draw();
        };
        const point = (event: PointerEvent) => {
            finger = event.type === "pointerleave" ? null : event.offsetX;
            if (finger === null) setPointed(null);
            draw();
        };
        for (const kind of ["pointermove", "pointerdown", "pointerleave"] as const) element.addEventListener(kind, point);
        const ends = values.subscribe(take);
        const resized = new ResizeObserver(draw);
        resized.observe(element);
        return () => {
            ends();
            resized.disconnect();
        };
    }, [names.join()]);
    const shown = (nth: number, name: string) => (pointed ? pointed.of[nth] : values.value[name]?.value) ?? null;
    return (
        <figure class="plot">
            <canvas ref={canvas} role="img" aria-label={t("Plot of {names}", { names: names.join(", ") })} />
            <figcaption>
                {names.map((name, nth) => {
                    const value = shown(nth, name);
                    return (
                        <span key={name}>
                            <svg viewBox="0 0 30 6" width="30" height="6" aria-hidden="true">
                                <line x1="0" y1="3" x2="30" y2="3" stroke={COLOURS[nth % COLOURS.length]!} stroke-width="3" stroke-dasharray={DASHES[nth % DASHES.length]!.join(" ")} />
                            </svg>{" "}
                            {name} <b>{value === null ? "–" : number(value)}</b>
                        </span>
                    );
                })}
            </figcaption>
        </figure>
    );
}
