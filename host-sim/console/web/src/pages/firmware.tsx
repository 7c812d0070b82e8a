// The firmware of a board: what runs, an update from a file, and its trial. docs/update.md says what is refused and why.
import { signal } from "@preact/signals";
import { useState } from "preact/hooks";
import { type Firmware as Known, cameFrom, ended, firmware, keep, restart, send, sending, stop, takeBack, tryIt, untold } from "../firmware";
import { t } from "../i18n";
import { Action, Card, Dialog, Sign, choose, said } from "../parts";
import { status } from "../state";
import { type Link, compared, fitting, linksOf, otherThan } from "../update";

/** What of the chosen file this board takes. */
const chosen = signal<Link | null>(null);
/** Why it takes none of it. */
const unfit = signal("");

const endedWords = (how: string) => t(how.replace("_", "-"));

/** Above all pages while a firmware is on trial, and until somebody has seen how it ended. */
export function FirmwareTrial() {
    const known = firmware.value;
    if (restart.value)
        return (
            <div class="banner" role="alert">
                <strong>{t("The board restarts with another firmware.")}</strong>
                {restart.value === "late" && <span>{t("It is not back after a minute. This page goes on asking it.")}</span>}
            </div>
        );
    if (known?.trial)
        return (
            <div class="banner trial" role="alert">
                <strong>{t("Firmware {version} is on trial: {seconds} s left.", { version: known.version, seconds: Math.ceil(known.trial.left_s) })}</strong>
                <span>{t("To confirm itself it waits for: {what}. Otherwise the one before comes back.", { what: t(`waits ${known.trial.waits_for}`) })}</span>
                <Action tone="main" label={t("Keep it")} act={keep} />
                <Action label={t("Take it back")} act={takeBack} />
            </div>
        );
    if (!ended.value) return null;
    const { version, how } = ended.value;
    return (
        <div class="banner" role="alert">
            <strong>
                {how === "confirmed" ? t("Firmware {version} runs and is confirmed.", { version }) : t("Firmware {version} was taken back: {why}", { version, why: endedWords(how) })}
            </strong>
            <button onClick={() => (ended.value = null)}>{t("Good")}</button>
        </div>
    );
}

export function Firmware() {
    const known = firmware.value;
    if (!known) return <p class="empty">{untold.value || t("Waiting for the gateway …")}</p>;
    const { slot, other, last } = known;
    return (
        <div class="cards wide">
            <Card title={t("What runs")}>
                <dl class="facts">
                    <dt>{t("Board")}</dt>
                    <dd>{known.board}</dd>
                    <dt>{t("Firmware")}</dt>
                    <dd>{known.version}</dd>
                    {slot && (
                        <>
                            <dt>{t("State")}</dt>
                            <dd>{known.trial ? <Sign tone="warn">{t("on trial")}</Sign> : <Sign tone="good">{t("runs")}</Sign>}</dd>
                            <dt>{t("It is in")}</dt>
                            <dd>{t("slot {slot}", { slot })}</dd>
                            <dt>{t("In slot {slot}", { slot: otherThan(slot) })}</dt>
                            <dd>{other ? `${other.version} (${other.sha512.slice(0, 8)})` : t("no whole firmware")}</dd>
                            <dt>{t("Newest trial")}</dt>
                            <dd>{last ? `${t("slot {slot}", { slot: last.slot })}: ${endedWords(last.ended)}` : "–"}</dd>
                        </>
                    )}
                </dl>
                {known.version !== cameFrom.value && !known.trial && (
                    <footer>
                        <p class="note">{t("This page came from firmware {version}.", { version: cameFrom.value })}</p>
                        <button onClick={() => location.reload()}>{t("Load it again")}</button>
                    </footer>
                )}
            </Card>
            <Card title={t("Update")}>
                {known.cannot ? <Sign tone="idle">{t("This board takes no update: {why}.", { why: t(known.cannot) })}</Sign> : slot && <Update known={known} slot={slot} />}
            </Card>
        </div>
    );
}

