"""Venues: the plans that a photograph is compared with.

Begin with `venue_search.py`, which waits for a venue's plans (`plan_list.py`). `venue_plans.py` chooses among them by
an index (`plan_indices.py`) of the prototypes in `prototype_file.py`, and `venue_hints.py` applies the hints to them.
"""
