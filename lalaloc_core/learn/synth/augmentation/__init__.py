"""Random changes of finished spheres, rendered or photographed.

Begin with `photometric.py`, effects of camera, lens, film and file; `stretching.py` stretches rooms.
"""
