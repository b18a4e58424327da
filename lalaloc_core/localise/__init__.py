"""Localisation of a photograph in a floor plan; service and evaluation run the same code.

The packages in the order of a query: `query/` has what is known of a photograph, `encode/` runs the networks, `match/`
compares poses, `search/` finds them, `refine/` moves them to the best fit, and `belief/` states how certain the answer
is, and `answers/` composes it. `tracking/` localises photographs one after the other, `venue/` in many plans,
`album/` a folder of them, and `localisability/` predicts where photographs will be found. Begin with
`search/pipeline.py`, the path of a query. Worker processes load parts of this package, so it exports nothing.
"""
