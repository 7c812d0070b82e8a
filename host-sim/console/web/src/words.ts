// Names of states as people say them, and how good or bad they are.
import type { PortStatus, Status } from "./state";
import { t } from "./i18n";
import type { Tone } from "./parts";

export function portState(port: PortStatus): [Tone, string] {
    switch (port.state) {
        case "working":
            return port.overdue > 0 ? ["warn", t("late")] : ["good", t("working")];
        case "silent":
            return port.counters["frames_in"] ? ["bad", t("silent")] : ["bad", t("nothing heard yet")];
        case "bus-off":
            return ["bad", t("bus off")];
        case "gone":
            return ["bad", t("device is gone")];
        default:
            return ["idle", port.state];
    }
}

export function linkState(state: string): [Tone, string] {
    switch (state) {
        case "up":
            return ["good", t("connected")];
        case "shared":
            return ["good", t("shared")];
        case "opening":
            return ["warn", t("connecting")];
        default:
            return ["bad", t("no connection")];
    }
}

export function health(status: Status): [Tone, string] {
    switch (status.health) {
        case "running":
            return ["good", t("Everything runs")];
        case "port-silent":
            return ["bad", t("A device is silent")];
        case "no-controller":
            return ["bad", t("No connection to the controller")];
        case "idle":
            return ["idle", t("Nothing is to be done")];
        default:
            return ["warn", status.health];
    }
}

/** The counters of what was not taken or not done, by the port and its devices together: those that are not zero. */
export function losses({ counters, peers = {} }: PortStatus): [string, number][] {
    const all = { ...counters };
    const add = (name: string, count: number) => (all[name] = (all[name] ?? 0) + count);
    for (const { counters = {} } of Object.values(peers))
        for (const [name, count] of Object.entries(counters))
            if (name === "events") Object.entries(count).forEach(([name, count]) => add(`event_${name}`, count));
            else if (/^(late_r|unc)/.test(name)) add(name, count as number);
    return Object.entries(all).filter(
        ([name, count]) => count > 0 && /^(late_r|unc|event_(?!done|acc)|rejected_|tail_mis|resync|discarded|timeouts|refused|downs|bus_offs|unanswered|undelivered|edges_lost|commands_dropped|commands_unknown|malformed|unacknowledged)/.test(name),
    );
}
