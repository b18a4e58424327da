"""Importers, a module for each format of files.

Begin with `native.py`, the plainest. Drawings (`dxf.py`, `svg.py`, `pdf.py`) leave it to `plans.drawing` to find the
rooms; in `ifc.py`, `geojson.py` and `imdf.py` they stand in the file.
"""
