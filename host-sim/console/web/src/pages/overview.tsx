// What is connected, what flows, and first of all what is wrong.
import { useEffect, useState } from "preact/hooks";
import { askJson } from "../api";
import { t } from "../i18n";
import { Card, Sign, age, number } from "../parts";
import { type PortStatus, type Value, isAlive, isBoard, rates, status, values } from "../state";
import { health, linkState, losses, portState } from "../words";
import { Findings, type Finding } from "./doctor";

export function Overview() {
    const now = status.value;
    if (!now) return <p class="empty">{t("Waiting for the gateway …")}</p>;
    const [tone, words] = isAlive.value ? health(now) : (["idle", t("Unknown: no connection to the gateway")] as const);
    return (
        <>
            <h1 class="verdict">
                <Sign tone={tone}>{words}</Sign>
            </h1>
            <Wrong isWrong={tone !== "good" && tone !== "idle"} />
            <div class="cards">
                {Object.entries(now.ports).map(([name, port]) => (
                    <Port key={name} name={name} port={port} />
                ))}
                <Controller />
            </div>
        </>
    );
}

/** The findings, while there is something to be found. */
function Wrong({ isWrong }: { isWrong: boolean }) {
    const [findings, setFindings] = useState<Finding[]>([]);
    useEffect(() => {
        // A board has no doctor.
        if (!isWrong || isBoard.value) return setFindings([]);
        let ended = false;
        const look = async () => {
            try {
                const found = await askJson<{ findings: Finding[] }>("doctor");
                if (!ended) setFindings(found.findings);
            } catch {
                // The cards below show what is known.
            }
        };
        void look();
        const timer = setInterval(() => void look(), 3000);
        return () => {
            ended = true;
            clearInterval(timer);
        };
    }, [isWrong]);
    return findings.length > 0 ? <Findings findings={findings} /> : null;
}

function Port({ name, port }: { name: string; port: PortStatus }) {
    const [tone, words] = portState(port);
    const rate = rates.value[name];
    const lost = losses(port);
    const own = Object.entries(values.value).filter(([, value]) => value.owner === name);
    return (
        <Card title={name} aside={<Sign tone={isAlive.value ? tone : "idle"}>{isAlive.value ? words : t("unknown")}</Sign>}>
            <dl class="facts">
                <dt>{t("Last frame")}</dt>
                <dd>{isAlive.value ? age(port.age_ms) : "–"}</dd>
                <dt>{t("Frames a second")}</dt>
                <dd>{isAlive.value && rate ? `${Math.round(rate.in)} ↓  ${Math.round(rate.out)} ↑` : "–"}</dd>
                <dt>{t("Bus")}</dt>
                <dd>
                    {port.bus === "can" ? "CAN" : "RS-485"}
                    {port.bus_state && port.bus_state !== "active" ? `, ${port.bus_state}` : ""}
                </dd>
                {port.reply !== "none" && (
                    <>
                        <dt>{t("Newest command")}</dt>
                        <dd>
                            {port.command ?? ""} {t(`reply ${port.reply}`)}
                        </dd>
                    </>
                )}
            </dl>
            {lost.length > 0 && (
                <p class="lost">
                    <Sign tone="warn">
                        {t("Since the start: {list}", { list: lost.map(([key, count]) => `${t(key)} ${count}`).join(", ") })}
                    </Sign>
                </p>
            )}
            {port.last_rejection && (
                <p class="rejection">
                    {t("{age} ago: {text}", { age: age(port.last_rejection.age_ms), text: port.last_rejection.text })}
                    <code>{port.last_rejection.bytes}</code>
                </p>
            )}
            {own.length > 0 && <Own own={own} isOld={port.state !== "working"} />}
        </Card>
    );
}

/** What a port writes. Of a silent device it is what was written last, or its safe value. */
function Own({ own, isOld }: { own: [string, Value][]; isOld: boolean }) {
    return (
        <ul class="own">
            {own.slice(0, 8).map(([name, value]) => (
                <li key={name} class={isOld ? "old" : ""}>
                    <span>{name}</span>
                    {isOld && isAlive.value && <small>{t("{age} old", { age: age(value.age_ms) })}</small>}
                    <b>{isAlive.value ? number(value.value) : "–"}</b>
                </li>
            ))}
            {own.length > 8 && <li class="more">{t("and {count} more", { count: own.length - 8 })}</li>}
        </ul>
    );
}

function Controller() {
    const now = status.value!;
    const controller = now.controller;
    return (
        <Card title={t("Controller")}>
            <dl class="facts">
                {Object.entries(now.links).map(([name, link]) => {
                    const [tone, words] = linkState(link.state);
                    return [
                        <dt key={name}>{t(`link ${name}`)}</dt>,
                        <dd key={`${name}=`}>
                            <Sign tone={isAlive.value ? tone : "idle"}>{isAlive.value ? words : t("unknown")}</Sign>
                        </dd>,
                    ];
                })}
                {controller &&
                    (["mode", "robot", "program", "safety"] as const).map((key) => {
                        const state = controller[key];
                        return [
                            <dt key={key}>{t(`controller ${key}`)}</dt>,
                            <dd key={`${key}=`}>{isAlive.value ? (state?.name ? t(state.name) : state?.code) : "–"}</dd>,
                        ];
                    })}
            </dl>
        </Card>
    );
}
