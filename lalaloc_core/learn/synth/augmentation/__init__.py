"""Random changes of finished panoramas, rendered or photographed.

Begin with `photometric.py`, effects of camera, lens, film and file; `stretching.py` stretches rooms.
"""
