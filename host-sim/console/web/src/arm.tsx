// The arm, drawn from its joints: the geometry is that of host-sim/controller/src/motion/geometry.rs.
import { t } from "./i18n";

type Vector = [number, number, number];

/** Offset along the joint's axis, length of the link, sine and cosine of the twist behind it. */
const LINKS: [number, number, number, number][] = [
    [0.145, 0, 1, 0],
    [0, -0.43, 0, 1],
    [0, -0.365, 0, 1],
    [0.125, 0, 1, 0],
    [0.11, 0, -1, 0],
    [0.1, 0, 0, 1],
];

/** The places of the base, of the joints and of the flange, in metres. */
export function places(joints: number[]): Vector[] {
    let [x, y, z]: Vector[] = [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
    ];
    let at: Vector = [0, 0, 0];
    const found: Vector[] = [at];
    const sum = (...parts: [number, Vector][]): Vector =>
        [0, 1, 2].map((axis) => parts.reduce((all, [by, of]) => all + by * of[axis]!, 0)) as Vector;
    for (const [nth, [d, a, st, ct]] of LINKS.entries()) {
        const [s, c] = [Math.sin(joints[nth] ?? 0), Math.cos(joints[nth] ?? 0)];
        const along = sum([c, x!], [s, y!]);
        const across = sum([-s, x!], [c, y!]);
        // The shoulder and the elbow stick out along their axis before the link begins.
        if (d !== 0 && a !== 0) found.push(sum([1, at], [d, z!]));
        at = sum([1, at], [a, along], [d, z!]);
        found.push(at);
        [x, y, z] = [along, sum([ct, across], [st, z!]), sum([-st, across], [ct, z!])];
    }
    return found;
}

/** Seen from the front right and a little above. */
function seen([x, y, z]: Vector): [number, number] {
    const turn = 0.6;
    const tilt = 0.35;
    const side = x * Math.cos(turn) + y * Math.sin(turn);
    const depth = -x * Math.sin(turn) + y * Math.cos(turn);
    return [side * 100, -(z * Math.cos(tilt) + depth * Math.sin(tilt) * 0.5) * 100];
}

export function Arm({ joints }: { joints: number[] }) {
    const points = places(joints).map(seen);
    const line = points.map(([x, y]) => `${x.toFixed(2)},${y.toFixed(2)}`).join(" ");
    return (
        <svg class="arm" viewBox="-110 -120 220 150" role="img" aria-label={t("The arm")}>
            <ellipse cx="0" cy="4" rx="70" ry="16" class="floor" />
            <polyline points={line} class="bone" />
            <polyline points={line} class="core" />
            {points.slice(0, -1).map(([x, y], at) => (
                <circle key={at} cx={x} cy={y} r="5" class="joint" />
            ))}
            <circle cx={points.at(-1)![0]} cy={points.at(-1)![1]} r="3.5" class="tip" />
        </svg>
    );
}
