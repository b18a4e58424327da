"""What maintainers run by hand: setting up, documentation, comparing encoders.

Begin with `write_docs.py`.
"""
