"""Files made from a stored plan: description, layout, drawing, mesh, exports.

Begin with `making.py`. The functions are pure; `service.conversion.rendition_cache` runs them once per revision, for
large plans in a worker process.
"""

from service.renditions.description import describe, state_of_description
from service.renditions.making import make_rendition

__all__ = ["describe", "make_rendition", "state_of_description"]
