"""Plans in the formats of other tools: what the importers read back.

Begin with `drawings.py` (DXF, SVG) or `features.py` (GeoJSON, IMDF); `lalaloc_core.importers.exporting` chooses.
"""
