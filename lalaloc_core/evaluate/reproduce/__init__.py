"""Reproduction of every table of the paper: `lalaloc lab reproduce`.

Begin with `paper_tables.py`, the rows of each table and the paper's figures, and tables as JSON and Markdown.
`table_maker.py` trains, evaluates and scores a table, `ablations.py` has the trained variants.
"""
