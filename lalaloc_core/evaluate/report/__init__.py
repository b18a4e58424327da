"""Reports on evaluation runs: an HTML page, the worst queries, and figures of annotated photographs.

Begin with `html.py`, the page and its charts. `worst.py` lists the worst queries, `photograph_report.py` evaluates
photographs of real rooms.
"""

from lalaloc_core.evaluate.report.html import write_report
