#!/usr/bin/env python3
"""Makes the Debian package of a built host-sim.

    python3 make_deb.py HOST_SIM [--runs-as COMMAND] [-o FOLDER]

Prints the package's path. Its architecture is that of HOST_SIM, and it depends on the libraries that HOST_SIM needs. On
another architecture than this machine's, COMMAND runs it (the completions are its output). The same files give the same
package. Needs Python 3.11, dpkg-deb and readelf.
"""

import argparse
import gzip
import os
import pathlib
import shutil
import re
import subprocess
import sys
import tempfile

import tomllib

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(ROOT / "host-sim/python"))
sys.dont_write_bytecode = True

import make_wheel  # noqa: E402

NAME = "recipe-gateway"
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}
# Of every file in the package: 2026-01-01.
TIME = 1767225600
COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/host-sim",
    "zsh": "usr/share/zsh/vendor-completions/_host-sim",
    "fish": "usr/share/fish/vendor_completions.d/host-sim.fish",
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("host_sim", type=pathlib.Path)
    parser.add_argument("--runs-as", type=pathlib.Path)
    parser.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("."))
    arguments = parser.parse_args()
    version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    binary = arguments.host_sim.read_bytes()
    architecture, depends = needs(arguments.host_sim)
    runs_as = arguments.runs_as or arguments.host_sim.resolve()

    documents = f"usr/share/doc/{NAME}"
    files = {
        "usr/bin/host-sim": (binary, 0o755),
        "usr/lib/systemd/system/recipe-gateway@.service": text("recipe-gateway@.service"),
        f"{documents}/README.md": text("README.md"),
        f"{documents}/copyright": (copyright_of_all().encode(), 0o644),
        f"{documents}/changelog.gz": (gzip.compress(changelog(version), mtime=0), 0o644),
        f"{documents}/examples/cell.env": text("cell.env"),
    }
    for page in sorted((ROOT / "docs").glob("*.md")):
        files[f"{documents}/docs/{page.name}"] = (page.read_bytes(), 0o644)
    for example in sorted((ROOT / "host-sim/configs").glob("*.toml")):
        files[f"{documents}/examples/{example.name}"] = (example.read_bytes(), 0o644)
    for shell, place in COMPLETIONS.items():
        printed = subprocess.run([runs_as, "completions", shell], stdout=subprocess.PIPE, check=True).stdout
        assert b"host-sim" in printed, f"no completions for {shell}"
        files[place] = (printed, 0o644)

    arguments.out.mkdir(parents=True, exist_ok=True)
    package = arguments.out / f"{NAME}_{version}_{architecture}.deb"
    with tempfile.TemporaryDirectory() as folder:
        top = pathlib.Path(folder) / NAME
        (top / "etc" / NAME).mkdir(parents=True)
        for place, (content, mode) in files.items():
            path = top / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            path.chmod(mode)
        size = sum(-(-len(content) // 1024) for content, _ in files.values())
        control = top / "DEBIAN"
        control.mkdir()
        told = CONTROL.format(name=NAME, version=version, arch=architecture, size=size, depends=depends)
        (control / "control").write_text(told)
        for script in ("postinst", "prerm", "postrm"):
            shutil.copy(HERE / script, control / script)
            (control / script).chmod(0o755)
        for path in [top, *top.rglob("*")]:
            if path.is_dir():
                path.chmod(0o755)
            os.utime(path, (TIME, TIME))
        build = ["dpkg-deb", "--root-owner-group", "-Zxz", "--build", top, package]
        subprocess.run(build, env={**os.environ, "SOURCE_DATE_EPOCH": str(TIME)}, stdout=subprocess.DEVNULL, check=True)
    print(package)


def needs(binary):
    """The architecture of a binary, and the packages that it depends on; ends with a message if others are needed."""
    glibc, machine = re.fullmatch(r"manylinux_(\d+_\d+)_(\w+)", make_wheel.platform(binary)).groups()
    depends = [f"libc6 (>= {glibc.replace('_', '.')})"]
    if "[libgcc_s.so.1]" in make_wheel.readelf("--dynamic", binary):
        depends.append("libgcc-s1")
    return ARCHITECTURES[machine], ", ".join(depends)


def text(name):
    return (HERE / name).read_bytes(), 0o644


def changelog(version):
    return f"""{NAME} ({version}) stable; urgency=medium

  * The changes are in the changelogs of the crates.

 -- The recipe-gateway authors <noreply@recipe-gateway.invalid>  Thu, 01 Jan 2026 00:00:00 +0000
""".encode()


def copyright_of_all():
    """In the form that Debian asks for, with the text of the licences."""
    mit = (ROOT / "LICENSE-MIT").read_text().split("\n\n", 2)[2]
    lines = [" ." if not line.strip() else f" {line}" for line in mit.strip().splitlines()]
    return COPYRIGHT + "\n".join(lines) + "\n"


CONTROL = """\
Package: {name}
Version: {version}
Architecture: {arch}
Maintainer: The recipe-gateway authors <noreply@recipe-gateway.invalid>
Installed-Size: {size}
Depends: {depends}
Recommends: systemd
Suggests: can-utils, iproute2, wireshark
Section: comm
Priority: optional
Homepage: https://github.com/recipe-gateway/recipe-gateway
Description: gateway from field devices to a DUCO CORE robot controller
 Takes recipe frames, frames of devices and Modbus RTU from RS-485 lines and
 CAN buses, writes the values into the controller of a collaborative robot,
 and sends the robot's state to the devices. A service for each cell, checks
 of its file before anything moves, and a simulated controller to try it with.
"""

COPYRIGHT = """\
Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/
Upstream-Name: recipe-gateway
Source: https://github.com/recipe-gateway/recipe-gateway

Files: *
Copyright: 2026 The recipe-gateway authors
License: Apache-2.0 or Expat

License: Apache-2.0
 The text is in /usr/share/common-licenses/Apache-2.0.

License: Expat
"""

if __name__ == "__main__":
    main()
