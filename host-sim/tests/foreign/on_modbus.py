"""The controller's Modbus server with mbpoll and pymodbus."""

import subprocess

from cell import PATIENCE, Modbus, case, check, controller, equal

CONFIG = "rs485-system-controller.toml"
BINDS = {"rs485": "pty:rs485"}


def mbpoll(robot, *arguments, values=()):
    """Runs mbpoll once; its exit code and everything it printed."""
    host, port = robot.address("modbus")
    command = ["mbpoll", "-m", "tcp", "-p", str(port), "-0", "-1", *arguments, host, *values]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=PATIENCE)
    return done.returncode, done.stdout


def mbpoll_value(robot, *arguments):
    code, text = mbpoll(robot, *arguments)
    equal(code, 0, f"mbpoll's exit code; it printed {text}")
    values = [line.split(":")[1].split()[0] for line in text.splitlines() if line.startswith("[")]
    check(values, f"mbpoll printed no value: {text}")
    return [int(value) for value in values]


@case("mbpoll reads and writes coils and registers")
def reads_and_writes():
    with controller(CONFIG, ["initial.WordOutputReg[1]=7", "initial.DI[3]=true"], BINDS) as robot:
        equal(mbpoll_value(robot, "-t", "4", "-r", "0", "-c", "4"), [2, 6, 0, 5], "registers 0-3")
        equal(mbpoll_value(robot, "-t", "4", "-r", "40"), [7], "register 40, WordOutputReg[1]")
        equal(mbpoll_value(robot, "-t", "0", "-r", "176", "-c", "4"), [0, 0, 1, 0], "coils 176-179, DI1..4")
        for address, value in (("192", "1"), ("192", "0"), ("216", "1")):
            code, text = mbpoll(robot, "-t", "0", "-r", address, values=[value])
            equal(code, 0, f"writing coil {address}; mbpoll printed {text}")
            equal(mbpoll_value(robot, "-t", "0", "-r", address), [int(value)], f"coil {address}")
        code, text = mbpoll(robot, "-t", "0", "-r", "32", values=["1", "0", "1", "1"])
        equal(code, 0, f"writing four coils; mbpoll printed {text}")
        equal(mbpoll_value(robot, "-t", "0", "-r", "32", "-c", "4"), [1, 0, 1, 1], "coils 32-35")
        for values in (["513"], ["1", "2", "65535"]):
            code, text = mbpoll(robot, "-t", "4", "-r", "8", values=values)
            equal(code, 0, f"writing registers; mbpoll printed {text}")
            expected = [int(value) for value in values]
            count = str(len(values))
            equal(mbpoll_value(robot, "-t", "4", "-r", "8", "-c", count), expected, "registers from 8")


@case("mbpoll is refused with the right exceptions")
def refusals():
    with controller(CONFIG, binds=BINDS) as robot:
        for arguments, values, wanted in (
            (("-t", "4", "-r", "118"), (), "Illegal data address"),
            (("-t", "4", "-r", "117", "-c", "2"), (), "Illegal data address"),
            (("-t", "4", "-r", "40"), ("1",), "Illegal data address"),
            (("-t", "0", "-r", "16"), ("1",), "Illegal data address"),
            (("-t", "1", "-r", "0"), (), "Illegal function"),
            (("-t", "3", "-r", "0"), (), "Illegal function"),
        ):
            code, text = mbpoll(robot, *arguments, values=values)
            check(code != 0 and wanted in text, f"{arguments} {values}: exit code {code}, {text}")


@case("pymodbus: every function, units, atomic refusals")
def functions():
    with controller(CONFIG, binds=BINDS) as robot, Modbus(robot) as modbus:
        client = modbus.client
        equal(client.read_coils(0, count=232).bits[:232].count(True), 0, "coils that are on")
        equal(len(modbus.registers(0, 118)), 118, "all registers")
        check(not client.write_coil(0, True).isError(), "FC 5")
        check(not client.write_coils(32, [True, False, True] * 5).isError(), "FC 15")
        equal(client.read_coils(32, count=15).bits[:15], [True, False, True] * 5, "coils 32-46")
        check(not client.write_register(8, 0xBEEF).isError(), "FC 6")
        check(not client.write_registers(9, list(range(31))).isError(), "FC 16")
        equal(modbus.registers(8, 32), [0xBEEF, *range(31)], "registers 8-39")
        answer = client.write_registers(38, [7, 7, 7])
        equal(answer.exception_code, 2, "exception for 38-40, of which 40 is read-only")
        equal(modbus.registers(38, 2), [29, 30], "registers 38-39 after it")
        answer = client.write_coils(8, [True] * 16)
        equal(answer.exception_code, 2, "exception for coils 8-23, of which 16-23 are read-only")
        equal(client.read_coils(8, count=8).bits[:8], [False] * 8, "coils 8-15 after it")
        equal(client.read_discrete_inputs(0).exception_code, 1, "exception for FC 2")
        equal(client.read_input_registers(0).exception_code, 1, "exception for FC 4")
        for unit in (0, 1, 17, 255):
            equal(client.read_holding_registers(0, count=4, device_id=unit).registers, [2, 6, 0, 5], f"unit {unit}")
