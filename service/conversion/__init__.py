"""Files of floor plans, read into plans and written from them in worker processes that may die.

Begin with `converter.py`, which has the workers. `files.py` says what an upload is, and takes the native format itself.
"""

from service.conversion.converter import Converter
from service.conversion.files import PlanFile, seems_native, understand

__all__ = ["Converter", "PlanFile", "seems_native", "understand"]
