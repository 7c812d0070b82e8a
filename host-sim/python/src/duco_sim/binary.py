"""Where the program ``host-sim`` is."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NoReturn

from .errors import DucoSimError

#: Names another ``host-sim`` than the package's own, for work on ``host-sim`` itself.
VARIABLE = "DUCO_SIM_HOST_SIM"


def host_sim() -> Path:
    """The path of ``host-sim``: what ``$DUCO_SIM_HOST_SIM`` names, else the package's own.

    Raises :class:`DucoSimError` if there is none.
    """
    named = os.environ.get(VARIABLE)
    path = Path(named) if named else Path(__file__).with_name("bin") / "host-sim"
    if not os.access(path, os.X_OK):
        raise DucoSimError(
            f"there is no program {path}; install the wheel of duco-sim, or name host-sim in ${VARIABLE}"
        )
    return path


def main() -> NoReturn:
    """Becomes ``host-sim``, with the same arguments: the command ``host-sim``."""
    path = str(host_sim())
    os.execv(path, [path, *sys.argv[1:]])
