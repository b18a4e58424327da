"""Every table of the paper, run again: `lalaloc reproduce`.

Begin with `tables.py`, what each row asks and the paper's figures. `run.py` trains, asks and scores what a table needs,
`ablations.py` are the trained variants, `result_tables.py` writes the tables as Markdown.
"""

from lalaloc_core.evaluate.reproduce.tables import TABLES

__all__ = ["TABLES"]
