// Why does it not work?
import { useEffect, useState } from "preact/hooks";
import { askJson } from "../api";
import { t } from "../i18n";
import { Action, Card, Sign, said } from "../parts";

/** A finding as `GET doctor` tells it: docs/trouble.md. */
export interface Finding {
    /** `port`, `link` or `controller`. */
    place: string;
    name?: string;
    severity: string;
    cause: string;
    seen: string;
    expected?: string;
    likely?: string;
    remedy?: string;
}

export function Findings({ findings }: { findings: Finding[] }) {
    return (
        <ul class="findings">
            {findings.map((finding, at) => (
                <li key={at} class={finding.severity === "fault" ? "" : "hint"}>
                    <Sign tone={finding.severity === "fault" ? "bad" : "warn"}>
                        <span>
                            <b>{finding.name ?? finding.place}</b> {finding.seen}
                        </span>
                    </Sign>
                    {finding.expected && <p>{t("Expected: {text}", { text: finding.expected })}</p>}
                    {finding.likely && <p>{finding.likely}</p>}
                    {finding.remedy && <p class="remedy">{finding.remedy}</p>}
                </li>
            ))}
        </ul>
    );
}

export function Doctor() {
    const [findings, setFindings] = useState<Finding[] | null>(null);
    const [wrong, setWrong] = useState("");
    const look = async () => {
        try {
            setFindings((await askJson<{ findings: Finding[] }>("doctor")).findings);
            setWrong("");
        } catch (error) {
            setWrong(said(error));
        }
    };
    useEffect(() => {
        void look();
        const timer = setInterval(() => void look(), 2000);
        return () => clearInterval(timer);
    }, []);
    return (
        <Card title={t("Why does it not work?")} aside={<Action label={t("Look again")} act={look} />}>
            {wrong && (
                <p class="wrong" role="alert">
                    {wrong}
                </p>
            )}
            {findings?.length === 0 && (
                <p>
                    <Sign tone="good">{t("Nothing is wrong that could be seen from here.")}</Sign>
                </p>
            )}
            {findings && <Findings findings={findings} />}
        </Card>
    );
}
