"""Code of the user's own in a study: what has changed since its runs were trained."""

import warnings
from collections import defaultdict
from pathlib import Path

from pharos.errors import PharosError
from pharos.study.specification import Specification
from pharos.training import read_record


def warn_of_changes(study: Specification, folder: Path) -> None:
    """Warn of each file of the user's own that has changed since finished runs in `folder` were trained with it.

    Their ids do not depend on it, so they count as runs of the study.
    """
    changed: dict[str, int] = defaultdict(int)
    for run in study.runs:
        if not run.configuration.sources or not (folder / "runs" / run.id / "run.json").is_file():
            continue
        try:
            stored = read_record(folder / "runs" / run.id)["config"]["sources"]
            for part, source in run.configuration.sources.items():
                changed[source.file] += stored[part]["checksum"] != source.checksum
        except (PharosError, KeyError, TypeError):  # damaged: whoever reads the result says so
            continue
    for file, count in changed.items():
        if count:
            warnings.warn(
                f"{file} has changed since {count} runs in {folder} were trained with it; "
                f"another --out trains them anew",
                stacklevel=3,
            )
