"""Localise a photograph in a floor plan.

The query side:

    floorplan/   plans: rooms, openings, anchors, validation
    importers/   import and export of plan files of other tools
    bundle/      the model bundle: manifest, fitted parameters, files
    photograph/  photographs as files: decoding, metadata, levelling
    render/      the layout renderer
    nets/        the networks in torch
    localise/    encoders, matching cost, retrieval, VDR, LPO, posterior
    draw/        pictures of plans and answers

`learn/` trains models, `evaluate/` measures them, `cli/` is the command line. All of them use `conventions.py` (axes,
units, pixels), `errors.py`, `files.py`, `file_kinds.py` and `configuration.py` (dataclasses from plain data).

Begin with `localise/search/pipeline.py`, the path of a query. Importing this package loads neither torch nor
onnxruntime.
"""

__version__ = "0.11.0"
