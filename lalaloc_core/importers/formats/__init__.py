"""One module per file format, with `read` and, for export formats, `write`.

Begin with `native.py`, the simplest. The drawings (`dxf.py`, `svg.py`, `pdf.py`) leave finding rooms to
`lalaloc_core.importers.drawing`; `ifc.py`, `geojson.py` and `imdf.py` take rooms from the file.
"""
