"""Imported once by the server that forks processes of tests, so that none of them loads networks and views anew."""

from __future__ import annotations

import gc

import torch

import mvitac.experiments.jobs
import mvitac.training.loop  # noqa: F401
from mvitac.transforms.random_views import ViewAugment, random_view

torch.set_num_threads(1)
random_view(torch.zeros(1, 3, 32, 32, dtype=torch.uint8), ViewAugment(), 32, torch.Generator())  # loads numba's code
gc.freeze()  # a collection in a forked process would copy every page that it looks at
