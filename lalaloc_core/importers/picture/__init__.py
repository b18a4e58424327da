"""Plans from pictures: scans, photographs of drawings, and screenshots. The result is a draft.

Begin with `sketch_picture.py`. `ink.py` separates ink from paper, `wall_mask.py` finds walls in it, and
`wall_symbols.py` classifies openings. `lalaloc_core.importers.drawing.enclosed_rooms` finds the
rooms that the walls enclose.
"""
