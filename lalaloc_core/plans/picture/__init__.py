"""Plans from pictures: scans, photographs of drawings, screenshots. What comes of them is a draft."""

from lalaloc_core.plans.picture.importing import import_picture
from lalaloc_core.plans.picture.sketching import sketch_picture

__all__ = ["import_picture", "sketch_picture"]
