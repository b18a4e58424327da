"""Data sets: scenes with cameras and their photographs, whatever the files are.

Begin with `dataset.py`, what every data set looks like. `dataset_detection.py` tells the formats of a folder apart,
each of which has a reader: `structured3d.py`, `zind.py`, `folder.py` (a user's own) and `annotated.py` (photographs of
real rooms). `assembly.py` makes validated plans of what readers find. Data sets that are drawn lie in `synthetic/`.
"""

from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Photograph, Scene, Split, load_scenes
from lalaloc_core.learn.data.dataset_detection import open_dataset

__all__ = ["Appearance", "Camera", "Dataset", "Photograph", "Scene", "Split", "load_scenes", "open_dataset"]
