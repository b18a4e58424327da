"""What rounding makes of rays and walls, the same for all renderers."""

# A ray may miss both of two adjoining walls at their common corner by rounding; widen each wall by this share.
CORNER_TOLERANCE = 1e-5
# A wall whose line passes the camera nearer than this (m, times the wall's length) is seen edge-on, so not at all.
EDGE_ON = 1e-9
# How far (m) beyond the threshold a ray goes on, so that it does not meet the very wall that it has come through.
BEYOND_M = 1e-3
