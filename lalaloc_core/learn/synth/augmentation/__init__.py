"""Random changes of finished panoramas, rendered or photographed.

Begin with `photometric.py`, what another camera, lens, film or file would have made of them; `stretching.py` draws
rooms out.
"""
