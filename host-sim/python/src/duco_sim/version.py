"""The version of the package, which is that of its ``host-sim``."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def _installed() -> str:
    try:
        return version("duco-sim")
    except PackageNotFoundError:  # imported from a source tree
        return "0"


__version__: str = _installed()
