"""A section of the report's page."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Section:
    """A section of the page: its title, the template that prints it, and what that needs, by name."""

    title: str
    template: str
    context: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(title: str, template: str, **context: object) -> "Section":
        """The section that `template`.html.j2 prints with this context."""
        return Section(title, f"{template}.html.j2", context)

    @property
    def anchor(self) -> str:
        """Where links lead to."""
        return self.title.lower().replace(" ", "-")

    def __getitem__(self, name: str) -> Any:
        return self.context[name]
