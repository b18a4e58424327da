"""Pictures of a stored plan: an SVG drawing and a GLB mesh."""
