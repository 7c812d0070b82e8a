// The page: which parts there are, and what stands above all of them.
import { signal } from "@preact/signals";
import { render } from "preact";
import { useState } from "preact/hooks";
import { key, keyIsAskedFor, post, useKey } from "./api";
import { watchRevisions } from "./draft";
import { language, speak, t } from "./i18n";
import { Claim } from "./pages/claim";
import { Configurations, Draft, Trial } from "./pages/configurations";
import { Doctor } from "./pages/doctor";
import { Firmware, FirmwareTrial } from "./pages/firmware";
import { Live } from "./pages/live";
import { Log } from "./pages/log";
import { Overview } from "./pages/overview";
import { Pendant } from "./pages/pendant";
import { Recipes } from "./pages/recipes";
import { Action, Dialog } from "./parts";
import { info, isAlive, isBoard, isController, isUnclaimed, silentFor, status, streamError, watch } from "./state";
import "./style.css";

const PAGES = {
    overview: ["Overview", Overview],
    live: ["Live", Live],
    recipes: ["Recipes", Recipes],
    configurations: ["Configurations", Configurations],
    firmware: ["Firmware", Firmware],
    doctor: ["Doctor", Doctor],
    pendant: ["Pendant", Pendant],
    log: ["Log", Log],
} as const;
type Name = keyof typeof PAGES;

const shown = () => {
    if (isController.value) return ["pendant", "log"] as Name[];
    return (Object.keys(PAGES) as Name[]).filter((name) => name !== "pendant" && name !== (isBoard.value ? "doctor" : "firmware"));
};
const place = signal(location.hash.slice(1));
addEventListener("hashchange", () => (place.value = location.hash.slice(1)));

const page = (): Name => {
    const all = shown();
    return all.includes(place.value as Name) ? (place.value as Name) : all[0]!;
};

function App() {
    const now = page();
    const Page = PAGES[now][1];
    const [asks, setAsks] = useState(false);
    document.documentElement.lang = language.value;
    document.title = `${info.value?.name ?? t("Recipe gateway")} – ${t(PAGES[now][0])}`;
    return (
        <div class={isAlive.value || !status.value ? "app" : "app lost-contact"}>
            <div class="above">
                <header class="top">
                    {info.value?.peer_port ? <Halves port={info.value.peer_port} /> : <strong>{title()}</strong>}
                    <nav aria-label={t("Pages")}>
                        {(isUnclaimed.value ? [] : shown()).map((name) => (
                            <a key={name} href={`#${name}`} aria-current={name === now ? "page" : undefined}>
                                {t(PAGES[name][0])}
                            </a>
                        ))}
                    </nav>
                    <div class="tools">
                        {isUnclaimed.value ? null : info.value && !info.value.can_be_changed ? (
                            <span class="note">{t("read only")}</span>
                        ) : (
                            <button class="quiet" onClick={() => setAsks(true)}>
                                {key.value ? t("Key ✓") : t("Key …")}
                            </button>
                        )}
                        <button class="quiet" onClick={() => speak(language.value === "zh" ? "en" : "zh")} lang={language.value === "zh" ? "en" : "zh"}>
                            {language.value === "zh" ? "English" : "中文"}
                        </button>
                    </div>
                </header>
                {!isAlive.value && status.value && (
                    <div class="banner lost" role="alert">
                        <strong>{t("No connection for {seconds} s.", { seconds: silentFor.value })}</strong>
                        <span>{t("What is shown is old.")}</span>
                    </div>
                )}
                {!isAlive.value && !status.value && streamError.value && (
                    <div class="banner lost" role="alert">
                        {streamError.value}
                    </div>
                )}
                {!isController.value && !isUnclaimed.value && <Trial />}
                {isBoard.value && !isUnclaimed.value && <FirmwareTrial />}
            </div>
            <main>{isUnclaimed.value ? <Claim /> : <Page />}</main>
            {!isController.value && !isUnclaimed.value && <Draft />}
            {(asks || keyIsAskedFor.value) && (
                <KeyDialog
                    close={() => {
                        setAsks(false);
                        keyIsAskedFor.value = null;
                    }}
                />
            )}
        </div>
    );
}

const title = () => (isController.value ? t("Simulated controller") : (info.value?.name ?? t("Recipe gateway")));

/** Gateway and controller of one machine are two servers, so the other one is a link: no page reads another server. */
function Halves({ port }: { port: number }) {
    const other = `${location.protocol}//${location.hostname}:${port}/`;
    return (
        <nav class="halves" aria-label={t("This machine")}>
            {[false, true].map((controller) => (
                <a key={String(controller)} {...(controller === isController.value ? { href: "#", "aria-current": "true" } : { href: other })}>
                    {controller ? t("Simulated controller") : t("Gateway")}
                </a>
            ))}
        </nav>
    );
}

function KeyDialog({ close }: { close: () => void }) {
    const [text, setText] = useState("");
    const clean = text.trim().toLowerCase();
    const fits = /^[0-9a-f]{32}$/.test(clean);
    return (
        <Dialog title={t("Key")} close={close}>
            {keyIsAskedFor.value === "wrong" && (
                <p class="wrong" role="alert">
                    {t("This key is wrong.")}
                </p>
            )}
            <p>{t("Changes need the gateway's key: 32 hexadecimal digits. It stays in this tab, and never goes over a network as it is.")}</p>
            <label class="row">
                {t("Key")}
                <input type="password" autocomplete="off" value={text} onInput={(event) => setText(event.currentTarget.value)} />
            </label>
            <footer>
                <Action
                    tone="main"
                    label={t("Use it")}
                    disabled={!fits}
                    act={async () => {
                        useKey(clean);
                        close();
                    }}
                />
                {key.value && (
                    <button
                        onClick={() => {
                            useKey("");
                            close();
                        }}
                    >
                        {t("Forget it")}
                    </button>
                )}
                {isBoard.value && <Action label={t("Blink")} act={() => post("identify", { s: 10 })} />}
            </footer>
        </Dialog>
    );
}

watch();
watchRevisions();
render(<App />, document.getElementById("app")!);
