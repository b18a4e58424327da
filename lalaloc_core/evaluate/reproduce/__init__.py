"""Reproduction of every table of the paper: `lalaloc lab reproduce`.

Begin with `paper_tables.py`, the rows of each table and the paper's figures. `table_maker.py` trains, evaluates and
scores a table, `ablations.py` has the trained variants, `table.py` writes tables as JSON and Markdown.
"""

from lalaloc_core.evaluate.reproduce.paper_tables import TABLES
