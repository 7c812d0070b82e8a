// The simulated controller's pendant: what a person at a real one has in the hands, and the cell's switches.
import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { post } from "../api";
import { Arm } from "../arm";
import { t } from "../i18n";
import { Action, Card, Sign, said } from "../parts";
import { info, isAlive } from "../state";

interface Robot {
    robot: string;
    program_state: string;
    safety: string;
    mode: string;
    speed_percent: number;
    program: string | null;
    error: { code: number; text: string } | null;
    last_run: { program: string; outcome: string; reason?: string; line?: number } | null;
    joints_rad: number[];
    tcp_pose: number[];
    faults: Record<string, unknown>[];
    ports: Record<string, { up: boolean; recipe: string | null; cycle_ms: number; frames_in: number; frames_out: number }>;
    clients: Record<string, number>;
    log: string[];
}

const robot = signal<Robot | null>(null);
const items = signal<Record<string, number>>({});
const programs = signal<string[]>([]);
const problem = signal("");

const range = (name: string, count: number) => Array.from({ length: count }, (_, nth) => `${name}[${nth + 1}]`);
const SWITCHES = [...range("DI", 16), ...range("FDI", 8), ...range("ToolDI", 2), ...range("ToolButton", 2)];
const LAMPS = [...range("DO", 16), ...range("FDO", 8), ...range("ToolDO", 2)];
const ANALOG = range("AI_V", 2).concat(range("AI_C", 2));

async function operate<T>(operation: object): Promise<T> {
    return (await post<{ result: T }>("pendant", operation)).result;
}

async function look() {
    try {
        robot.value = await operate<Robot>({ do: "state" });
        items.value = await operate<Record<string, number>>({ do: "get", items: [...SWITCHES, ...LAMPS, ...ANALOG] });
        problem.value = "";
    } catch (error) {
        problem.value = said(error);
    }
}

async function act(operation: object) {
    await operate(operation);
    await look();
}

export function Pendant() {
    useEffect(() => {
        let ended = false;
        const again = async () => {
            if (ended) return;
            if (!document.hidden && info.value?.role === "controller") await look();
            setTimeout(() => void again(), 200);
        };
        void again();
        const names = () => void operate<string[]>({ do: "programs" }).then((found) => (programs.value = found), () => undefined);
        names();
        return () => {
            ended = true;
        };
    }, []);
    const now = robot.value;
    return (
        <>
            {problem.value && (
                <p class="wrong" role="alert">
                    {problem.value}
                </p>
            )}
            {now && (
                <div class={`pendant ${isAlive.value ? "" : "old"}`}>
                    <States now={now} />
                    <Card title={t("The arm")}>
                        <Arm joints={now.joints_rad} />
                        <dl class="facts">
                            {now.joints_rad.map((joint, nth) => [
                                <dt key={nth}>{t("Joint {n}", { n: nth + 1 })}</dt>,
                                <dd key={`${nth}=`}>{((joint * 180) / Math.PI).toFixed(1)}°</dd>,
                            ])}
                        </dl>
                    </Card>
                    <Switches />
                    <Outputs />
                    <Programs now={now} />
                    <Ports now={now} />
                </div>
            )}
        </>
    );
}

function States({ now }: { now: Robot }) {
    const isStopped = now.safety.startsWith("stop");
    return (
        <Card
            title={t("Robot")}
            aside={<Sign tone={isStopped ? "bad" : now.robot === "enable" ? "good" : "warn"}>{isStopped ? t("stopped") : t(now.robot)}</Sign>}
        >
            <dl class="facts">
                <dt>{t("controller safety")}</dt>
                <dd>{now.safety}</dd>
                <dt>{t("controller program")}</dt>
                <dd>{t(now.program_state)}</dd>
                <dt>{t("Speed")}</dt>
                <dd>{now.speed_percent} %</dd>
            </dl>
            {now.error && (
                <p class="wrong" role="alert">
                    0x{now.error.code.toString(16)}: {now.error.text}
                </p>
            )}
            <div class="tools">
                <button class="estop" onClick={() => void act({ do: "emergency_stop" }).catch((error) => (problem.value = said(error)))}>
                    {t("Emergency stop")}
                </button>
                <Action label={t("Release and acknowledge")} act={() => act({ do: "clear" })} disabled={!isStopped} />
            </div>
            <div class="tools">
                <Action label={t("Power on")} act={() => act({ do: "power_on" })} />
                <Action label={t("Enable")} act={() => act({ do: "enable" })} />
                <Action label={t("Disable")} act={() => act({ do: "disable" })} />
                <Action label={t("Power off")} act={() => act({ do: "power_off" })} />
            </div>
            <fieldset class="tools">
                <legend>{t("controller mode")}</legend>
                {["manual", "auto", "remote"].map((mode) => (
                    <button key={mode} aria-pressed={now.mode === mode} onClick={() => void act({ do: "mode", mode }).catch((error) => (problem.value = said(error)))}>
                        {t(mode)}
                    </button>
                ))}
            </fieldset>
        </Card>
    );
}

