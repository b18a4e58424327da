"""Evaluations to look at: one HTML page about runs, contact sheets of their worst queries, annotated photographs.

Begin with `html.py`, the page. `worst.py` draws what fails most, `photographs.py` what a model reads from photographs
of real rooms; `pictures.py` draws plans and panoramas for all of them, `charts.py` curves.
"""

from lalaloc_core.evaluate.report.html import write_report
from lalaloc_core.evaluate.report.worst import write_worst

__all__ = ["write_report", "write_worst"]
