"""Files made from a stored plan: description, layout, drawing, mesh, exports, localisability.

Begin with `making.py`. The functions are pure; `service.conversion.rendition_cache` runs them once per revision, for
large plans in a worker process.
"""

from service.renditions.description import describe, describe_content, state_of_description, with_head
from service.renditions.making import make_rendition

__all__ = ["describe", "describe_content", "make_rendition", "state_of_description", "with_head"]
