// Which configurations are kept, which runs, and how another one comes to run.
import { useEffect, useState } from "preact/hooks";
import { ask } from "../api";
import { type Line, changes, diff } from "../diff";
import {
    apply,
    applyKept,
    base,
    checked,
    confirm,
    discard,
    draft,
    edit,
    imageOf,
    imported,
    isChanged,
    isOutrun,
    revisions,
    rollBack,
    take,
    text,
    textOf,
} from "../draft";
import { headOf } from "../image";
import { language, t } from "../i18n";
import { Action, Card, Dialog, Sign, choose, said, save } from "../parts";
import { isBoard, status } from "../state";

/** Above all pages while something is on trial. */
export function Trial() {
    const trial = revisions.value?.trial;
    const failure = revisions.value?.failure;
    const last = revisions.value?.last;
    const [seen, setSeen] = useState("");
    if (trial)
        return (
            <div class="banner trial" role="alert">
                <strong>
                    {t("Revision {revision} is on trial: {seconds} s left.", {
                        revision: trial.revision,
                        seconds: Math.ceil(trial.left_s),
                    })}
                </strong>
                <span>{t("Is everything as it should be? Without a confirmation the one before comes back.")}</span>
                <Action tone="main" label={t("Keep it")} act={confirm} />
                <Action label={t("Take it back")} act={rollBack} />
            </div>
        );
    const told = last && last.ended !== "confirmed" ? `${last.revision} ${last.ended} ${failure ?? ""}` : "";
    if (!told || told === seen) return null;
    return (
        <div class="banner" role="alert">
            <strong>{t("Revision {revision} was taken back: {why}", { revision: last!.revision, why: t(last!.ended) })}</strong>
            {failure && <span>{failure}</span>}
            <button onClick={() => setSeen(told)}>{t("Good")}</button>
        </div>
    );
}

/** Below all pages while there is a draft. */
export function Draft() {
    const [reviews, setReviews] = useState(false);
    if (!isChanged.value) return null;
    return (
        <div class="banner draft">
            <strong>{t("There are changes that do not run yet.")}</strong>
            {revisions.value?.trial ? (
                <span>{t("Decide on the trial first.")}</span>
            ) : draft.value !== null && checked.value && !checked.value.ok ? (
                <Sign tone="bad">{t("They cannot run.")}</Sign>
            ) : (
                <Action tone="main" label={t("Look at them and apply")} act={() => setReviews(true)} />
            )}
            <Action label={t("Drop them")} act={discard} />
            {reviews && <Review close={() => setReviews(false)} />}
        </div>
    );
}

export function Difference({ older, newer }: { older: string; newer: string }) {
    const lines = changes(diff(older, newer));
    if (lines.length === 0) return <p class="empty">{t("There is no difference.")}</p>;
    return (
        <pre class="diff" tabIndex={0}>
            {lines.map((line: Line | null, at) =>
                line ? (
                    <div key={at} class={line.sign === "+" ? "plus" : line.sign === "-" ? "minus" : ""}>
                        {line.sign} {line.text}
                    </div>
                ) : (
                    <div key={at} class="gap">
                        …
                    </div>
                ),
            )}
        </pre>
    );
}

function Review({ close }: { close: () => void }) {
    const [seconds, setSeconds] = useState(60);
    const warnings = checked.value?.warnings ?? [];
    const ports = Object.entries(status.value?.ports ?? {});
    return (
        <Dialog title={t("Apply these changes")} close={close}>
            {imported.value ? <Head image={imported.value} /> : <Difference older={base.value?.text ?? ""} newer={text.value} />}
            {warnings.length > 0 && (
                <ul class="warnings">
                    {warnings.map((warning) => (
                        <li key={warning}>
                            <Sign tone="warn">{warning}</Sign>
                        </li>
                    ))}
                </ul>
            )}
            {isOutrun.value && (
                <p class="wrong" role="alert">
                    {t("Somebody else has stored another revision meanwhile. Drop these changes to see it.")}
                </p>
            )}
            <h3>{t("What the robot will see")}</h3>
            {isBoard.value && <p>{t("The board restarts, which takes about two seconds. If it cannot run this, it returns to what it ran, and says why.")}</p>}
            <p>
                {t(
                    "All devices count as silent for about a second: their safe values go to the controller ({ports}). Then the new configuration runs on trial, and the one before comes back unless you confirm.",
                    { ports: ports.map(([name]) => name).join(", ") || "–" },
                )}
            </p>
            <label class="row">
                {t("Time to confirm, in seconds")}
                <input
                    type="number"
                    min="1"
                    max="3600"
                    value={seconds}
                    onInput={(event) => setSeconds(Number(event.currentTarget.value))}
                />
            </label>
            <footer>
                <Action
                    tone="main"
                    label={t("Apply on trial")}
                    disabled={isOutrun.value}
                    act={async () => {
                        await apply(seconds);
                        close();
                    }}
                />
                <button onClick={close}>{t("Not now")}</button>
            </footer>
        </Dialog>
    );
}

