"""The gateway's metrics, read by the parser of Prometheus' own client."""

from http.client import HTTPConnection

import serial
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from cell import PATIENCE, case, check, controller, equal, gateway, link_is_up, until

ROBOT_PORT = {"rs485": "pty:rs485"}
PORT = {"rs485-1": "pty:rs485-1"}
CONSOLE = ["--console", "127.0.0.1:0"]


def families(running):
    """The families of metrics by name; the parser refuses whatever is not OpenMetrics."""
    connection = HTTPConnection(*running.address("console"), timeout=PATIENCE)
    connection.request("GET", "/api/v1/metrics")
    answer = connection.getresponse()
    equal(answer.status, 200, "status")
    check("version=1.0.0" in answer.getheader("Content-Type"), answer.getheader("Content-Type"))
    text = answer.read().decode()
    connection.close()
    found = {family.name: family for family in text_string_to_metric_families(text)}
    equal(len(found), text.count("# TYPE "), "families")
    return found


def value(family, name, **labels):
    """The one sample with these labels."""
    values = [sample.value for sample in family.samples if sample.name == name and sample.labels == labels]
    equal(len(values), 1, f"samples of {name} with {labels}")
    return values[0]


@case("metrics of a gateway, the parser of prometheus_client: counters, ages, histograms")
def metrics():
    with controller("rs485-system-controller.toml", binds=ROBOT_PORT) as robot:
        with gateway("rs485-system.toml", robot, binds=PORT, extra=CONSOLE) as running:
            link_is_up(running, "modbus")
            port = {"port": "rs485-1"}
            with serial.Serial(running.device("rs485-1"), baudrate=115200, timeout=PATIENCE) as field:
                for _ in range(50):
                    field.write(bytes.fromhex("FF FF 01 EE EE"))
                field.write(bytes.fromhex("FF FF 02 EE EF 00 FF FF 01 EE EE"))

                def is_counted():
                    taken = families(running)["rgw_port_frames_in"]
                    return value(taken, "rgw_port_frames_in_total", **port) == 51

                until("51 frames in the metrics", is_counted)
                found = families(running)
            # One copy of the engine: its counters agree.
            types = {name: family.type for name, family in found.items()}
            for name, kind in (
                ("rgw_health", "stateset"),
                ("rgw_port_working", "gauge"),
                ("rgw_port_rejected", "counter"),
                ("rgw_handed_over_seconds", "histogram"),
            ):
                equal(types.get(name), kind, f"type of {name}")
            equal(value(found["rgw_health"], "rgw_health", rgw_health="running"), 1.0, "health")
            check(value(found["rgw_port_age_seconds"], "rgw_port_age_seconds", **port) < PATIENCE, "age")
            tails = value(found["rgw_port_tail_mismatches"], "rgw_port_tail_mismatches_total", **port)
            check(tails >= 1, f"wrong tails: {tails}")
            reasons = {sample.labels["reason"]: sample.value for sample in found["rgw_port_rejected"].samples}
            equal(reasons.get("checksum"), 0.0, f"rejections of {reasons}")
            equal(value(found["rgw_link_up"], "rgw_link_up", link="modbus"), 1.0, "link modbus")
            for name in ("handed_over", "arrived", "lateness", "modbus"):
                is_whole(found[f"rgw_{name}_seconds"], f"rgw_{name}_seconds")
            count = value(found["rgw_handed_over_seconds"], "rgw_handed_over_seconds_count")
            check(count >= 1, "no frame was handed over")


def is_whole(family, name):
    """The buckets rise, up to the count."""
    buckets = [(float(s.labels["le"]), s.value) for s in family.samples if s.name == f"{name}_bucket"]
    equal(len(buckets), 24, f"buckets of {name}")
    equal(buckets, sorted(buckets), f"buckets of {name}, in order")
    counts = [count for _, count in buckets]
    equal(counts, sorted(counts), f"counts of {name}, rising")
    equal(counts[-1], value(family, f"{name}_count"), f"the last bucket of {name}")
    equal(family.unit, "seconds", f"unit of {name}")
