"""``python -m duco_sim``: the same as ``host-sim``."""

from .binary import main

main()
