"""From trained weights to a model bundle: `run.py` takes them from a training run's folder, `bundle.py` writes them."""
