"""Scripts for maintainers: set-up, generated documentation, and the cells of the venue index.

Begin with `write_docs.py`.
"""
