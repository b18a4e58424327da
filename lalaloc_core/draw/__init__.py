"""Pictures of plans and answers: one implementation for the service, the command line, the report and the demo.

Everything is drawn as SVG and, where pixels are wanted, rasterised by resvg with the fonts in `fonts/`: the same
picture on every machine. Begin with `answer.py`, which composes the picture of an answer of a plan (`plan.py`), a heat
map (`heat.py`) and the photograph with the found layout in it (`outline.py`, `photograph.py`).
"""

from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, PICTURES, DrawnAnswer, Picture, Rival, draw_answer, drawn_answer
from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.draw.plan import Marker, draw_rooms, plan_svg

__all__ = [
    "PHOTOGRAPH_SIZE",
    "PICTURES",
    "DrawnAnswer",
    "Marker",
    "Picture",
    "Rival",
    "draw_answer",
    "draw_rooms",
    "drawn_answer",
    "plan_svg",
    "rasterise",
]
