"""LaLaLoc: where in this floor plan was this panorama taken?

Importing this package imports neither torch nor onnxruntime; modules that need them say so.
"""

__version__ = "0.1.0"
