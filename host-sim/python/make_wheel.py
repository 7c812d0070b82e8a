#!/usr/bin/env python3
"""Makes the wheel of duco-sim: the package, and a host-sim in it.

    python3 make_wheel.py HOST_SIM [-o FOLDER]

Prints the wheel's path. The platform in its name is what HOST_SIM needs: its processor, and the newest version of
glibc's symbols. The same files give the same wheel. Needs Python 3.11 and readelf.
"""

import argparse
import base64
import hashlib
import pathlib
import re
import subprocess
import sys
import zipfile

import tomllib

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PACKAGE = "duco_sim"
# What every Linux with glibc has; libraries beyond them would have to be in the wheel (PEP 600).
LIBRARIES = {"libc.so.6", "libm.so.6", "libpthread.so.0", "libdl.so.2", "librt.so.1", "libgcc_s.so.1"}
LOADERS = {"x86_64": "ld-linux-x86-64.so.2", "aarch64": "ld-linux-aarch64.so.1"}
MACHINES = {62: "x86_64", 183: "aarch64"}
# The first time that a zip file can hold.
TIME = (1980, 1, 1, 0, 0, 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("host_sim", type=pathlib.Path)
    parser.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("."))
    arguments = parser.parse_args()
    project = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]
    version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    tag = f"py3-none-{platform(arguments.host_sim)}"
    info = f"{PACKAGE}-{version}.dist-info"

    files = {f"{PACKAGE}/bin/host-sim": arguments.host_sim.read_bytes()}
    for path in sorted((HERE / "src" / PACKAGE).iterdir()):
        if path.suffix == ".py" or path.name == "py.typed":
            files[f"{PACKAGE}/{path.name}"] = path.read_bytes()
    licences = sorted(ROOT.glob("LICENSE-*"))
    for path in licences:
        files[f"{info}/licenses/{path.name}"] = path.read_bytes()
    files[f"{info}/METADATA"] = metadata(project, version, [path.name for path in licences]).encode()
    files[f"{info}/WHEEL"] = f"Wheel-Version: 1.0\nGenerator: make_wheel\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    files[f"{info}/entry_points.txt"] = entry_points(project).encode()
    lines = [f"{name},sha256={digest(data)},{len(data)}" for name, data in files.items()]
    files[f"{info}/RECORD"] = "\n".join([*lines, f"{info}/RECORD,,", ""]).encode()

    arguments.out.mkdir(parents=True, exist_ok=True)
    wheel = arguments.out / f"{PACKAGE}-{version}-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o100755 if "/bin/" in name else 0o100644) << 16
            archive.writestr(entry, data)
    print(wheel)


def platform(binary):
    """The platform tag of a binary; ends with a message if no tag is true of it."""
    head = binary.read_bytes()[:20]
    machine = MACHINES.get(int.from_bytes(head[18:20], "little"))
    if head[:6] != b"\x7fELF\x02\x01" or machine is None:
        sys.exit(f"{binary}: no program for {' or '.join(MACHINES.values())}")
    told = readelf("--dynamic", binary)
    needed = set(re.findall(r"\(NEEDED\).*\[(.*)\]", told))
    if extra := needed - LIBRARIES - {LOADERS[machine]}:
        sys.exit(f"{binary} needs {', '.join(sorted(extra))}, which not every Linux has")
    versions = re.findall(r"\bGLIBC_(\d+)\.(\d+)", readelf("--version-info", binary))
    if not versions:
        sys.exit(f"{binary}: it does not say which glibc it needs")
    newest = max((int(major), int(minor)) for major, minor in versions)
    # No tag is for a glibc before 2.5.
    major, minor = max(newest, (2, 5))
    return f"manylinux_{major}_{minor}_{machine}"


def readelf(what, binary):
    return subprocess.run(["readelf", "--wide", what, binary], check=True, capture_output=True, text=True).stdout


def metadata(project, version, licences):
    lines = [
        "Metadata-Version: 2.4",
        f"Name: {project['name']}",
        f"Version: {version}",
        f"Summary: {project['description']}",
        f"Keywords: {','.join(project['keywords'])}",
        f"License-Expression: {project['license']}",
        *(f"License-File: {name}" for name in licences),
        *(f"Classifier: {classifier}" for classifier in project["classifiers"]),
        *(f"Project-URL: {name}, {url}" for name, url in project["urls"].items()),
        f"Requires-Python: {project['requires-python']}",
        *(f"Requires-Dist: {dependency}" for dependency in project["dependencies"]),
        "Description-Content-Type: text/markdown",
        "",
        (HERE / project["readme"]).read_text(),
    ]
    return "\n".join(lines)


def entry_points(project):
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    return "\n".join(
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in entries.items())
        for group, entries in groups.items()
    )


def digest(data):
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    main()
