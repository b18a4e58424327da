"""Data sets: scenes with cameras and photographs, in any file format.

Begin with `dataset.py`, the interface of every data set. `dataset_detection.py` detects the format of a folder and
opens its reader: `structured3d.py`, `zind.py`, `folder.py` (a user's own data, and the out-of-distribution homes) or
`annotated.py` (annotated photographs of real rooms). `assembly.py` builds validated plans for the readers. Generated
data sets are in `synthetic/`.
"""

from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene, Split
from lalaloc_core.learn.data.dataset_detection import open_dataset
from lalaloc_core.learn.data.folder import HeldoutScenes
from lalaloc_core.learn.data.views import CachedSphere, Stated, ViewPhotograph, ViewScenes, cut_view, encode_jpeg
