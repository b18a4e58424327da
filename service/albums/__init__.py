"""Albums: the background job that solves them, and the forms in which their pins are taken away.

Begin with `album_solver.py`, the job; `query/album_search.py` computes. `album_documents.py` writes GeoJSON, CSV, SVG.
"""
