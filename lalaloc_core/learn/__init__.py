"""Learning side: data sets, synthetic homes, training and export. Begin with `training/loop.py`."""
