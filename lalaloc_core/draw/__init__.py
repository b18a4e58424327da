"""Pictures of plans and answers, for the service, the command line and reports.

All pictures are SVG; resvg rasterises them with the fonts in `fonts/`, so they are the same on every machine. Begin
with `answer.py`: it turns a localisation into a picture of the plan (`plan.py`), a heat map (`heat.py`) and the
photograph with the predicted layout (`outline.py`). Decoding workers load only `canvas.py` until they draw a report, so
nothing else is re-exported.
"""

from lalaloc_core.draw.canvas import rasterise
