"""The report of a study: one HTML file that needs nothing else, its figures as PNG and PDF, its tables as CSV and
LaTeX.

results.py    the data of a report, read and computed once: `Results`
sections.py   the content of each section, without empty ones
page.py       the HTML page, by the templates beside it
files.py      the tables, and `report`, which writes it all
"""

from pharos.study.report.files import StudyReport, report
from pharos.study.report.page import number_text
from pharos.study.report.results import Results, coefficients, study_results

__all__ = ["Results", "StudyReport", "coefficients", "number_text", "report", "study_results"]
