"""A panorama in a venue of several plans, perhaps in very many.

Begin with `merged_plans.py`, which makes one plan of those that are searched in full. Where there are too many for
that, `plan_index.py` says which these are: by prototypes, a few poses of each plan (`prototypes.py`), that lie in the
cells of an inverted file (`prototype_cells.py`), are compared by short codes (`prototype_codes.py`), and the best of
them as they are (`prototype_costs.py`). The search itself is that of a single plan, `localise.pipeline`.
"""
