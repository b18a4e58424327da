"""Import of plan files, and files made from stored plans, in worker processes.

Begin with `converter.py`, the pool of workers. `files.py` imports small native plans in the service itself;
`rendition_cache.py` keeps files made from stored plans.
"""

from service.conversion.converter import Converter
from service.conversion.files import PlanFile, convert, convert_levels, seems_native
from service.conversion.rendition_cache import RenditionCache

__all__ = ["Converter", "PlanFile", "RenditionCache", "convert", "convert_levels", "seems_native"]
