"""Plans from pictures: scans, photographs of drawings, and screenshots. The result is a draft.

Begin with `sketching.py`. `ink.py` separates ink from paper, `wall_mask.py` finds walls in it, and `gaps.py` and
`windows.py` classify openings. `lalaloc_core.importers.drawing.walls` finds the rooms that the walls enclose.
"""
