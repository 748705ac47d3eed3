"""The report in LaTeX: a table for a paper (package booktabs), and a paragraph on methods."""

from pharos.benchmark.charts import frontier_text
from pharos.benchmark.contents import Contents, excerpt, listed, number, seeds_text
from pharos.system.wording import latex_text, pluralize


def latex_of(contents: Contents) -> str:
    """A table of the core and the axes (package booktabs), and a paragraph on methods."""
    rows = [("core (score)", [number(each.score.core) for each in contents.agents])]
    for axis, own in contents.agent.score.axes.items():
        frontiers = [each.score.axes[axis].frontier if axis in each.score.axes else None for each in contents.agents]
        rows.append((f"{axis} ({own.unit})", ["--" if each is None else frontier_text(each) for each in frontiers]))
    heads = " & ".join(["", *(latex_text(each.name) for each in contents.agents)])
    lines = [" & ".join(latex_text(cell) if cell != "--" else cell for cell in (name, *cells)) for name, cells in rows]
    table = [rf"\begin{{tabular}}{{l{'r' * len(contents.agents)}}}", r"\toprule", rf"{heads} \\", r"\midrule"]
    table += [*(rf"{line} \\" for line in lines), r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*table, "", methods(contents), ""])


def methods(contents: Contents) -> str:
    """The paragraph on methods, in LaTeX: suite, protocol, seeds, statistics and digests."""
    suite, own, protocol = contents.suite, contents.agent.results, contents.suite.protocol
    record = {name: own.record.get(name) for name in ("source", "hyperparameters", "versions")}
    others = f" beside {listed([latex_text(each.name) for each in contents.beside])}" if contents.beside else ""
    num_tasks = f"{contents.num_run(suite.tasks)} of {pluralize(len(suite.tasks), 'task')}"
    lines = (
        rf"We ran {latex_text(contents.agent.name)}{others} on the Pharos Benchmark {latex_text(suite.name)}",
        rf"(SHA-256 of the suite: \texttt{{{latex_text(suite.digest)}}}): {num_tasks},",
        f"{protocol.steps:,} steps each, with {seeds_text(own)}.",
        f"The policy was evaluated after each of {protocol.evaluations} equal parts; its normalised regret is",
        r"$(V^* - V^\pi) / (V^* - V^U)$, where $U$ is uniform play. The score of a run is 1 less the mean over",
        "evaluations, clipped to $[0, 1]$; the core score is the mean over tasks. A frontier is the level of",
        "a ladder at which mean regret, made increasing by isotonic regression, crosses 0.5.",
        r"Intervals are of 95\,\%, Student's $t$ over seeds within tasks.",
    )
    more = (
        f"{latex_text(name.capitalize())}: {latex_text(excerpt(value))}." for name, value in record.items() if value
    )
    return "\n".join((*lines, *more))
