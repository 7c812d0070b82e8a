// The robot's variables, as proto-core's table has them; a test compares the two.

export interface Row {
    group: string;
    first: number;
    last: number;
    type: "byte" | "word" | "float";
    is_input: boolean;
    about: string;
    unit: string;
}

const row = (group: string, first: number, last: number, type: Row["type"], is_input: boolean, about: string, unit = ""): Row => ({
    group,
    first,
    last,
    type,
    is_input,
    about,
    unit,
});

export const ROWS: Row[] = [
    row("DigitalOutputCommand", 1, 2, "byte", true, "cabinet digital outputs DO1..16"),
    row("DigitalOutputCommand", 3, 3, "byte", true, "tool digital outputs 1..2"),
    row("BitInputReg", 1, 2, "byte", true, "functional bool register inputs 1..16"),
    row("BitInputReg", 3, 10, "byte", true, "bool register inputs 1..64"),
    row("WordInputReg", 1, 32, "word", true, "word register inputs 1..32"),
    row("FloatInputReg", 1, 32, "float", true, "float register inputs 1..32"),
    row("ForceEnd", 1, 6, "float", true, "end force sensor, TCP frame: X,Y,Z,Rx,Ry,Rz", "N, Nm"),
    row("ForceBase", 1, 6, "float", true, "base force sensor, base frame: X,Y,Z,Rx,Ry,Rz", "N, Nm"),
    row("DigitalSignalStatus", 1, 2, "byte", false, "cabinet digital inputs DI1..16"),
    row("DigitalSignalStatus", 3, 3, "byte", false, "tool digital inputs 1..2"),
    row("DigitalSignalStatus", 4, 5, "byte", false, "cabinet digital outputs DO1..16"),
    row("DigitalSignalStatus", 6, 6, "byte", false, "tool digital outputs 1..2"),
    row("DigitalSignalStatus", 7, 7, "byte", false, "functional digital inputs 1..8"),
    row("DigitalSignalStatus", 8, 8, "byte", false, "functional digital outputs 1..8"),
    row("RobotState", 1, 7, "float", false, "joint position; the 7th is reserved", "rad"),
    row("RobotState", 8, 13, "float", false, "TCP pose in the base frame: X,Y,Z,Rx,Ry,Rz", "m, rad"),
    row("RobotState", 14, 19, "float", false, "end force sensor in the flange frame", "N, Nm"),
    row("RobotState", 20, 25, "float", false, "tool frame offset", "m, rad"),
    row("RobotState", 26, 26, "float", false, "payload mass", "kg"),
    row("RobotState", 27, 29, "float", false, "payload centre of mass", "m"),
    row("RobotState", 30, 32, "float", false, "reserved"),
    row("BitOutputReg", 1, 2, "byte", false, "functional bool register outputs 1..16"),
    row("BitOutputReg", 3, 10, "byte", false, "bool register outputs 1..64"),
    row("WordOutputReg", 1, 32, "word", false, "word register outputs 1..32"),
    row("FloatOutputReg", 1, 32, "float", false, "float register outputs 1..32"),
];

const RANGES = { byte: "0..255", word: "0..65535", float: "float" };

export interface Variable {
    name: string;
    about: string;
}

/** All variables of a direction, with what they are, their range and unit. */
export function variables(inputs: boolean): Variable[] {
    return ROWS.filter((row) => row.is_input === inputs).flatMap((row) =>
        Array.from({ length: row.last - row.first + 1 }, (_, nth) => ({
            name: `${row.group}[${row.first + nth}]`,
            about: `${row.about}; ${RANGES[row.type]}${row.unit && ` ${row.unit}`}`,
        })),
    );
}

/** Whole groups as ranges, for realtime recipes. */
export function ranges(inputs: boolean): Variable[] {
    return ROWS.filter((row) => row.is_input === inputs && row.last > row.first).map((row) => ({
        name: `${row.group}[${row.first}..${row.last}]`,
        about: row.about,
    }));
}

/** What else can be sent to the field: docs/configuration.md section 4. */
export const SOURCES: Variable[] = [
    { name: "counter", about: "frames sent so far" },
    { name: "reply", about: "what became of the newest command" },
    { name: "controller.mode", about: "0 manual, 1 automatic, 2 remote" },
    { name: "controller.robot_state", about: "code of the robot's state" },
    { name: "controller.program_state", about: "code of the program's state" },
    { name: "controller.safety_state", about: "code of the safety state" },
    { name: "controller.error_code", about: "the newest error" },
    { name: "port.alive", about: "1 while the device is heard" },
    { name: "port.age_ms", about: "age of its newest frame" },
    { name: "port.frames", about: "frames accepted" },
    { name: "port.rejected", about: "frames rejected" },
];
