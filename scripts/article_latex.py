"""A PDF of docs/article.md: LaTeX with the same text, tables and figures, compiled where LaTeX is installed.

    python scripts/article_latex.py

Writes article.tex into build/article, and article.pdf if there is a pdflatex; needs the standard library alone. Known
are headings, paragraphs, lists, emphasis, links, code, formulas, and tables and figures with captions that begin with
**Table N.** and **Figure N.**
"""

import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "article.md"
SITE = "https://github.com/pharos-rl/pharos/blob/main"
HEAD = r"""\documentclass[10pt,twocolumn]{article}
\usepackage[T1]{fontenc}\usepackage[utf8]{inputenc}
\usepackage{times,caption,amsmath,amssymb,booktabs,graphicx,tabularx,textcomp}
\usepackage[a4paper,margin=18mm,columnsep=7mm]{geometry}
\usepackage{xcolor}\usepackage[colorlinks,allcolors=blue!55!black]{hyperref}
\setlength{\emergencystretch}{3em}\setcounter{secnumdepth}{0}
\renewcommand{\topfraction}{0.9}\renewcommand{\textfraction}{0.05}
\makeatletter\renewcommand{\@biblabel}[1]{}
\renewcommand{\section}{\@startsection{section}{1}{0pt}{-2.2ex plus -.6ex}{.8ex}{\large\bfseries\raggedright}}
\def\@listi{\leftmargin1.5em\topsep3pt\partopsep0pt\parsep0pt\itemsep2pt}\let\@listI\@listi\@listi\makeatother
\title{\vspace{-12mm}%s}
\author{The pharos authors\\{\small\url{https://github.com/pharos-rl/pharos}}}
\date{}\begin{document}\maketitle
"""
REFERENCES = r"\setlength{\itemsep}{1pt}\setlength{\parsep}{0pt}"
SPECIAL = {
    **{letter: "\\" + letter for letter in "&%#_{}$"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"<": "$<$", ">": "$>$", "−": "$-$", "–": "--", "²": "$^2$", "≈": r"$\approx$", "±": r"$\pm$", "×": r"$\times$"},
}
PIECES = re.compile(
    r"(?P<math>\$[^$]+\$)|`(?P<code>[^`]+)`|\*\*(?P<bold>.+?)\*\*|\*(?P<italic>.+?)\*"
    r"|\[(?P<text>[^\]]+)\]\((?P<link>[^)]+)\)"
)


def escaped(text):
    return "".join(SPECIAL.get(letter, letter) for letter in re.sub(r'"([^"]+)"', r"``\1''", text))


def command(name, *arguments):
    return "\\" + name + "".join("{" + argument + "}" for argument in arguments)


def environment(name, body, options=""):
    return f"\\begin{{{name}}}{options}\n{body}\n\\end{{{name}}}"


def inline(text):
    """LaTeX of a line: emphasis, code, formulas and links."""
    parts, end = [], 0
    for found in PIECES.finditer(text):
        parts.append(escaped(text[end : found.start()]))
        end = found.end()
        piece = found.groupdict()
        if piece["math"]:
            parts.append(piece["math"])
        elif piece["code"]:
            parts.append(command("texttt", escaped(piece["code"]).replace(r"\_", r"\_\allowbreak{}")))
        elif piece["bold"]:
            parts.append(command("textbf", inline(piece["bold"])))
        elif piece["italic"]:
            parts.append(command("emph", inline(piece["italic"])))
        else:
            link = piece["link"] if "://" in piece["link"] else f"{SITE}/{posixpath.normpath('docs/' + piece['link'])}"
            parts.append(command("href", link.replace("#", r"\#"), inline(piece["text"])))
    return "".join([*parts, escaped(text[end:])])


