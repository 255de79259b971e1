"""What every process of the tests begins with; the server that forks some of them imports it once for all."""

import gc

import torch

import mvitac.experiments.jobs
import mvitac.training.loop  # noqa: F401
from mvitac.evaluation import controls

torch.set_num_threads(1)
controls.IMAGENET_SIDE = 64  # px, for a quarter of the time
gc.freeze()  # what was imported stays: no collection looks at it again, nor copies its pages in a forked process
