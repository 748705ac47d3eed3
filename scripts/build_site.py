"""Builds the documentation into site/: `make docs`, or `python scripts/build_site.py`. Warnings are errors.

Pages of docs/ are staged in build/docs, with links to files outside of it led to the repository; pages of environments,
the reference and tutorials are generated (site_pages.py). What is built is checked: every link and picture is there,
and nothing is loaded from elsewhere.

python scripts/build_site.py --stage          stage alone
"""

import html.parser
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import yaml

import cli_page
import site_pages

ROOT = Path(__file__).parents[1]
DOCS, STAGED, SITE = ROOT / "docs", ROOT / "build" / "docs", ROOT / "site"
OUTSIDE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "README.md": "start.md"}
FIRST_PAGES = ("index.md", "start.md")  # which lead to pages of environments, for which the repository has one of all
LISTS = ("docs/decisions", "docs/tutorials", "docs/evidence")  # folders with a page that lists the others
ASIDE = ("decisions/", "evidence/", "studies/")  # for readers of the project: neither in the navigation nor searched
CONVERTED = (".ipynb",)
FOREIGN_WORKER = "https://unpkg.com/iframe-worker/shim"  # what the theme would load instead of assets/search-worker.js
LINK = re.compile(r"(\]\()([^)\s]+)(\))")
LIST = re.compile(r"(?<=\n)(?![-#|\s])([^\n]*\n)(?=- )")  # a paragraph's last line, and a list that begins below it
UNREAD = re.compile(r"\n\s*[-*] |[├└]")  # in a paragraph: a list or a drawing that was run together
STRESSED = re.compile(r"<em>[(),']")  # the text between the stars of V* and Q*


def stage() -> Path:
    """Write build/docs and build/mkdocs.yml; return the latter. A staged file that did not change is left as it is."""
    files = {path.relative_to(DOCS).as_posix(): path for path in sorted(DOCS.rglob("*")) if path.is_file()}
    pages: dict[str, str | bytes | Path] = {}
    for name, path in files.items():
        if path.suffix == ".md":
            pages[name] = relinked(path.read_text(encoding="utf-8"), Path("docs") / name, name)
        elif path.suffix not in CONVERTED:
            pages[name] = path
    for source, name in OUTSIDE.items():
        if name not in pages:
            pages[name] = relinked((ROOT / source).read_text(encoding="utf-8"), Path(source), name)
    generated = {
        "environments": site_pages.environments(),
        "api": site_pages.reference(),
        "tutorials": site_pages.tutorials(DOCS / "tutorials"),
        "decisions": site_pages.decisions(DOCS / "decisions"),
    }
    for section in generated.values():
        pages |= section
    pages |= site_pages.explorer()
    pages["cli.md"] = str(pages["cli.md"]).replace(cli_page.MARK, cli_page.tables())
    pages["benchmark.md"] = str(pages["benchmark.md"]).replace(site_pages.BOARD, site_pages.baseline_board())
    pages |= {name: site_pages.live(name, str(pages[name])) for name in site_pages.LIVE}
    pages["index.md"] = f"---\nhide: [navigation, toc]\n---\n\n{pages['index.md']}"
    for name in pages:
        if name.endswith(".md") and name.startswith(ASIDE):
            pages[name] = f"---\nsearch: {{exclude: true}}\n---\n\n{pages[name]}"
    for name, content in pages.items():
        data = content.read_bytes() if isinstance(content, Path) else content
        put(STAGED / name, data.encode() if isinstance(data, str) else data)
    for path in STAGED.rglob("*"):
        if path.is_file() and path.relative_to(STAGED).as_posix() not in pages:
            path.unlink()
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    config |= {"docs_dir": str(STAGED), "site_dir": str(SITE)}
    config["nav"] = with_sections(config["nav"], generated)
    placed = repr(config["nav"])
    missing = [name for name in pages if name.endswith(".md") and f"'{name}'" not in placed]
    missing = [name for name in missing if not name.startswith(ASIDE)]
    if missing:
        config["nav"].append({"More": missing})  # pages that mkdocs.yml does not place
    python = config["plugins"][-1]["mkdocstrings"]["handlers"]["python"]
    python["paths"] = [str(ROOT / "src")]
    python["options"]["extensions"] = [str(ROOT / path) for path in python["options"]["extensions"]]
    path = ROOT / "build" / "mkdocs.yml"
    put(path, yaml.safe_dump(config, sort_keys=False).encode())
    return path


