"""Templates of pages, by Jinja2: what is filled in is escaped, and a name that is not there is an error."""

from functools import cache
from typing import TYPE_CHECKING

from pharos.errors import MissingExtra

if TYPE_CHECKING:
    import jinja2


@cache
def templates(package: str, page: str) -> "jinja2.Environment":
    """Those in the folder `templates` of a package; `page` says for what, where Jinja2 is not installed.

    Raises:
        MissingExtra: it is not.
    """
    try:
        import jinja2
    except ImportError as error:
        raise MissingExtra(page, "jinja2", "study") from error
    return jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
