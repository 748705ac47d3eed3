"""The description that the package index shows: README.md with absolute links. Everything else is in pyproject.toml."""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
RELATIVE = r"(?!https?:|mailto:|#)"


def absolute(text: str, repository: str) -> str:
    """README with links to files of the repository, and pictures as they are."""
    text = re.sub(rf'(<img src="){RELATIVE}', rf"\1{repository}/raw/main/", text)
    text = re.sub(rf"(!\[[^]]*\]\(){RELATIVE}", rf"\1{repository}/raw/main/", text)
    return re.sub(rf"((?<!!)\[[^]]*\]\(){RELATIVE}", rf"\1{repository}/blob/main/", text)


if __name__ == "__main__":
    project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    setup(
        long_description=absolute((HERE / "README.md").read_text(encoding="utf-8"), project["urls"]["Repository"]),
        long_description_content_type="text/markdown",
    )
