"""LaLaLoc: where in this floor plan was this panorama taken?

    floorplan/   plans: validated rooms and openings         sampling.py     camera poses in a plan
    plans/       plan files of other tools, read and written bundle.py       a model on disk
    panorama/    pictures as files                           conventions.py  axes, units, pixels
    render/      the layout renderer                         metrics.py, azimuth_metrics.py  scores
    nets/        the networks in torch                       calibrate.py    fits confidence
    localise/    the search: evidence, retrieval, optimiser  configuration.py  dataclasses from plain data
    synth/       the generator of training data
    unfamiliar/  another generator, for reporting only
    draw/        pictures of plans and answers
    data/        data sets
    training/    training
    export/      from a training run to a bundle
    methods/     what is compared: LaLaLoc, ICP, oracles
    evaluation/  asking and scoring
    report/      pages and sheets to look at
    reproduce/   the paper's tables
    bench/       the figures of docs/results.md
    cli/         the command line

Begin with `localise/pipeline.py`, the path of a query. Importing this package imports neither torch nor onnxruntime;
modules that need them say so.
"""

__version__ = "0.1.0"
