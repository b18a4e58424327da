"""Training: stage 1 the layout encoder, stage 2 the image encoder, or both end to end.

Begin with `layout_stage.py` and `image_stage.py`, which define the networks and losses of each stage; `loop.py` is the
training loop, and `run.py` a run with its checkpoints. Data flows from `sources.py` (scenes) through `batch_streams.py`
(rows) and `batches.py` (worker processes); panoramas are rendered by the workers or on the training device
(`deferred.py`). `config.py` has the settings and `presets.py` their presets.
"""

from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.run import train_end_to_end, train_image, train_layout

__all__ = ["PRESETS", "Checkpoint", "TrainConfig", "TrainingData", "train_end_to_end", "train_image", "train_layout"]
