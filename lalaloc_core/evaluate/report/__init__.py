"""Reports on evaluation runs: an HTML page, contact sheets of the worst queries, annotated photographs.

Begin with `html.py`, the page. `worst.py` draws the worst queries, `photograph_report.py` evaluates photographs of real
rooms; `pictures.py` draws plans and spheres for all of them, `charts.py` draws the charts.
"""

from lalaloc_core.evaluate.report.html import write_report
from lalaloc_core.evaluate.report.worst import write_worst
