"""Import and export of plan files in worker processes.

Begin with `converter.py`, the pool of workers. `files.py` imports native plans in the service itself.
"""

from service.conversion.converter import Converter
from service.conversion.files import PlanFile, convert, seems_native

__all__ = ["Converter", "PlanFile", "convert", "seems_native"]
