// The newest lines of the log.
import { useEffect, useState } from "preact/hooks";
import { ask } from "../api";
import { t } from "../i18n";
import { Action, Card, said, save } from "../parts";
import { isBoard } from "../state";

export function Log() {
    const [text, setText] = useState<string | null>(null);
    const [wrong, setWrong] = useState("");
    useEffect(() => {
        const look = async () => {
            try {
                setText(await (await ask("log")).text());
                setWrong("");
            } catch (error) {
                setWrong(said(error));
            }
        };
        void look();
        const timer = setInterval(() => void look(), 2000);
        return () => clearInterval(timer);
    }, []);
    const bundle = async () => save("gateway-bundle.json", await (await ask("bundle")).blob());
    return (
        <Card title={t("Log")} aside={isBoard.value ? <Action label={t("Save")} act={() => save("board.log", text ?? "")} /> : <Action label={t("Save everything for support")} act={bundle} />}>
            {wrong && (
                <p class="wrong" role="alert">
                    {wrong}
                </p>
            )}
            {text === "" ? <p class="empty">{t("Nothing was logged yet.")}</p> : <pre class="log" tabIndex={0}>{text}</pre>}
        </Card>
    );
}
