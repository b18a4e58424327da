"""Imports of workers, and codecs that have read a picture: loaded once in the process that tests fork workers from."""

import cv2

import lalaloc_core.localise.refine.latent_refiner  # noqa: F401
import service.decoding.decode_worker
import service.plan_files.convert_worker
import service.workers.lpo  # noqa: F401
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.photograph import warm_up

cv2.setNumThreads(1)
warm_up(sphere_size=(32, 64), patch_size=PatchSize())