function Update({ known, slot }: { known: Known; slot: "A" | "B" }) {
    const [older, allowOlder] = useState(false);
    const [asks, setAsks] = useState(false);
    const [refused, setRefused] = useState("");
    // After an update the other slot is free, for which the file has another link.
    const link = chosen.value?.slot === otherThan(slot) ? chosen.value : null;
    const open = () =>
        choose(".rgu", (bytes) => {
            chosen.value = null;
            unfit.value = "";
            setRefused("");
            allowOlder(false);
            try {
                chosen.value = fitting(linksOf(bytes), known.board, slot);
            } catch (error) {
                unfit.value = said(error);
            }
        });
    const start = async () => {
        setRefused("");
        try {
            await send(link!, older);
        } catch (error) {
            setRefused(said(error));
        }
    };
    // Of another firmware than the chosen one nothing is told beside it. One image can be signed with two versions.
    const incoming = known.incoming && (!link || (link.sha512 === known.incoming.sha512 && link.version === known.incoming.version)) ? known.incoming : undefined;
    const isReady = incoming?.state === "ready";
    const isAway = !!known.trial || !!restart.value;
    const newer = link ? compared(link.version, known.version) : 0;
    return (
        <>
            <p>{known.trial ? t("Decide on the trial first.") : t("The file is checked here before anything is sent. It goes into slot {free}; what runs is not touched until you try it.", { free: otherThan(slot) })}</p>
            <div class="tools">
                <button disabled={!!sending.value || isAway} onClick={open}>
                    {t("Choose a file …")}
                </button>
            </div>
            {unfit.value && (
                <p class="wrong" role="alert">
                    {unfit.value}
                </p>
            )}
            {link && (
                <dl class="facts">
                    <dt>{t("Firmware")}</dt>
                    <dd>
                        {known.version} → <b>{link.version}</b> ({newer > 0 ? t("newer") : newer < 0 ? t("older") : t("the same version")})
                    </dd>
                    <dt>{t("Board")}</dt>
                    <dd>{link.board}</dd>
                    <dt>{t("It goes into")}</dt>
                    <dd>{t("slot {slot}", { slot: link.slot })}</dd>
                    <dt>{t("Length")}</dt>
                    <dd>{t("{count} bytes", { count: link.bytes.length })}</dd>
                    <dt>{t("Configurations that it reads")}</dt>
                    <dd>{t("versions {oldest} to {newest}", { oldest: link.reads[0], newest: link.reads[1] })}</dd>
                    <dt>SHA-512</dt>
                    <dd>{link.sha512} …</dd>
                </dl>
            )}
            {(link || incoming) && (
                <div class="progress">
                    <progress aria-label={t("Sent")} max={1} value={incoming ? incoming.received / incoming.length : 0} />
                    <p role="status">
                        {sending.value === "lost" ? (
                            <Sign tone="warn">{t("There is no connection. It goes on as soon as the board answers.")}</Sign>
                        ) : isReady ? (
                            <Sign tone="good">{t("{version} is whole in slot {slot}.", { version: incoming.version, slot: otherThan(slot) })}</Sign>
                        ) : (
                            words(incoming)
                        )}
                    </p>
                </div>
            )}
            {refused && (
                <p class="wrong" role="alert">
                    {refused}
                </p>
            )}
            {newer < 0 && !isReady && (
                <label class="row">
                    <input type="checkbox" checked={older} onChange={(event) => allowOlder(event.currentTarget.checked)} />
                    {t("Take it although it is older")}
                </label>
            )}
            <footer>
                {sending.value ? (
                    <button onClick={stop}>{t("Stop")}</button>
                ) : isReady ? (
                    <button class="main" disabled={isAway} onClick={() => setAsks(true)}>
                        {t("Try it …")}
                    </button>
                ) : (
                    link && (
                        <button class="main" disabled={isAway || (newer < 0 && !older)} onClick={() => void start()}>
                            {t("Send it to the board")}
                        </button>
                    )
                )}
            </footer>
            {asks && incoming && <Try version={incoming.version} running={known.version} close={() => setAsks(false)} />}
        </>
    );
}

/** How far a firmware has come. */
function words(incoming: Known["incoming"]): string {
    if (!incoming) return t("Nothing was sent yet.");
    const { state, version, received, length, why } = incoming;
    if (state === "erasing") return t("The slot is being erased …");
    if (state === "checking") return t("The board looks at what it has received …");
    if (state === "failed") return t("The board has not taken {version}: {why}", { version, why: why ?? "–" });
    const share = Math.floor((100 * received) / length);
    if (sending.value) return t("{received} of {length} bytes ({share} %)", { received, length, share });
    return t("{share} % of {version} were sent. The same file goes on there.", { share, version });
}

function Try({ version, running, close }: { version: string; running: string; close: () => void }) {
    const [seconds, setSeconds] = useState(300);
    const isOlder = compared(version, running) < 0;
    const ports = Object.keys(status.value?.ports ?? {}).join(", ") || "–";
    return (
        <Dialog title={t("Run firmware {version} on trial", { version })} close={close}>
            {isOlder && (
                <p>
                    <Sign tone="warn">{t("It is older than {running}, which runs.", { running })}</Sign>
                </p>
            )}
            <h3>{t("What the robot will see")}</h3>
            <p>
                {t(
                    "The cell is put into its safe state: all devices count as silent, and their safe values go to the controller ({ports}). Then the board restarts, which takes some seconds, and is back with the new firmware.",
                    { ports },
                )}
            </p>
            <p>{t("It confirms itself once links and ports work as before for 10 s. If it does not in time, or cannot start, the firmware before comes back by itself.")}</p>
            <label class="row">
                {t("Time to confirm, in seconds")}
                <input type="number" min="60" max="3600" value={seconds} onInput={(event) => setSeconds(Number(event.currentTarget.value))} />
            </label>
            <footer>
                <Action
                    tone="main"
                    label={t("Run it on trial")}
                    act={async () => {
                        await tryIt(version, seconds, isOlder);
                        close();
                    }}
                />
                <button onClick={close}>{t("Not now")}</button>
            </footer>
        </Dialog>
    );
}