/** What can be said of an image that cannot be shown. */
function Head({ image }: { image: Uint8Array }) {
    const { version, length, crc } = headOf(image);
    return (
        <p>
            {t("An image of {length} bytes, version {version}, CRC {crc}.", { length, version, crc: crc.toString(16).toUpperCase().padStart(8, "0") })}{" "}
            {t("This page cannot show what is in it; the board reads it when it is applied.")}
        </p>
    );
}

/** Why the text of what runs is not there, on a board. */
export function Unshown() {
    const wrong = draft.value === null && base.value?.wrong;
    if (imported.value) return <Head image={imported.value} />;
    if (!wrong) return null;
    return (
        <div>
            <p>{t("What the board runs cannot be shown here: {why}", { why: wrong })}</p>
            <button onClick={() => edit('[controller]\naddress = "192.168.12.138"\n')}>{t("Begin with an empty file")}</button>
        </div>
    );
}

export function Configurations() {
    const known = revisions.value;
    const [shown, setShown] = useState<number | null>(null);
    if (!known || (!base.value && !isChanged.value)) return <p class="empty">{t("Waiting for the gateway …")}</p>;
    const mark = (revision: number) =>
        [
            revision === known.running && t("runs"),
            revision === known.live && t("live"),
            revision === known.trial?.revision && t("on trial"),
            revision === known.previous && t("live before"),
            revision === known.waiting && t("waits"),
        ].filter(Boolean);
    return (
        <>
            <Card title={t("Configurations")}>
                <div class="scroll" tabIndex={0}>
                    <table>
                        <thead>
                            <tr>
                                <th class="n">{t("Revision")}</th>
                                <th>{t("State")}</th>
                                <th>{t("Stored")}</th>
                                <th>{t("By")}</th>
                                <th />
                            </tr>
                        </thead>
                        <tbody>
                            {[...known.kept].reverse().map((kept) => (
                                <tr key={kept.revision}>
                                    <td class="n">{kept.revision}</td>
                                    <td>{mark(kept.revision).join(", ")}</td>
                                    <td>
                                        {kept.stored_at
                                            ? new Date(kept.stored_at * 1000).toLocaleString(language.value === "zh" ? "zh-CN" : "en-GB")
                                            : "–"}
                                    </td>
                                    <td>{kept.from ?? "–"}</td>
                                    <td>
                                        <div class="tools">
                                            <button onClick={() => setShown(kept.revision)}>{t("Show")}</button>
                                            {kept.revision !== known.live && !known.trial && (
                                                <Action label={t("Apply on trial")} act={() => applyKept(kept.revision, 60)} />
                                            )}
                                        </div>
                                    </td>
                                </tr>
                            ))}
                        </tbody>
                    </table>
                </div>
                {known.previous !== undefined && !known.trial && (
                    <footer>
                        <Action tone="danger" label={t("Back to revision {revision}", { revision: known.previous })} act={rollBack} />
                    </footer>
                )}
            </Card>
            <Card title={t("The file")} aside={<FileTools />}>
                <TextEditor />
            </Card>
            {shown !== null && <Shown revision={shown} close={() => setShown(null)} />}
        </>
    );
}

function FileTools() {
    const [wrong, setWrong] = useState("");
    const open = () =>
        choose(".toml,.img,text/plain", (bytes) => {
            try {
                take(bytes);
                setWrong("");
            } catch (error) {
                setWrong(said(error));
            }
        });
    const image = async () => save("gateway.img", new Blob([await imageOf(text.value)]));
    return (
        <div class="tools">
            <button onClick={open}>{t("Import …")}</button>
            <button onClick={() => save("gateway.toml", text.value)}>{t("Export")}</button>
            <Action label={t("Image for a board")} act={image} />
            {wrong && (
                <p class="wrong" role="alert">
                    {wrong}
                </p>
            )}
        </div>
    );
}

function TextEditor() {
    const mistake = checked.value && !checked.value.ok ? checked.value : null;
    return (
        <>
            <Unshown />
            <textarea
                class="toml"
                spellcheck={false}
                rows={24}
                aria-label={t("The file")}
                value={text.value}
                onInput={(event) => edit(event.currentTarget.value)}
            />
            <Mistake mistake={mistake} />
        </>
    );
}

/** What `check` says, as it prints it. */
export function Mistake({ mistake }: { mistake: { key?: string; line?: number; error?: string } | null }) {
    if (!mistake) return null;
    return (
        <p class="wrong" role="alert">
            {mistake.line ? `${t("line {line}", { line: mistake.line })}: ` : ""}
            {mistake.key ? <b>{mistake.key}: </b> : null}
            {mistake.error}
        </p>
    );
}

function Shown({ revision, close }: { revision: number; close: () => void }) {
    const [found, setFound] = useState<string | null>(null);
    useEffect(() => {
        void ask(`config?revision=${revision}`).then(async (answer) => setFound((await textOf(answer)).text));
    }, [revision]);
    return (
        <Dialog title={t("Revision {revision} beside what is edited here", { revision })} close={close}>
            {found !== null && <Difference older={found} newer={text.value} />}
            <footer>
                <button
                    onClick={() => {
                        if (found !== null) edit(found);
                        close();
                    }}
                >
                    {t("Edit this one")}
                </button>
                <button onClick={() => found !== null && save(`gateway-${revision}.toml`, found)}>{t("Export")}</button>
            </footer>
        </Dialog>
    );
}
