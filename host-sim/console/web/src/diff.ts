// What changed between two texts, line by line.

export interface Line {
    sign: " " | "+" | "-";
    text: string;
}

/** The lines of both, those only in `older` with `-`, those only in `newer` with `+`. */
export function diff(older: string, newer: string): Line[] {
    const a = older.replace(/\n$/, "").split("\n");
    const b = newer.replace(/\n$/, "").split("\n");
    let start = 0;
    while (start < a.length && start < b.length && a[start] === b[start]) start++;
    let end = 0;
    while (end < a.length - start && end < b.length - start && a[a.length - 1 - end] === b[b.length - 1 - end]) end++;
    const x = a.slice(start, a.length - end);
    const y = b.slice(start, b.length - end);
    // Lengths of the longest common rest, for each pair of places.
    const width = y.length + 1;
    const common = new Uint16Array((x.length + 1) * width);
    for (let i = x.length - 1; i >= 0; i--)
        for (let j = y.length - 1; j >= 0; j--)
            common[i * width + j] =
                x[i] === y[j]
                    ? common[(i + 1) * width + j + 1]! + 1
                    : Math.max(common[(i + 1) * width + j]!, common[i * width + j + 1]!);
    const lines: Line[] = a.slice(0, start).map((text) => ({ sign: " ", text }));
    let i = 0;
    let j = 0;
    while (i < x.length || j < y.length) {
        if (i < x.length && j < y.length && x[i] === y[j]) {
            lines.push({ sign: " ", text: x[i]! });
            i++;
            j++;
        } else if (j >= y.length || (i < x.length && common[(i + 1) * width + j]! >= common[i * width + j + 1]!)) {
            lines.push({ sign: "-", text: x[i++]! });
        } else {
            lines.push({ sign: "+", text: y[j++]! });
        }
    }
    return lines.concat(a.slice(a.length - end).map((text) => ({ sign: " ", text })));
}

/** Only what changed, with two lines around. */
export function changes(lines: Line[], around = 2): (Line | null)[] {
    const shown: (Line | null)[] = [];
    let last = -1;
    for (const [at, line] of lines.entries()) {
        const near = lines.slice(Math.max(0, at - around), at + around + 1).some(({ sign }) => sign !== " ");
        if (!near) continue;
        if (last >= 0 && at > last + 1) shown.push(null);
        shown.push(line);
        last = at;
    }
    return shown;
}
