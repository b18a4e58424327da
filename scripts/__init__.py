"""Scripts for maintainers: setting up, generated documentation, cells of the venue index.

Begin with `write_docs.py`.
"""
