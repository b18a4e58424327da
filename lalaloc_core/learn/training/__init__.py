"""Training: stage 1 the layout encoder, stage 2 the image encoder, both end to end, or the encoder of views.

Begin with `run.py`, which trains a stage. `layout_stage.py`, `image_stage.py` and `view_stage.py` define the networks
and losses of each stage; `loop.py` is their training loop. Data flows
from `sources.py` (scenes) through `batch_streams.py` (rows) and `batches.py` (worker processes); spheres are rendered
by the workers or on the training device (`deferred.py`). `config.py` has the settings and their presets.
"""

from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS, TrainConfig
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.training_data import TrainingData
