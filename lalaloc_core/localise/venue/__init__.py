"""Search for the pose of a photograph in a venue of many plans.

Begin with `merged_plans.py`, which merges the plans to search into one; `localise.search.pipeline` then searches it
like a single plan. For a large venue, `index_search.py` selects these plans by prototypes, a few poses of each plan
(`prototypes.py`), in the stages of `plan_index.py`. Prototypes are stored in the cells of inverted files
(`prototype_cells.py`, `index_segment.py`) and compared by product codes, the best ones exactly (`prototype_costs.py`),
and the best of these at the best pose nearby.
"""
