// A board that has no key yet: it is given one, once, within a minute of a press of its button.
import { bytesToHex } from "@noble/hashes/utils.js";
import { useState } from "preact/hooks";
import { askJson, post, useKey } from "../api";
import { t } from "../i18n";
import { Action, Card, Sign, save } from "../parts";
import { type Info, info } from "../state";

export function Claim() {
    const [made] = useState(() => bytesToHex(crypto.getRandomValues(new Uint8Array(16))));
    const [key, setKey] = useState(made);
    const [isSaved, setSaved] = useState(false);
    const left = info.value?.claim_left_s;
    const clean = key.trim().toLowerCase();
    const fits = /^[0-9a-f]{32}$/.test(clean);
    return (
        <Card title={t("This board belongs to nobody yet")}>
            <p>{t("It runs its configuration, and tells and changes nothing until it has a key. Whoever has the key can change what it runs.")}</p>
            <ol>
                <li>
                    <label class="row">
                        {t("Key")}
                        <input
                            class="key"
                            type="text"
                            autocomplete="off"
                            spellcheck={false}
                            value={key}
                            onInput={(event) => {
                                setKey(event.currentTarget.value);
                                setSaved(false);
                            }}
                        />
                    </label>
                    <div class="tools">
                        <button
                            disabled={!fits}
                            onClick={() => {
                                save(`${info.value?.name ?? "board"}.key`, `${clean}\n`);
                                setSaved(true);
                            }}
                        >
                            {t("Save the key as a file")}
                        </button>
                        {isSaved && <Sign tone="good">{t("saved")}</Sign>}
                    </div>
                    <p class="note">{t("Keep it where only those can read it who may change the board. If it is lost, the board's store has to be erased with a probe.")}</p>
                </li>
                <li>
                    <p>{left === undefined ? t("Press the button of the board.") : <Sign tone="good">{t("The button was pressed: {seconds} s left.", { seconds: left })}</Sign>}</p>
                </li>
                <li>
                    <Action
                        tone="main"
                        label={t("Give it this key")}
                        disabled={!fits || left === undefined || (key === made && !isSaved)}
                        act={async () => {
                            await post("claim", { key: clean });
                            useKey(clean);
                            info.value = await askJson<Info>("info");
                        }}
                    />
                    <p class="note">{t("The key goes over the network as it is, this once.")}</p>
                </li>
            </ol>
        </Card>
    );
}