def put(path: Path, data: bytes) -> None:
    """Write a file unless it holds this already."""
    if not path.exists() or path.read_bytes() != data:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def relinked(text: str, source: Path, name: str) -> str:
    """A page with links that work where it is staged as `name`; `source`: where it lies in the repository."""
    repository = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["extra"]["social"][0]["link"]

    def target(match: re.Match) -> str:
        link, hash, anchor = match[2].partition("#")
        if not link or urlsplit(link).scheme:
            return match[0]
        path = os.path.normpath(source.parent / link)
        if path in OUTSIDE:
            staged = OUTSIDE[path]
        elif name in FIRST_PAGES and path == "docs/worlds.md":
            staged = "environments/index.md"
        elif path in LISTS:
            staged = f"{path.removeprefix('docs/')}/index.md"
        elif path.startswith("docs/") and not (ROOT / path).is_dir():
            staged = path.removeprefix("docs/").replace(".ipynb", ".md")
        else:
            kind = "tree" if (ROOT / path).is_dir() else "blob"
            return f"{match[1]}{repository}/{kind}/main/{path}{hash}{anchor}{match[3]}"
        return f"{match[1]}{os.path.relpath(staged, Path(name).parent)}{hash}{anchor}{match[3]}"

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)  # code stays as it is
    return "".join(part if i % 2 else separated(LINK.sub(target, part)) for i, part in enumerate(parts))


def separated(text: str) -> str:
    """Text with an empty line above each list: GitHub needs none below a paragraph, Python-Markdown does."""
    return LIST.sub(r"\1\n", f"\n{text}")[1:]


def with_sections(nav: list, sections: dict[str, dict]) -> list:
    """The navigation, each `[section]` replaced by its generated pages."""

    def filled(entry):
        if isinstance(entry, dict):
            return {title: filled(pages) for title, pages in entry.items()}
        if isinstance(entry, list):
            if len(entry) == 1 and entry[0] in sections:
                return [name for name in sections[entry[0]] if name.endswith(".md")]
            return [filled(each) for each in entry]
        return entry

    return [filled(entry) for entry in nav]


# What was built -------------------------------------------------------------------------------------------------------


class _Page(html.parser.HTMLParser):
    """Links, anchors, what the browser loads by itself, and paragraphs."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.paragraphs: list[str] = []
        self.in_paragraph = False
        self.feed(text)

    def handle_data(self, data):
        if self.in_paragraph:
            self.paragraphs[-1] += data

    def handle_endtag(self, tag):
        self.in_paragraph = self.in_paragraph and tag != "p"

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag in ("p", "div", "pre", "ul", "ol", "table"):  # which end a paragraph
            self.in_paragraph = tag == "p"
            self.paragraphs += [""] * self.in_paragraph
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag == "link" and given.get("rel") not in ("canonical", "prev", "next", "alternate"):
            self.loaded.append(given.get("href") or "")
        if tag in ("script", "img", "iframe", "source", "video") and given.get("src"):
            self.loaded.append(given["src"])


def faults(site: Path) -> list[str]:
    """What is wrong with a built site, a line each: links and pictures that lead nowhere, things from elsewhere, lists
    that were run together."""
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(site.rglob("*.html"))}
    pages = {path: _Page(text) for path, text in texts.items()}
    found = [f"{path.relative_to(site)}: V* without a backslash" for path in pages if STRESSED.search(texts[path])]
    for path, page in pages.items():
        here = path.relative_to(site)
        found += [f"{here}: loads {url}" for url in page.loaded if urlsplit(url).scheme not in ("", "data")]
        found += [f"{here}: has a list in a paragraph: {text[:60]}" for text in page.paragraphs if UNREAD.search(text)]
        for link in {*page.links, *page.loaded}:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or here.name == "404.html":
                continue
            target = path if not parts.path else Path(os.path.normpath(path.parent / unquote(parts.path)))
            if not target.exists():
                found.append(f"{here}: leads to {link}, which is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{here}: leads to {link}, where there is no such place")
    for path in sorted(site.rglob("*.css")):
        urls = re.findall(r"url\(\s*[\"']?(https?:[^)\"']+)", path.read_text(encoding="utf-8"))
        found += [f"{path.relative_to(site)}: loads {url}" for url in urls]
    return found


def main() -> None:
    """Stage, build, check."""
    config = stage()
    if "--stage" in sys.argv[1:]:
        return
    shutil.rmtree(SITE, ignore_errors=True)
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-f", str(config)]
    built = subprocess.run(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    if built.returncode:
        sys.exit(built.returncode)
    for path in SITE.rglob("*.html"):
        worker = os.path.relpath(SITE / "assets" / "search-worker.js", path.parent)
        path.write_text(path.read_text(encoding="utf-8").replace(FOREIGN_WORKER, worker), encoding="utf-8")
    wrong = faults(SITE)
    if wrong:
        sys.exit("\n".join(wrong))
    print(f"site: {len(list(SITE.rglob('*.html')))} pages in {SITE}, every link leads somewhere")


if __name__ == "__main__":
    main()
