"""Write the rig's inverse kinematics as C: `python export.py FOLDER` makes FOLDER/cts_inverse.c and .h."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # run as a file, from anywhere

from models import reference_rig, reference_tunnel
from models.cts.table import export, rig_functions


def main() -> None:
    """Export the functions of the reference rig."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build")
    export(rig_functions(reference_rig(), reference_tunnel()), folder / "cts_inverse.c")


if __name__ == "__main__":
    main()
