"""Which project the folder `pharos` of this interpreter belongs to: two on the package index write one of that name.

The distribution `pharos-rl` is this project. The distribution `pharos` is Graviti's SDK for pictures, whose files lie
in the same folder where both are installed; whichever came last has replaced the other's `__init__.py`.
"""

from pathlib import Path

FOREIGN_FILE = "__version__.py"
"""A file of Graviti's package; this one has none of that name."""


def conflict(folder: Path | None = None) -> str | None:
    """What is wrong where the other project lies in the same folder, and how to mend it; None where it does not.

    Args:
        folder: of the package; None: that of pharos.
    """
    folder = folder or Path(__file__).parents[1]
    if not (folder / FOREIGN_FILE).exists():
        return None
    return (
        f"the distribution 'pharos' (Graviti's SDK, another project) is installed in the folder of pharos-rl, "
        f"{folder}, and each overwrites files of the other; "
        f"to mend it: pip uninstall pharos pharos-rl; pip install pharos-rl"
    )
