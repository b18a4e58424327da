"""Pictures of plans and answers: one implementation for the service, the command line, the report and the demo.

Everything is drawn as SVG and, where pixels are wanted, rasterised by resvg with the fonts in `fonts/`: the same
picture on every machine. Begin with `answer.py`, which composes the picture of an answer of a plan (`plan.py`), a heat
map (`heat.py`) and the photograph with the found layout in it (`outline.py`, `photograph.py`); `found.py` makes what it
draws of what the search found. Worker processes load `canvas.py` alone, so only that is re-exported.
"""

from lalaloc_core.draw.canvas import rasterise

__all__ = ["rasterise"]