def table(lines, caption):
    """A table, over both columns of the page if it is wide; the column with the longest text wraps."""
    head, _, *rows = ([cell.strip() for cell in line.strip("| ").split("|")] for line in lines)
    wide = sum(max(len(row[i]) for row in [head, *rows]) for i in range(len(head))) > 50
    width, star = (r"\textwidth", "*") if wide else (r"\columnwidth", "")
    longest = max(range(len(head)), key=lambda i: max(len(row[i]) for row in rows))
    columns = "".join(r">{\raggedright\arraybackslash}X" if i == longest else "l" for i in range(len(head)))
    first, *rest = (" & ".join(map(inline, row)) + r" \\" for row in (head, *rows))
    lines = "\n".join([r"\toprule", first + r"\midrule", *rest, r"\bottomrule"])
    body = environment("tabularx", lines, command("", width, columns)[1:])
    style = r"\centering\footnotesize\setlength{\tabcolsep}{4pt}"
    return environment("table" + star, command("caption*", caption) + style + body, "[t]")


def block(text, after):
    """LaTeX of one block of the page, and how many of the blocks after it belong to it."""
    lines = text.splitlines()
    words = " ".join(line.strip() for line in lines)
    if text.startswith("```"):
        return environment("footnotesize", environment("verbatim", "\n".join(lines[1:-1]))), 0
    if text.startswith("$$"):
        return environment("equation*", text.strip("$\n ")), 0
    if text.startswith("## "):
        return command("section", inline(text[3:])), 0
    if picture := re.match(r"!\[[^\]]*\]\(([^)]+)\)", words):
        file = (PAGE.parent / picture[1]).resolve().as_posix()
        image = rf"\centering\includegraphics[width=\columnwidth]{{{file}}}"
        return environment("figure", image + command("caption*", inline(" ".join(after[0].split()))), "[t]"), 1
    if text.startswith("**Table"):
        return table(after[0].splitlines(), inline(words)), 1
    if kind := re.match(r"(- |\d+\. )", text):
        name = "itemize" if kind[1] == "- " else "enumerate"
        items = re.split(r"\n(?:- |\d+\. )", text[len(kind[1]) :])
        body = "\n".join(r"\item " + inline(" ".join(item.split())) for item in items)
        return environment(name, body), 0
    return inline(words), 0


def latex(page):
    """LaTeX of the whole page."""
    fences = re.split(r"(?m)^(```\w*\n.*?^```|\$\$\n.*?^\$\$)$", page, flags=re.DOTALL)
    blocks = []
    for number, part in enumerate(fences):
        blocks += [part] if number % 2 else [each.strip("\n") for each in re.split(r"\n\s*\n", part) if each.strip()]
    title, *blocks = blocks
    parts, place = [(HEAD % inline(title[2:])).rstrip()], 0
    while place < len(blocks):
        text, used = block(blocks[place], blocks[place + 1 :])
        if blocks[place] == "## Abstract":
            text, used = environment("abstract", inline(" ".join(blocks[place + 1].split()))), 1
        elif blocks[place] == "## References":
            items = re.split(r"\n- ", "\n" + blocks[place + 1])[1:]
            entries = "\n".join(rf"\bibitem{{{n}}} " + inline(" ".join(item.split())) for n, item in enumerate(items))
            text, used = environment("small", environment("thebibliography", REFERENCES + entries, "{99}")), 1
        # A wide table appears at the top of the next page, so it is written a section early.
        sections = [n for n, part in enumerate(parts) if part.startswith(r"\section")]
        parts.insert(sections[-2:][0] if text.startswith(r"\begin{table*}") and sections else len(parts), text)
        place += 1 + used
    joined = "\n\n".join([*parts, r"\end{document}"]) + "\n"
    joined = re.sub(r"\n+(?=\\begin{equation\*})", "\n", joined)  # a formula belongs to the paragraph before it
    return re.sub(r"(\\end{equation\*})\n+(?=[a-z])", r"\1\n", joined)


def main(out=ROOT / "build" / "article"):
    out.mkdir(parents=True, exist_ok=True)
    (out / "article.tex").write_text(latex(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    if shutil.which("pdflatex") is None:
        print(f"{out / 'article.tex'} is written; no PDF, because no LaTeX (pdflatex) is installed")
        return
    for _ in range(2):
        program = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "article.tex"]
        done = subprocess.run(program, cwd=out, capture_output=True, text=True, errors="replace")
        if done.returncode:
            sys.exit("\n".join(done.stdout.splitlines()[-25:]))
    print(out / "article.pdf")


if __name__ == "__main__":
    main()
