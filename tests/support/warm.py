"""What every process of the tests begins with; the server that forks some of them imports it once for all."""

import gc
import os
import pkgutil
from importlib import import_module

import torch

import mvitac.cli
import mvitac.datasets
import mvitac.deploy.export
import mvitac.training.loop
from mvitac.evaluation import controls

for command in pkgutil.iter_modules(mvitac.cli.__path__, "mvitac.cli."):
    import_module(command.name)
torch.set_num_threads(1)
os.cpu_count = lambda: 1  # packs of a few images are made faster here than new processes start
controls.IMAGENET_SIDE = 64  # px, for a quarter of the time
gc.freeze()  # what was imported stays: no collection looks at it again, nor copies its pages in a forked process