function Switches() {
    const set = (name: string, value: number) =>
        void act({ do: "set", items: { [name]: value } }).catch((error) => (problem.value = said(error)));
    return (
        <Card title={t("Inputs")}>
            <div class="lamps">
                {SWITCHES.map((name) => (
                    <button
                        key={name}
                        role="switch"
                        aria-checked={!!items.value[name]}
                        class="lamp"
                        onClick={() => set(name, items.value[name] ? 0 : 1)}
                    >
                        {name}
                    </button>
                ))}
            </div>
            {ANALOG.map((name) => (
                <label key={name} class="row">
                    {name}
                    <input
                        type="range"
                        min="0"
                        max={name.startsWith("AI_V") ? 10 : 20}
                        step="0.1"
                        value={items.value[name] ?? 0}
                        onChange={(event) => set(name, Number(event.currentTarget.value))}
                    />
                    <b>{(items.value[name] ?? 0).toFixed(1)}</b>
                </label>
            ))}
        </Card>
    );
}

function Outputs() {
    return (
        <Card title={t("Outputs")}>
            <div class="lamps">
                {LAMPS.map((name) => (
                    <span key={name} class={`lamp ${items.value[name] ? "on" : ""}`}>
                        {name}
                        <small>{items.value[name] ? t("on") : t("off")}</small>
                    </span>
                ))}
            </div>
        </Card>
    );
}

function Programs({ now }: { now: Robot }) {
    const [program, setProgram] = useState("");
    const named = program || programs.value[0] || "";
    return (
        <Card title={t("Programs")} aside={now.program ? <Sign tone="good">{now.program}</Sign> : undefined}>
            {programs.value.length === 0 ? (
                <p class="empty">{t("The file has no program.")}</p>
            ) : (
                <div class="tools">
                    <select value={named} aria-label={t("Programs")} onChange={(event) => setProgram(event.currentTarget.value)}>
                        {programs.value.map((name) => (
                            <option key={name}>{name}</option>
                        ))}
                    </select>
                    <Action tone="main" label={t("Run")} act={() => act({ do: "run", program: named })} />
                    <Action label={t("Pause")} act={() => act({ do: "pause" })} />
                    <Action label={t("Resume")} act={() => act({ do: "resume" })} />
                    <Action label={t("Stop")} act={() => act({ do: "stop" })} />
                </div>
            )}
            {now.last_run && (
                <p>
                    {now.last_run.program}: {t(now.last_run.outcome)} {now.last_run.reason ?? ""}
                    {now.last_run.line ? ` (${t("line {line}", { line: now.last_run.line })})` : ""}
                </p>
            )}
            {now.log.length > 0 && <pre class="log short">{now.log.slice(-20).join("\n")}</pre>}
        </Card>
    );
}

function Ports({ now }: { now: Robot }) {
    return (
        <Card title={t("Recipe ports")}>
            <ul class="findings">
                {Object.entries(now.ports).map(([name, port]) => (
                    <li key={name}>
                        <Sign tone={port.up ? "good" : "idle"}>
                            <b>{name}</b> {port.recipe ?? t("no recipe")}
                        </Sign>
                        <p>
                            ↓ {port.frames_in} ↑ {port.frames_out} · {port.cycle_ms} ms
                        </p>
                    </li>
                ))}
            </ul>
            <dl class="facts">
                {Object.entries(now.clients).map(([name, count]) => [
                    <dt key={name}>{t("Clients of {server}", { server: name })}</dt>,
                    <dd key={`${name}=`}>{count}</dd>,
                ])}
            </dl>
        </Card>
    );
}
